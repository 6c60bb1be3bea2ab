"""Regions grown on the depth image: like Voronoi cells inside a limb, better where limbs hide one another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.body.depth_mesher import mesh_view
from common.body.link_segmentation import nearest_link
from common.body.region_growing import grown_regions
from common.body.rigged_mesh import MESH_STRIDE, build_rigged_mesh
from common.body.rigging import Rigging
from common.body.skeleton import LINK_COUNT, LINK_INDEX
from common.body.skeleton_pose import SkeletonPose
from common.body.view import View
from common.geometry.triangle_mesh import TriangleMesh
from tests.capsule_person import SKELETON, capsule_person, pose_at
from tests.capsule_views import arms_down_by, capsule_views, links_of


def grown(view: View, pose: SkeletonPose) -> tuple[TriangleMesh, np.ndarray, np.ndarray]:
    """A view's mesh, its regions, and its Voronoi cells."""
    mesh, T_world_link = mesh_view(view, MESH_STRIDE), links_of(pose)
    regions = grown_regions(view, mesh, MESH_STRIDE, SKELETON, T_world_link)
    return mesh, regions, nearest_link(mesh.vertices, SKELETON, T_world_link)


def away_from_borders(mesh: TriangleMesh, links: np.ndarray, rings: int) -> np.ndarray:
    """Mask (V,) of vertices whose neighbours, ``rings`` deep, are all of their own link."""
    inside = np.ones(len(links), np.bool_)
    for _ in range(rings):
        mixed = (links[mesh.faces] != links[mesh.faces[:, :1]]).any(axis=1) | ~inside[mesh.faces].all(axis=1)
        inside[mesh.faces[mixed]] = False
    return inside


@pytest.mark.parametrize("pose", [arms_down_by(0.4), arms_down_by(1.0, 0.7), pose_at(0.8)], ids=["a", "turned", "bent"])
@pytest.mark.parametrize("camera", range(4))
def test_it_agrees_with_voronoi_away_from_borders(pose: SkeletonPose, camera: int) -> None:
    mesh, regions, cells = grown(capsule_views(pose)[camera], pose)
    inside = away_from_borders(mesh, cells, 3)
    assert inside.sum() > 0.3 * len(cells)
    assert (regions == cells)[inside].mean() > 0.99
    assert (regions == cells).mean() > 0.93
    assert regions.max() < LINK_COUNT


def test_every_region_hangs_together_with_its_link() -> None:
    """A region's pixels are connected: what Voronoi cells of a person whose limbs touch are not."""
    pose = arms_down_by(1.5)  # arms against the body
    mesh, regions, _ = grown(capsule_views(pose)[0], pose)
    for link in (LINK_INDEX["left_forearm"], LINK_INDEX["right_thigh"], LINK_INDEX["head"]):
        inner = mesh.faces[(regions[mesh.faces] == link).all(axis=1)]
        label = np.arange(len(regions))
        for _ in range(200):
            lowest = label[inner].min(axis=1)
            np.minimum.at(label, inner, lowest[:, None])
        _, sizes = np.unique(label[inner[:, 0]], return_counts=True)
        assert sizes.max() > 0.97 * sizes.sum()


def test_a_limb_before_another_takes_no_part_of_it() -> None:
    """Though the skeleton's radii are wrong by a half."""
    pose = arms_down_by(1.45)
    view = capsule_views(pose)[1]  # from the side: the arm is before the trunk
    fat = replace(SKELETON, radii=(SKELETON.radii * 1.5).astype(np.float32))
    mesh, T_world_link = mesh_view(view, MESH_STRIDE), links_of(pose)
    truth = nearest_link(mesh.vertices, SKELETON, T_world_link)
    arm = np.isin(truth, [LINK_INDEX["left_forearm"], LINK_INDEX["left_upper_arm"]])
    regions = grown_regions(view, mesh, MESH_STRIDE, fat, T_world_link)
    assert (regions == truth)[arm].mean() > 0.9


def test_what_no_seed_reaches_goes_to_the_nearest_link() -> None:
    pose = arms_down_by(0.4)
    view = capsule_views(pose)[0]
    speck = view.depth_mm.copy()
    speck[:] = 0
    speck[2:8, 2:8] = 2500
    alone = replace(view, depth_mm=speck)
    _, regions, cells = grown(alone, pose)
    assert len(regions) > 0
    np.testing.assert_array_equal(regions, cells)


def test_a_candidates_mesh_is_segmented_as_it_says() -> None:
    pose = arms_down_by(1.2)
    views = capsule_views(pose, 2)
    by_cells, by_growth = (
        build_rigged_mesh(1, 0, SKELETON, pose, views, Rigging(s)) for s in ("voronoi", "region-growing")
    )
    np.testing.assert_array_equal(by_cells.vertex_link, nearest_link(by_cells.mesh.vertices, SKELETON, links_of(pose)))
    expected = np.concatenate([grown(view, pose)[1] for view in views])
    np.testing.assert_array_equal(by_growth.vertex_link, expected)
    assert 0 < (by_cells.vertex_link != by_growth.vertex_link).mean() < 0.1
    assert len(capsule_person().vertex_link) > 0
