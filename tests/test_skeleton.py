"""The link tree and its forward kinematics."""

import numpy as np
import pytest

from common.body.skeleton import (
    LINK_COUNT,
    LINK_INDEX,
    LINK_NAMES,
    LINK_PARENTS,
    NAMED_JOINTS,
    Skeleton,
    human_skeleton,
)
from common.body.skeleton_pose import (
    SkeletonPose,
    bone_segments,
    forward_kinematics,
    joint_positions,
    named_joint_positions,
    rest_pose,
)
from common.geometry import quaternion


def test_tree_has_parents_before_children_and_both_sides():
    assert LINK_COUNT == 23
    assert LINK_PARENTS[0] == -1
    assert all(parent < link for link, parent in enumerate(LINK_PARENTS) if link)
    assert sum(name.startswith("left_") for name in LINK_NAMES) == sum(name.startswith("right_") for name in LINK_NAMES)
    assert len(NAMED_JOINTS) == 16


def test_average_human_is_symmetric_and_as_tall_as_asked():
    skeleton = human_skeleton(1.8)
    joints = joint_positions(skeleton, rest_pose())
    for name in LINK_NAMES:
        if name.startswith("left_"):
            mirrored = joints[LINK_INDEX["right_" + name[5:]]] * [-1, 1, 1]
            np.testing.assert_allclose(joints[LINK_INDEX[name]], mirrored, atol=1e-6)
    starts, ends = bone_segments(skeleton, forward_kinematics(skeleton, rest_pose()))
    top = ends[LINK_INDEX["head"], 1]
    sole = min(ends[LINK_INDEX["left_toes"], 1], starts[LINK_INDEX["left_toes"], 1]) - skeleton.radii[-1]
    assert top - sole == pytest.approx(1.8, abs=0.06)


def random_pose(seed: int) -> SkeletonPose:
    rng = np.random.default_rng(seed)
    rotations = quaternion.from_rotation_vector(rng.normal(scale=0.5, size=(LINK_COUNT, 3)))
    return SkeletonPose(rng.normal(size=3), rotations, np.ones(LINK_COUNT))


def position_by_hand(skeleton: Skeleton, pose: SkeletonPose, link: int, point: np.ndarray) -> np.ndarray:
    """A point of a link's frame carried up the tree to the world, one link at a time."""
    turned = quaternion.to_matrix(pose.rotations[link].astype(float)) @ point
    if link == 0:
        return pose.root_position + turned
    return position_by_hand(skeleton, pose, LINK_PARENTS[link], skeleton.offsets[link] + turned)


def test_forward_kinematics_agrees_with_walking_up_the_tree():
    skeleton, pose = human_skeleton(1.7), random_pose(1)
    T = forward_kinematics(skeleton, pose)
    for link in range(LINK_COUNT):
        tip = T[link, :3, :3] @ skeleton.tips[link] + T[link, :3, 3]
        np.testing.assert_allclose(T[link, :3, 3], position_by_hand(skeleton, pose, link, np.zeros(3)), atol=1e-5)
        np.testing.assert_allclose(tip, position_by_hand(skeleton, pose, link, skeleton.tips[link]), atol=1e-5)


def test_turning_a_joint_moves_only_its_descendants():
    skeleton, pose = human_skeleton(1.7), rest_pose()
    rotations = pose.rotations.copy()
    rotations[LINK_INDEX["left_forearm"]] = quaternion.from_rotation_vector(np.array([0, 1.0, 0]))
    moved = joint_positions(skeleton, SkeletonPose(pose.root_position, rotations, pose.confidence))
    still = joint_positions(skeleton, pose)
    changed = {LINK_NAMES[i] for i in np.flatnonzero(np.abs(moved - still).max(axis=1) > 1e-6)}
    assert changed == {"left_hand", "left_fingers"}


def test_named_joints_are_the_origins_of_their_links():
    skeleton, pose = human_skeleton(1.7), random_pose(2)
    named = named_joint_positions(skeleton, pose)
    joints = joint_positions(skeleton, pose)
    for row, (_, link) in enumerate(NAMED_JOINTS):
        np.testing.assert_array_equal(named[row], joints[LINK_INDEX[link]])


@pytest.mark.parametrize("bad", ["shape", "nan", "length"])
def test_impossible_poses_are_refused(bad):
    pose = rest_pose()
    rotations = pose.rotations.copy()
    if bad == "shape":
        rotations = rotations[:-1]
    elif bad == "nan":
        rotations[3, 0] = np.nan
    else:
        rotations[3] *= 2
    with pytest.raises(ValueError, match="rotations"):
        SkeletonPose(pose.root_position, rotations, pose.confidence)


def test_skeleton_refuses_radii_that_are_not_positive():
    good = human_skeleton(1.7)
    with pytest.raises(ValueError, match="positive"):
        Skeleton(good.offsets, good.tips, np.zeros(LINK_COUNT))
