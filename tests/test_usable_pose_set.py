"""DISPOSE §6.1: which poses enter the usable set, what they are worth, and what a transmission leaves of it."""

from __future__ import annotations

import numpy as np
import pytest

from sender.candidate_poses.usable_pose_set import UsablePoseSet, UsablePoseSettings, Verdict
from tests.capsule_views import FRAME_NS, arms_down_by, captured, links_of

GOOD = 0.05  # a threshold that arms 0.1 rad apart meet and arms 0.4 rad apart do not


class Session:
    """A usable set whose threshold stays where the test puts it, and a running clock."""

    def __init__(self, settings: UsablePoseSettings | None = None) -> None:
        self.poses = UsablePoseSet(settings)
        self.frame = 0

    def skeletons(self, *angles_rad: float) -> None:
        for angle in angles_rad:
            self.frame += 1
            self.poses.add_skeleton(self.frame * FRAME_NS, links_of(arms_down_by(angle)))
        self.poses.threshold.value = GOOD

    def pose(self, pose_id: int, angle_rad: float) -> tuple[Verdict, tuple[int, ...]]:
        """Capture a pose together with its skeleton, as the sender does."""
        self.skeletons(angle_rad)
        admission = self.poses.add_pose(captured(angle_rad, pose_id, self.frame * FRAME_NS))
        return admission.verdict, admission.removed


def test_a_pose_that_animates_a_buffered_skeleton_is_added() -> None:
    session = Session()
    session.skeletons(0.4)
    assert session.pose(1, 0.5) == (Verdict.ADDED, ())
    assert set(session.poses.quotients()) == {1}


def test_its_own_skeleton_does_not_speak_for_it() -> None:
    session = Session()
    session.skeletons(1.25, 1.3)
    assert session.pose(1, 0.4) == (Verdict.REJECTED, ())
    assert session.poses.quotients() == {}


def test_a_pose_replaces_those_it_animates() -> None:
    session = Session()
    session.skeletons(0.4, 1.3)
    session.pose(1, 0.5)
    session.pose(2, 1.32)
    assert session.pose(3, 0.55) == (Verdict.REPLACES, (1,))
    assert set(session.poses.quotients()) == {2, 3}


def test_rigging_quotient_is_the_share_of_skeletons_animated() -> None:
    session = Session()
    session.skeletons(0.4, 0.45, 1.3)
    session.pose(1, 0.5)  # animates its own, 0.4 and 0.45, not 1.3
    assert session.poses.quotients()[1] == pytest.approx(3 / 4)
    session.skeletons(1.25, 1.3, 1.35, 0.55)  # skeletons after it count too
    assert session.poses.quotients()[1] == pytest.approx(4 / 8)


def test_a_full_set_gives_up_its_lowest_quotient() -> None:
    session = Session(UsablePoseSettings(max_poses=2))
    session.skeletons(0.4, 0.4, 0.85, 1.3, 1.3)
    session.pose(1, 0.45)
    session.pose(2, 0.87)
    assert session.pose(3, 1.32) == (Verdict.ADDED, (2,))


def test_the_skeleton_buffer_forgets_the_oldest() -> None:
    session = Session(UsablePoseSettings(max_skeletons=3))
    session.skeletons(0.4, 1.3, 1.3)
    assert session.pose(1, 0.5)[0] is Verdict.REJECTED  # its own skeleton pushed 0.4 out
    assert session.poses.quotients() == {}


def test_a_transmission_drops_earlier_poses_and_skeletons() -> None:
    session = Session()
    session.skeletons(0.4, 0.45, 0.45, 0.85)
    session.pose(1, 0.5)
    session.pose(2, 0.87)
    session.skeletons(1.3)
    session.pose(3, 1.32)
    session.skeletons(0.45, 1.3, 0.85, 0.45)
    chi = session.poses.quotients()
    assert chi[1] > chi[2] > 0
    result = session.poses.sent(3, retain_threshold=0.0)
    assert set(result.retained) == {1, 2}  # χ over what came after pose 3, which both animate in part
    assert session.poses.retained() == {1, 2}
    assert set(session.poses.quotients()) == {1, 2}
    assert session.poses.quotients()[1] == pytest.approx(2 / 5)  # pose 3's own skeleton and the four after it


def test_a_high_retain_threshold_drops_them() -> None:
    session = Session()
    session.skeletons(0.4, 1.3)
    session.pose(1, 0.45)
    session.pose(2, 1.32)
    assert session.poses.sent(2, retain_threshold=0.9).dropped == (1,)
    assert session.poses.quotients() == {}


def test_later_poses_stay_whatever_they_are_worth() -> None:
    session = Session()
    session.skeletons(0.4, 1.3)
    session.pose(1, 0.45)
    session.pose(2, 1.32)
    result = session.poses.sent(1, retain_threshold=1.0)
    assert (result.retained, result.dropped) == ((), ())
    assert set(session.poses.quotients()) == {2}
    assert session.poses.retained() == frozenset()


def test_sending_what_has_left_the_set_changes_nothing() -> None:
    session = Session()
    session.skeletons(0.3)
    session.pose(1, 0.35)
    assert session.poses.sent(99, 0.0).dropped == ()
    assert set(session.poses.quotients()) == {1}


def test_threshold_follows_what_the_receivers_can_show() -> None:
    poses = UsablePoseSet()
    poses.add_skeleton(1, links_of(arms_down_by(0.3)))
    assert poses.threshold.frames == 0  # nothing to judge by
    poses.add_skeleton(2, links_of(arms_down_by(0.4)))
    poses.add_pose(captured(0.4, 1, 2))
    poses.sent(1, 0.0)
    poses.add_skeleton(3, links_of(arms_down_by(1.2)))
    far = poses.threshold.value
    assert far > GOOD
    for frame in range(50):
        poses.add_skeleton(4 + frame, links_of(arms_down_by(0.4)))
    assert poses.threshold.value < 0.2 * far


def test_an_empty_buffer_gives_no_quotient() -> None:
    poses = UsablePoseSet()
    poses.threshold.value = GOOD
    poses.add_pose(captured(0.4, 1, 1))
    assert all(np.isfinite(chi) for chi in poses.quotients().values())
