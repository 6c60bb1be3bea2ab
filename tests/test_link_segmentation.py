"""Every surface point goes to the link it grew from."""

from __future__ import annotations

import numpy as np

from common.body.link_segmentation import FLESH_M, nearest_link
from common.body.skeleton import LINK_INDEX
from common.body.skeleton_pose import bone_segments
from tests.capsule_person import SKELETON, capsule_person
from tests.capsule_views import arms_down_by, links_of


def test_points_around_a_bones_middle_belong_to_it() -> None:
    T_world_link = links_of(arms_down_by(0.9))
    starts, ends = bone_segments(SKELETON, T_world_link)
    middles = ((starts + ends) / 2).astype(np.float32)
    np.testing.assert_array_equal(nearest_link(middles, SKELETON, T_world_link), np.arange(len(middles)))


def test_most_of_a_capsule_person_goes_to_its_own_capsule() -> None:
    pose = arms_down_by(0.9)
    person = capsule_person(pose=pose)
    found = nearest_link(person.mesh.vertices, SKELETON, links_of(pose))
    for name in ("head", "left_forearm", "right_upper_arm", "left_shin", "right_thigh", "upper_spine"):
        own = person.vertex_link == LINK_INDEX[name]
        assert (found[own] == LINK_INDEX[name]).mean() > 0.6, name


def test_it_is_the_smallest_distance_relative_to_the_thickness() -> None:
    T_world_link = links_of(arms_down_by(1.3))
    points = np.random.default_rng(2).uniform([-0.9, 0, -0.3], [0.9, 1.8, 0.3], (500, 3)).astype(np.float32)
    starts, ends = (bones.astype(float) for bones in bone_segments(SKELETON, T_world_link))
    axes = ends - starts
    along = np.einsum("vlk,lk->vl", points[:, None] - starts, axes) / np.einsum("lk,lk->l", axes, axes)
    nearest = starts + np.clip(along, 0, 1)[..., None] * axes
    distance = np.linalg.norm(points[:, None] - nearest, axis=-1) / (SKELETON.radii + FLESH_M)
    links = nearest_link(points, SKELETON, T_world_link)
    np.testing.assert_allclose(distance[np.arange(len(points)), links], distance.min(axis=1), rtol=1e-4)
    assert links.dtype == np.uint8


def test_a_thick_link_reaches_further_than_a_thin_one() -> None:
    T_world_link = links_of(arms_down_by(1.45))
    starts, _ = bone_segments(SKELETON, T_world_link)
    arm, spine = LINK_INDEX["left_forearm"], LINK_INDEX["lower_spine"]
    level = starts[arm] * [0, 1, 0]
    beside = level + (starts[arm] - level) * 0.5  # half way between the axes of torso and arm
    assert nearest_link(beside[None].astype(np.float32), SKELETON, T_world_link)[0] != arm
    assert SKELETON.radii[spine] > SKELETON.radii[arm]
