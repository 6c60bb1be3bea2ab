"""Every surface point goes to the link it grew from."""

from __future__ import annotations

import numpy as np
import pytest

from common.body.link_segmentation import CAP_M, FLESH_M, nearest_link
from common.body.skeleton import LINK_INDEX
from common.body.skeleton_pose import bone_segments
from tests.capsule_person import SKELETON
from tests.capsule_views import arms_down_by, links_of


def test_points_around_a_bones_middle_belong_to_it() -> None:
    T_world_link = links_of(arms_down_by(0.9))
    starts, ends = bone_segments(SKELETON, T_world_link)
    middles = ((starts + ends) / 2).astype(np.float32)
    np.testing.assert_array_equal(nearest_link(middles, SKELETON, T_world_link), np.arange(len(middles)))


@pytest.mark.parametrize("name", ["head", "left_forearm", "right_upper_arm", "left_shin", "right_foot", "lower_spine"])
def test_a_cylinders_side_belongs_to_it(name: str) -> None:
    T_world_link = links_of(arms_down_by(0.9))
    starts, ends = bone_segments(SKELETON, T_world_link)
    link = LINK_INDEX[name]
    axis = (ends[link] - starts[link]) / np.linalg.norm(ends[link] - starts[link])
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side *= SKELETON.radii[link] / np.linalg.norm(side)
    around = np.stack([side, np.cross(axis, side), -side, -np.cross(axis, side)])
    points = (starts[link] + ends[link]) / 2 + around
    np.testing.assert_array_equal(nearest_link(points.astype(np.float32), SKELETON, T_world_link), link)


def test_it_is_the_smallest_distance_relative_to_the_thickness() -> None:
    T_world_link = links_of(arms_down_by(1.3))
    points = np.random.default_rng(2).uniform([-0.9, 0, -0.3], [0.9, 1.8, 0.3], (500, 3)).astype(np.float32)
    starts, ends = (bones.astype(float) for bones in bone_segments(SKELETON, T_world_link))
    axes = ends - starts
    lengths = np.linalg.norm(axes, axis=1)
    along = np.einsum("vlk,lk->vl", points[:, None] - starts, axes / lengths[:, None])
    across = np.linalg.norm(points[:, None] - starts - along[..., None] * (axes / lengths[:, None]), axis=-1)
    beyond = np.maximum(0, np.maximum(-along, along - lengths))
    thickness = SKELETON.radii + FLESH_M
    distance = np.hypot(across / thickness, beyond / np.minimum(thickness, CAP_M))
    links = nearest_link(points, SKELETON, T_world_link)
    np.testing.assert_allclose(distance[np.arange(len(points)), links], distance.min(axis=1), rtol=1e-3)
    assert links.dtype == np.uint8


def test_a_thick_link_reaches_further_than_a_thin_one() -> None:
    T_world_link = links_of(arms_down_by(1.45))
    starts, _ = bone_segments(SKELETON, T_world_link)
    arm, spine = LINK_INDEX["left_forearm"], LINK_INDEX["lower_spine"]
    level = starts[arm] * [0, 1, 0]
    beside = level + (starts[arm] - level) * 0.5  # half way between the axes of torso and arm
    assert nearest_link(beside[None].astype(np.float32), SKELETON, T_world_link)[0] != arm
    assert SKELETON.radii[spine] > SKELETON.radii[arm]


def test_the_torso_does_not_reach_over_its_end_into_neck_and_jaw() -> None:
    T_world_link = links_of(arms_down_by(0.9))
    head = T_world_link[LINK_INDEX["head"], :3, 3]
    jaw = head + np.array([0, 0.01, 0.09], np.float32)
    assert nearest_link(jaw[None], SKELETON, T_world_link)[0] in (LINK_INDEX["neck"], LINK_INDEX["head"])
