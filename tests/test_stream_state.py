"""What the HUD says, by the clock."""

from __future__ import annotations

import dataclasses

import numpy as np

from common.body.body_regions import REGION_COUNT, REGION_INDEX
from common.body.skeleton import LINK_COUNT
from common.runtime.clock import ManualClock
from receiver.stream_state import StreamState
from receiver.viewer.viewer import ConnectionState, ShownFrame

FRAME_NS = 33_333_333


def frame(pose_id: int | None) -> ShownFrame:
    motion = None if pose_id is None else np.zeros((LINK_COUNT, 3, 4), np.float32)
    joints, confidence = np.zeros((LINK_COUNT, 3), np.float32), np.ones(LINK_COUNT, np.float32)
    return ShownFrame(0, 1, pose_id, motion, joints, 0.4 if pose_id is not None else float("nan"), 1.0, confidence)


def test_distortion_is_told_for_the_regions_seen_of_the_pose_on_screen():
    state = StreamState(ManualClock())
    assert state.region_sigma == {}
    sigma = np.full(REGION_COUNT, np.nan, np.float32)
    sigma[REGION_INDEX["left_palm"]], sigma[REGION_INDEX["head"]] = 0.5, 0.0
    state.shown(dataclasses.replace(frame(7), region_sigma=sigma), 1)
    assert state.region_sigma == {"left_palm": 0.5, "head": 0.0}
    assert state.status(None, 0, 0).region_sigma == state.region_sigma
    state.shown(frame(None), 1)
    assert state.region_sigma == {}


def test_first_sight_is_that_of_the_first_mesh_not_of_joints():
    clock = ManualClock()
    state = StreamState(clock)
    state.shown(frame(None), 0)
    assert state.first_body_ns is None
    for _ in range(2):
        clock.advance(FRAME_NS)
        state.shown(frame(7), 1)
    assert state.first_body_ns == clock.now_ns() - FRAME_NS


def test_before_anything_came_it_waits():
    state = StreamState(ManualClock())
    status = state.status(None, 0, 0)
    assert status.connection is ConnectionState.WAITING
    assert status.detail == ""
    assert not state.receiving


def test_that_a_path_carries_fewer_skeletons_is_said():
    state = StreamState(ManualClock())
    state.skeleton()
    assert "path" not in state.status(None, 0, 0, skeleton_divisor=1).detail
    assert state.status(None, 0, 0, skeleton_divisor=4).detail.startswith("1 in 4 skeletons")


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


def test_a_sender_that_left_is_told_apart_from_one_that_sees_nobody():
    clock = ManualClock()
    state = StreamState(clock)
    state.presence(True)
    state.skeleton()
    clock.advance(2_000_000_000)
    assert state.status(None, 0, 0).connection is ConnectionState.WAITING
    state.presence(False)
    status = state.status(None, 0, 0)
    assert status.connection is ConnectionState.LOST
    assert "has left" in status.detail


def test_two_senders_of_one_name_are_flagged_but_not_the_last_packets_of_a_run_that_ended():
    clock = ManualClock()
    state = StreamState(clock)
    details = []
    for frame_number in range(200):
        clock.advance(FRAME_NS)
        state.skeleton()
        foreign = 3 + max(0, frame_number - 100)
        details.append(state.status(None, 0, 0, foreign).detail)
    assert not any("two senders" in detail for detail in details[:110])
    assert all("two senders" in detail for detail in details[-80:])
    clock.advance(10_000_000_000)
    state.skeleton()
    state.status(None, 0, 0, foreign)
    clock.advance(3_000_000_000)
    state.skeleton()
    assert "two senders" not in state.status(None, 0, 0, foreign).detail
