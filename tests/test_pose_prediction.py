"""Where a person is expected next, and when they count as lost."""

from __future__ import annotations

import numpy as np

from common.body.skeleton import LINK_COUNT
from sender.fitting.articulated_gauss_newton import PoseState
from sender.fitting.joint_limits import joint_table
from sender.fitting.pose_prediction import LossTimer, predicted_poses


def at(x_m: float) -> PoseState:
    return PoseState(np.array([x_m, 1.0, 0.0]), np.tile(np.eye(3), (LINK_COUNT, 1, 1)))


def test_the_last_step_goes_on_in_proportion_to_the_time_passed() -> None:
    axis = joint_table().twist_axis
    full, still = predicted_poses(at(0.1), at(0.0), (30, 20), 50, (1.0, 0.0), axis)
    np.testing.assert_allclose(full.root, [0.3, 1.0, 0.0])
    np.testing.assert_allclose(still.root, [0.1, 1.0, 0.0])
    (long_after,) = predicted_poses(at(0.1), at(0.0), (30, 20), 5000, (1.0,), axis)
    np.testing.assert_allclose(long_after.root, [0.4, 1.0, 0.0])


def test_without_a_velocity_there_is_the_pose_itself() -> None:
    axis, now = joint_table().twist_axis, at(0.1)
    assert predicted_poses(now, None, (30, 20), 40, (1.0, 0.0), axis) == [now]
    assert predicted_poses(now, at(0.0), (30, 30), 40, (1.0, 0.0), axis) == [now]


def test_a_person_is_lost_after_a_while_of_bad_fits() -> None:
    loss = LossTimer(1.0)
    loss.seen_well(5_000_000_000)
    assert not loss.lost(6_000_000_000)
    assert loss.lost(6_000_000_001)
