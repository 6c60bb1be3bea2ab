"""What the HUD says, by the clock."""

from __future__ import annotations

import numpy as np

from common.body.skeleton import LINK_COUNT
from common.runtime.clock import ManualClock
from receiver.stream_state import StreamState
from receiver.viewer.viewer import ConnectionState, ShownFrame

FRAME_NS = 33_333_333


def frame(pose_id: int | None) -> ShownFrame:
    motion = None if pose_id is None else np.zeros((LINK_COUNT, 3, 4), np.float32)
    joints, confidence = np.zeros((LINK_COUNT, 3), np.float32), np.ones(LINK_COUNT, np.float32)
    return ShownFrame(0, 1, pose_id, motion, joints, 0.4 if pose_id is not None else float("nan"), 1.0, confidence)


def test_before_anything_came_it_waits():
    state = StreamState(ManualClock())
    status = state.status(None, 0, 0)
    assert status.connection is ConnectionState.WAITING
    assert status.detail == ""
    assert not state.receiving


def test_a_sender_without_a_person_is_told_apart_from_no_sender():
    state = StreamState(ManualClock())
    state.presence(True)
    status = state.status(None, 0, 0)
    assert status.connection is ConnectionState.WAITING
    assert "nobody" in status.detail


def test_rates_are_those_of_the_last_two_seconds():
    clock = ManualClock()
    state = StreamState(clock)
    state.status(None, 0, 0)
    for number in range(60):
        clock.advance(FRAME_NS)
        state.skeleton()
        state.shown(frame(7), 3)
        status = state.status(12.0, 250 * (number + 1), 1000 * (number + 1))
    assert abs(status.frame_rate_hz - 30) < 0.1
    assert abs(status.skeleton_bps - 60_000) < 300
    assert abs(status.bulk_bps - 240_000) < 1200
    assert (status.repository_poses, status.chosen_pose, status.sigma, status.pose_age_ms) == (3, 7, 0.4, 12.0)
    assert status.connection is ConnectionState.RECEIVING


def test_silence_after_skeletons_is_a_lost_connection_and_ends_with_the_next():
    clock = ManualClock()
    state = StreamState(clock)
    state.skeleton()
    state.shown(frame(None), 0)
    assert "first mesh" in state.status(None, 250, 0).detail
    clock.advance(2_000_000_000)
    assert state.status(None, 250, 0).connection is ConnectionState.LOST
    state.skeleton()
    assert state.status(None, 500, 0).connection is ConnectionState.RECEIVING
