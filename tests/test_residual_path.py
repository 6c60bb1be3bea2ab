"""The third layer before a real rig: packets that follow the budget, keys when asked, points that are the person's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.runtime.clock import ManualClock
from common.runtime.stage_timer import StageTimer
from common.wire.body_message import decode_body
from common.wire.residual_packet import decode_residual_header
from common.wire.residual_video import frame_count
from receiver.residual_decoder import ResidualDecoder, cloud
from sender.config import ResidualStreamSettings
from sender.pipeline import TrackedFrame
from sender.residual_path import Residual, ResidualPath
from tests.rig_scene import IDENTITY, RATE_HZ, performer, renderer, tracked


def path(video_frames: int = 0) -> ResidualPath:
    timer, settings = StageTimer(ManualClock()), ResidualStreamSettings(video_frames=video_frames)
    return ResidualPath(IDENTITY, renderer().cameras, RATE_HZ, settings, timer)


def frames() -> list[TrackedFrame]:
    return [frame for frame in tracked() if frame.packet is not None]


def coded(ours: ResidualPath, bytes_per_s: float, some: list[TrackedFrame]) -> list[Residual]:
    ours.note_budget(bytes_per_s)
    return [residual for frame in some if (residual := ours.process(frame)) is not None]


@pytest.mark.parametrize("bytes_per_s", [30_000, 90_000])
def test_packets_take_what_they_may(bytes_per_s):
    packets = coded(path(), bytes_per_s, frames() * 2)[8:]  # once it is known what a frame takes
    spent = sum(len(packet.data) for packet in packets) / len(packets) * RATE_HZ
    assert spent == pytest.approx(bytes_per_s, rel=0.3)


def test_a_pause_does_not_count_as_a_slow_rate():
    ours = path()
    before = coded(ours, 60_000, frames() * 2)[-1]
    later = [replace(frame, capture_ns=frame.capture_ns + 60_000_000_000) for frame in frames()]
    after = coded(ours, 60_000, later[:3])
    assert [packet.level for packet in after] == pytest.approx([before.level] * 3, rel=0.25)


def test_with_ample_bandwidth_the_level_is_full_and_without_any_only_the_model_goes():
    assert coded(path(), 1e7, frames()[:5])[-1].level == 100
    only = coded(path(), 100, frames()[:10])
    assert [(packet.sequence, packet.key) for packet in only] == [(0, 0)]


def test_what_is_decoded_is_the_person():
    last = frames()[-1]
    decoder, bodies = ResidualDecoder(), {}
    for frame in frames():
        if frame.body is not None:
            message = decode_body(frame.body)
            bodies[message.revision] = message.skeleton
    ours = path()
    for packet in coded(ours, 1e6, frames()[-3:]):
        decoder.decode(packet.data, bodies)
    assert decoder.newest is not None
    assert decoder.newest.header.capture_ns == last.capture_ns
    assert last.T_world_link is not None
    points = cloud(decoder.newest, last.T_world_link).positions
    surface = performer().surface(last.capture_ns / 1e9)
    distances = np.linalg.norm(points[::29, None] - surface[None], axis=2).min(axis=1)
    assert np.median(distances) < 0.012
    assert len(points) > 4000


def test_a_key_comes_when_it_is_asked_for_and_once():
    ours = path()
    coded(ours, 1e5, frames()[:3])
    ours.request_key()
    kinds = [decode_residual_header(packet.data).kind for packet in coded(ours, 1e5, frames()[3:6])]
    assert kinds == ["key", "model", "model"]


def test_groups_take_what_they_may_and_a_live_surface_gets_frames_by_themselves():
    pytest.importorskip("av")
    ours = path(video_frames=5)
    groups = coded(ours, 30_000, frames() * 3)
    assert [packet.sequence for packet in groups] == [5 * n for n in range(len(groups))]
    assert all(packet.key == packet.sequence and frame_count(packet.data) == 5 for packet in groups)
    spent = sum(len(packet.data) for packet in groups[4:]) / (5 * len(groups[4:])) * RATE_HZ
    assert spent == pytest.approx(30_000, rel=0.3)
    ours.note_budget(30_000, for_points=False)
    assert all(frame_count(packet.data) == 1 for frame in frames()[:4] if (packet := ours.process(frame)))


def test_a_frame_without_views_gives_nothing():
    assert path().process(TrackedFrame(0, (), None)) is None
