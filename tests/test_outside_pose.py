"""A sensor's joints become our sizes and pose, and back."""

from __future__ import annotations

import numpy as np
import pytest

from common.body.skeleton import LINK_INDEX, LINK_NAMES, NAMED_JOINTS, Skeleton
from common.body.skeleton_pose import forward_kinematics, named_joint_positions
from common.geometry import quaternion
from sender.capture.outside_skeleton import JOINTS_BY_KIND, KINECT_V1_JOINTS, KINECT_V2_JOINTS
from sender.fitting.bone_lengths import SAMPLES, RunningMedian, bones_of
from sender.fitting.outside_joints import joint_links, link_of, sensor_joints
from sender.fitting.outside_pose import OutsidePose
from sender.fitting.outside_sizes import OutsideSizes
from tests.capsule_person import SKELETON, pose_at
from tests.outside_people import bent_pose, row_of

KINDS = ("kinect-v1", "kinect-v2")
LIMBS = [LINK_INDEX[f"{s}_{part}"] for s in ("left", "right") for part in ("upper_arm", "forearm", "thigh", "shin")]


def measured(kind: str, poses: int = 64) -> Skeleton:
    sizes = OutsideSizes(kind)
    for seed in range(poses):
        sizes.update(sensor_joints(SKELETON, bent_pose(seed), kind))
    return sizes.skeleton


@pytest.mark.parametrize("kind", KINDS)
def test_every_joint_has_a_link_and_left_stays_left(kind):
    for joint, link in zip(JOINTS_BY_KIND[kind], joint_links(kind), strict=True):
        for side in ("left", "right"):
            assert LINK_NAMES[link].startswith(side) == joint.startswith(side)


def test_the_joints_we_measure_ourselves_by_are_where_the_sensors_have_theirs():
    ours = dict(NAMED_JOINTS)
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
        for side in ("left", "right"):
            assert link_of(f"{side}_{part}") == ours[f"{side}_{part}"]
    assert link_of("spine_base") == link_of("hip_centre") == ours["pelvis"]
    assert link_of("spine_mid") == ours["chest"]
    assert link_of("spine_shoulder") == link_of("shoulder_centre") == ours["neck"]


def test_the_orders_are_the_sensors():
    assert (len(KINECT_V1_JOINTS), len(KINECT_V2_JOINTS)) == (20, 25)
    assert KINECT_V1_JOINTS[4:8] == ("left_shoulder", "left_elbow", "left_wrist", "left_hand")
    assert KINECT_V2_JOINTS[16:21] == ("right_hip", "right_knee", "right_ankle", "right_foot", "spine_shoulder")


@pytest.mark.parametrize("kind", KINDS)
def test_bones_form_a_tree_from_the_hips_outwards(kind):
    bones = bones_of(kind)
    reached = {int(bones[0, 0])}
    for parent, joint in bones:
        assert parent in reached
        assert joint not in reached
        reached.add(int(joint))
    assert len(reached) == len(JOINTS_BY_KIND[kind])


@pytest.mark.parametrize("seed", range(6))
def test_a_pose_survives_the_way_through_25_joints(seed):
    skeleton, pose = measured("kinect-v2"), bent_pose(100 + seed)
    joints = sensor_joints(SKELETON, pose, "kinect-v2")
    found = OutsidePose("kinect-v2").fit(skeleton, joints, np.ones(25))
    away = named_joint_positions(skeleton, found) - named_joint_positions(SKELETON, pose)
    assert np.linalg.norm(away, axis=1).max() < 0.003
    turned = (forward_kinematics(body, p)[LIMBS, :3, :3] for body, p in ((skeleton, found), (SKELETON, pose)))
    angles = quaternion.angle_between(*(quaternion.from_matrix(R.astype(float)) for R in turned))
    assert np.rad2deg(angles).max() < 6


@pytest.mark.parametrize("seed", range(3))
def test_and_through_20_joints_with_what_these_do_not_tell_guessed(seed):
    skeleton, pose = measured("kinect-v1"), bent_pose(200 + seed)
    joints = sensor_joints(SKELETON, pose, "kinect-v1")
    found = OutsidePose("kinect-v1").fit(skeleton, joints, np.ones(20))
    np.testing.assert_allclose(sensor_joints(skeleton, found, "kinect-v1"), joints, atol=0.008)
    away = named_joint_positions(skeleton, found) - named_joint_positions(SKELETON, pose)
    assert np.linalg.norm(away, axis=1).max() < 0.03


def test_an_outlier_does_not_change_the_sizes():
    sizes = OutsideSizes("kinect-v2")
    for seed in range(33):
        joints = sensor_joints(SKELETON, bent_pose(seed), "kinect-v2")
        if seed % 4 == 1:
            joints[row_of("left_knee")] += 0.3
        sizes.update(joints)
    np.testing.assert_allclose(sizes.skeleton.offsets[LINK_INDEX["left_shin"]], (0, -0.245 * 1.75, 0), atol=0.004)


def test_joints_that_were_never_seen_leave_the_rest_in_place_and_say_so():
    joints = sensor_joints(SKELETON, pose_at(0.7), "kinect-v2")
    confidence = np.ones(25)
    arm = [row_of(f"left_{joint}") for joint in ("elbow", "wrist", "hand", "hand_tip", "thumb")]
    joints[arm], confidence[arm] = np.nan, 0.0
    sizes = OutsideSizes("kinect-v2")
    skeleton = sizes.update(joints)
    pose = OutsidePose("kinect-v2").fit(skeleton, joints, confidence)
    assert (pose.confidence[[LINK_INDEX[f"left_{link}"] for link in ("upper_arm", "forearm", "hand")]] == 0).all()
    assert pose.confidence[LINK_INDEX["right_forearm"]] == 1
    np.testing.assert_allclose(pose.rotations[LINK_INDEX["left_forearm"]], (1, 0, 0, 0), atol=1e-6)
    here, there = named_joint_positions(skeleton, pose), named_joint_positions(SKELETON, pose_at(0.7))
    right = [row for row, (name, _) in enumerate(NAMED_JOINTS) if name.startswith("right")]
    np.testing.assert_allclose(here[right], there[right], atol=0.003)


def test_a_running_median_is_renewed_ever_more_seldom_and_at_last_no_more():
    median, values = RunningMedian(2), []
    for frame in range(2 * SAMPLES):
        values.append(float(median.update(np.array([frame, np.nan]))[0]))
    assert len(set(values)) == np.log2(SAMPLES) + 1
    assert values[-1] == (SAMPLES - 1) / 2
    assert median.settled
    assert np.isnan(median.value[1])
