"""A skeleton made from given joints has exactly these joints, whoever's they are."""

from __future__ import annotations

import numpy as np
import pytest

from common.body.skeleton import LINK_COUNT, human_skeleton
from common.body.skeleton_pose import named_joint_positions
from sender.fitting.start_joints import skeleton_from_joints, stature_of
from tests.capsule_person import SKELETON, pose_at
from tests.rig_scene import performer


@pytest.mark.parametrize("time_s", [0.0, 0.7, 1.9])
def test_the_joints_are_met_exactly(time_s):
    joints = named_joint_positions(SKELETON, pose_at(time_s)).astype(float)
    skeleton, pose = skeleton_from_joints(joints)
    np.testing.assert_allclose(named_joint_positions(skeleton, pose), joints, atol=1e-5)
    assert pose.confidence.shape == (LINK_COUNT,)


def test_another_body_in_an_a_pose_is_met_too():
    joints = performer().named_joints(0.5).astype(float)
    skeleton, pose = skeleton_from_joints(joints)
    np.testing.assert_allclose(named_joint_positions(skeleton, pose), joints, atol=1e-5)


@pytest.mark.parametrize("stature_m", [1.5, 1.75, 1.95])
def test_stature_does_not_depend_on_the_posture(stature_m):
    skeleton = human_skeleton(stature_m)
    estimates = [stature_of(named_joint_positions(skeleton, pose_at(t)).astype(float)) for t in (0.0, 0.9, 1.7)]
    assert np.ptp(estimates) < 0.01
    assert estimates[0] == pytest.approx(stature_m, abs=0.12)
