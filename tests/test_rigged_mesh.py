"""A candidate pose's parts become one rigged mesh: the edges that deform, and the triangles that are drawn."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from common.body.body_regions import REGION_INDEX, REGION_LINKS, ScoreForm
from common.body.depth_mesher import mesh_view
from common.body.joint_edges import FIXED_EDGE_M, joint_edges
from common.body.rigged_mesh import (
    DRAWN_EDGE_M,
    DRAWN_LINK_STEPS,
    MESH_STRIDE,
    build_rigged_mesh,
)
from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_PARENTS
from common.body.skinning import animate, link_motion
from common.body.vertex_regions import vertex_regions
from common.body.view import View
from common.geometry.rigid_transform import transform_points
from tests.capsule_person import SKELETON
from tests.capsule_views import arms_down_by, capsule_views, captured, links_of, ring_camera

ANGLE_RAD = 1.35  # hands at the thighs
MESH = captured(ANGLE_RAD, pose_id=7, capture_ns=123)
REGIONS = vertex_regions(MESH.mesh.vertices, MESH.vertex_link, SKELETON, MESH.T_link_world)
ALL = 10**9


def all_edges() -> set[tuple[int, int]]:
    pairs = MESH.mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return {(min(a, b), max(a, b)) for a, b in pairs.tolist()}


def test_all_views_are_in_it() -> None:
    counts = [len(mesh_view(view, MESH_STRIDE).vertices) for view in capsule_views(arms_down_by(ANGLE_RAD))]
    assert len(MESH.mesh.vertices) == sum(counts) == len(MESH.vertex_link) == len(MESH.mesh.uv)
    owner = np.repeat(np.arange(4), counts)[MESH.mesh.faces]
    assert (owner == owner[:, :1]).all()  # views stay separate surfaces
    assert set(owner[:, 0]) == {0, 1, 2, 3}
    assert (MESH.pose_id, MESH.capture_ns) == (7, 123)


def test_each_view_keeps_its_part_of_the_texture() -> None:
    views = capsule_views(arms_down_by(ANGLE_RAD))
    meshes = [mesh_view(view, MESH_STRIDE) for view in views]
    texture = MESH.mesh.texture
    assert texture.shape == (max(v.colour.shape[0] for v in views), sum(v.colour.shape[1] for v in views), 3)
    left = first = 0
    for view, mesh in zip(views, meshes, strict=True):
        h, w = view.colour.shape[:2]
        np.testing.assert_array_equal(texture[:h, left : left + w], view.colour)
        own = MESH.mesh.uv[first : first + len(mesh.uv)] * texture.shape[1::-1] - [left, 0]
        np.testing.assert_allclose(own, mesh.uv * [w, h], atol=1e-3)
        assert own.min() > 0.499
        assert (own.max(axis=0) < [w - 0.499, h - 0.499]).all()  # a blend of its own pixels only
        left, first = left + w, first + len(mesh.uv)


def test_link_frames_are_those_of_the_capture() -> None:
    product = MESH.T_link_world @ links_of(arms_down_by(ANGLE_RAD))
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(4), product.shape), atol=1e-6)


def test_joint_edges_are_the_edges_between_links_each_once() -> None:
    edges = joint_edges(MESH.mesh.vertices, MESH.mesh.faces, REGIONS, MESH.T_link_world, most=ALL)
    found = [(min(a, b), max(a, b)) for a, b in edges.vertices.tolist()]
    expected = {(a, b) for a, b in all_edges() if MESH.vertex_link[a] != MESH.vertex_link[b]}
    assert len(found) == len(set(found)) == len(edges)
    assert set(found) == expected


@pytest.mark.parametrize("form", get_args(ScoreForm))
def test_of_many_joint_edges_a_sample_of_each_seam_is_kept(form: ScoreForm) -> None:
    every, sample = (
        joint_edges(MESH.mesh.vertices, MESH.mesh.faces, REGIONS, MESH.T_link_world, form, most) for most in (ALL, 500)
    )
    assert 400 < len(sample) < 600 < len(every) / 2
    np.testing.assert_array_equal(sample.pair_regions, every.pair_regions)
    assert set(map(tuple, sample.vertices.tolist())) < set(map(tuple, every.vertices.tolist()))
    step = -(-len(every) // 500)
    np.testing.assert_array_equal(np.diff(sample.pair_starts), -(-np.diff(every.pair_starts) // step))
    seen = every.region_lengths > 0
    shares = sample.region_lengths[seen] / every.region_lengths[seen]
    assert abs(shares.mean() * step - 1) < 0.15


def test_joint_edges_are_grouped_by_region_pair() -> None:
    edges = MESH.joint_edges
    counts = np.diff(edges.pair_starts)
    np.testing.assert_array_equal(MESH.vertex_link[edges.vertices], np.repeat(edges.pair_links, counts, axis=0))
    np.testing.assert_array_equal(REGIONS[edges.vertices], np.repeat(edges.pair_regions, counts, axis=0))
    assert len(np.unique(edges.pair_regions, axis=0)) == len(edges.pair_regions)
    assert (edges.pair_regions[:, 0] < edges.pair_regions[:, 1]).all()


def test_joint_edges_hold_their_ends_in_link_frames() -> None:
    edges = MESH.joint_edges
    e = len(edges) // 2
    for k in (0, 1):
        vertex = edges.vertices[e, k]
        local = transform_points(MESH.T_link_world[MESH.vertex_link[vertex]], MESH.mesh.vertices[vertex][None])[0]
        np.testing.assert_allclose(edges.points[3 * k : 3 * k + 3, e], local, atol=1e-5)
    a, b = MESH.mesh.vertices[edges.vertices[e]]
    assert edges.rest_lengths[e] == pytest.approx(np.linalg.norm(a - b), rel=1e-5)


def test_an_edge_counts_in_both_its_regions() -> None:
    edges = MESH.joint_edges
    assert edges.region_lengths.sum() == pytest.approx(2 * edges.rest_lengths.sum(), rel=1e-4)
    foot = REGION_INDEX["left_foot"]
    own = (REGIONS[edges.vertices] == foot).any(axis=1)
    assert edges.region_lengths[foot] == pytest.approx(edges.rest_lengths[own].sum(), rel=1e-4)


def test_what_eq_1_divides_by_can_be_all_edges_or_a_fixed_length() -> None:
    every, fixed = (
        joint_edges(MESH.mesh.vertices, MESH.mesh.faces, REGIONS, MESH.T_link_world, form, ALL)
        for form in ("all-edges", "fixed-length")
    )
    ends = np.array(sorted(all_edges()))
    lengths = np.linalg.norm(MESH.mesh.vertices[ends[:, 0]] - MESH.mesh.vertices[ends[:, 1]], axis=1)
    for region in (REGION_INDEX["head"], REGION_INDEX["left_shin"]):
        own = (REGIONS[ends] == region).any(axis=1)
        joining = own & (REGION_LINKS[REGIONS[ends]][:, 0] != REGION_LINKS[REGIONS[ends]][:, 1])
        assert every.region_lengths[region] == pytest.approx(lengths[own].sum(), rel=1e-4)
        assert fixed.region_lengths[region] == pytest.approx(FIXED_EDGE_M * joining.sum(), rel=1e-4)
        assert 0 < joining.sum() < own.sum()


def test_bridges_over_occlusions_count_but_are_not_drawn() -> None:
    faces, vertices = MESH.mesh.faces, MESH.mesh.vertices
    longest = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=-1).max(axis=1)
    drawn = len(MESH.faces_drawn)
    assert 0 < drawn < len(faces)
    np.testing.assert_array_equal(MESH.faces_drawn, faces[:drawn])
    assert longest[:drawn].max() <= DRAWN_EDGE_M
    assert (longest[drawn:] > DRAWN_EDGE_M).sum() > 100
    assert MESH.joint_edges.rest_lengths.max() > DRAWN_EDGE_M


def steps_apart(a: int, b: int) -> int:
    """Links on the way from one to the other in the tree."""
    chains = [[link] for link in (a, b)]
    for chain in chains:
        while chain[-1] > 0:
            chain.append(LINK_PARENTS[chain[-1]])
    return len(set(chains[0]) ^ set(chains[1]))


def test_links_that_only_touch_are_not_drawn_joined() -> None:
    mesh = captured(1.5)  # arms against the body
    pairs = np.sort(mesh.vertex_link[mesh.mesh.faces[:, [[0, 1], [1, 2], [2, 0]]]].reshape(-1, 2), axis=1)
    ends = mesh.mesh.vertices[mesh.mesh.faces[:, [[0, 1], [1, 2], [2, 0]]]].reshape(-1, 2, 3)
    short = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) < DRAWN_EDGE_M
    touching = {pair for pair in map(tuple, pairs[short].tolist()) if steps_apart(*pair) > DRAWN_LINK_STEPS}
    assert len(touching) > 2  # arm and trunk
    drawn = np.sort(mesh.vertex_link[mesh.faces_drawn[:, [[0, 1], [1, 2], [2, 0]]]].reshape(-1, 2), axis=1)
    joined = set(map(tuple, drawn.tolist()))
    assert not joined & touching
    assert (LINK_INDEX["left_forearm"], LINK_INDEX["left_hand"]) in joined


def test_drawn_triangles_do_not_stretch_far_when_the_arms_part_from_the_body() -> None:
    moved = animate(MESH, link_motion(MESH, links_of(arms_down_by(0.5))), "rigid")
    edges = moved[MESH.faces_drawn] - moved[np.roll(MESH.faces_drawn, 1, axis=1)]
    hands = np.isin(MESH.vertex_link[MESH.faces_drawn], [LINK_INDEX["left_hand"], LINK_INDEX["left_fingers"]])
    assert np.linalg.norm(edges, axis=-1)[hands.any(axis=1)].max() < 0.12


def test_memory_is_counted() -> None:
    assert MESH.nbytes > 12 * (len(MESH.mesh.vertices) + len(MESH.mesh.faces))
    assert MESH.faces_drawn.base is MESH.mesh.faces  # drawn triangles cost none


def test_views_without_a_surface_are_refused() -> None:
    nothing = View(ring_camera(0), 0, 0, np.zeros((8, 8), np.uint16), np.zeros((8, 8, 3), np.uint8))
    for views in ((), (nothing,)):
        with pytest.raises(ValueError, match="pose 3"):
            build_rigged_mesh(3, 0, SKELETON, arms_down_by(0), views)


def test_a_person_of_whom_nothing_can_be_drawn_is_refused() -> None:
    camera = ring_camera(0)
    steps = np.zeros((8, 8), np.uint16)
    steps[::2], steps[1::2] = 2000, 2500  # every triangle spans half a metre
    view = View(camera, 90, 60, np.repeat(np.repeat(steps, 2, axis=0), 2, axis=1), np.zeros((16, 16, 3), np.uint8))
    with pytest.raises(ValueError, match=r"pose 3: nothing of its \d+ triangles"):
        build_rigged_mesh(3, 0, SKELETON, arms_down_by(0), [view])


def test_every_link_is_known() -> None:
    assert MESH.vertex_link.max() < LINK_COUNT
