"""The jitter buffer on simulated paths: how evenly it plays, how close to the truth, how late, and never backwards.

Every path carries the same motion of known truth, as encoded packets; a display asks 60 times a second.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, human_skeleton
from common.body.skeleton_pose import SkeletonPose
from common.geometry import quaternion
from common.wire.skeleton_packet import SkeletonPacket, decode_skeleton, encode_skeleton
from receiver.jitter_buffer import AHEAD_MAX_NS, JitterBuffer

MS, S = 1_000_000, 1_000_000_000
FRAME_NS, TICK_NS = S // 30, S // 60
SECONDS = 12
BODY = human_skeleton(1.7)
OFFSET_NS = 123_456 * S  # the receiver's clock is ahead
LEAST_MS = 20.0
SWING = np.random.default_rng(0).uniform((0.1, 0.3, 0), (0.5, 1.2, 6.28), (LINK_COUNT, 3, 3))


def truth(capture_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Rotations (n, L, 4): every joint swings about every axis at a rate of its own, up to 1.2 Hz."""
    t = capture_ns[:, None, None] / S
    return quaternion.from_rotation_vector(SWING[..., 0] * np.sin(2 * np.pi * SWING[..., 1] * t + SWING[..., 2]))


def pose_at(capture_ns: int) -> SkeletonPose:
    rotations = truth(np.array([capture_ns]))[0].astype(np.float32)
    return SkeletonPose(np.array([0.3 * np.sin(capture_ns / S), 1, 0], np.float32), rotations, np.ones(LINK_COUNT))


@cache
def packets() -> tuple[SkeletonPacket, ...]:
    made, before = [], None
    for sequence in range(30 * SECONDS):
        capture_ns = S + sequence * FRAME_NS
        pose = pose_at(capture_ns)
        age_ns = FRAME_NS if before is not None else 0
        packet = SkeletonPacket(0, 1, sequence, capture_ns, 1, 1.0, pose, before, age_ns, 5 * MS)
        made.append(decode_skeleton(encode_skeleton(packet)))
        before = pose
    return tuple(made)


@dataclass
class Path:
    """Delays [ms] of the packets on their way, and which are lost."""

    delays_ms: NDArray[np.float64]
    lost: NDArray[np.bool_]

    def arrivals(self, sent: tuple[SkeletonPacket, ...]) -> list[tuple[int, SkeletonPacket]]:
        """As the skeleton buffer lets them pass: never an older one after a newer."""
        times = [packet.capture_ns + OFFSET_NS + int(d * MS) for packet, d in zip(sent, self.delays_ms, strict=True)]
        passed: list[tuple[int, SkeletonPacket]] = []
        for at_ns, index in sorted(zip(times, range(len(sent)), strict=True)):
            if not self.lost[index] and (not passed or sent[index].sequence > passed[-1][1].sequence):
                passed.append((at_ns, sent[index]))
        return passed


def path(name: str) -> Path:
    chance, count = np.random.default_rng(7), len(packets())
    never = np.zeros(count, bool)
    return {
        "steady": Path(np.full(count, LEAST_MS), never),
        "jitter": Path(LEAST_MS + chance.uniform(0, 20, count), never),
        "tail": Path(LEAST_MS + chance.exponential(8, count), never),
        "spikes": Path(LEAST_MS + 80 * (chance.random(count) < 0.02) + chance.uniform(0, 4, count), never),
        "loss": Path(LEAST_MS + chance.uniform(0, 4, count), chance.random(count) < 0.05),
    }[name]


@dataclass
class Shown:
    """What the display had at each tick: when, of which capture time, which rotations (n, L, 4)."""

    at_ns: NDArray[np.int64]
    capture_ns: NDArray[np.int64]
    rotations: NDArray[np.float64]
    buffer: JitterBuffer | None

    @property
    def delay_ms(self) -> float:
        """From capture to display, mean."""
        return float((self.at_ns - OFFSET_NS - self.capture_ns).mean() / MS)

    @property
    def unevenness_ms(self) -> float:
        """By how much the time shown goes on more or less than a tick from one to the next, RMS."""
        return float(np.sqrt(((np.diff(self.capture_ns) - np.diff(self.at_ns)) ** 2).mean()) / MS)

    @property
    def jerk(self) -> float:
        """Third derivative of the rotations less that of the true ones as late as these [1/s³], RMS."""
        delay_ns = int(np.median(self.at_ns - self.capture_ns))
        excess = np.diff(self._beside(truth(self.at_ns - delay_ns)), 3, axis=0) / (TICK_NS / S) ** 3
        return float(np.sqrt((excess**2).mean()))

    def error_mrad(self, ticks: slice | NDArray[np.bool_] = slice(None)) -> float:
        """Rotations beside the truth at the time shown, RMS."""
        off = self._beside(truth(self.capture_ns))[ticks]
        return float(2e3 * np.sqrt((off**2).sum(axis=2).mean()))

    def _beside(self, true: NDArray[np.float64]) -> NDArray[np.float64]:
        """q - q_true, of the two quaternions of a rotation the nearer one."""
        return self.rotations * np.sign((self.rotations * true).sum(axis=2, keepdims=True)) - true


def display(arrivals: list[tuple[int, SkeletonPacket]], smoothness: float) -> Shown:
    """A run of which the first two seconds do not count. ``smoothness`` 0: the newest wins, without a buffer."""
    buffer = JitterBuffer(smoothness) if smoothness else None
    waiting, on_screen = list(reversed(arrivals)), arrivals[0][1]
    rows: list[tuple[int, int, NDArray[np.float32]]] = []
    for now_ns in range(arrivals[0][0] + TICK_NS // 3, arrivals[-1][0], TICK_NS):
        while waiting and waiting[-1][0] <= now_ns:
            at_ns, packet = waiting.pop()
            if buffer is None:
                on_screen = packet
            else:
                buffer.push(packet, BODY, at_ns)
        due = buffer.play(now_ns) if buffer is not None else None
        on_screen = due.packet if due is not None else on_screen
        rows.append((now_ns, on_screen.capture_ns, on_screen.pose.rotations))
    at, capture, turns = zip(*rows[120:], strict=True)
    return Shown(np.array(at), np.array(capture), np.stack(turns).astype(np.float64), buffer)


@cache
def shown(name: str, smoothness: float) -> Shown:
    return display(path(name).arrivals(packets()), smoothness)


@pytest.mark.parametrize("name", ["steady", "jitter", "tail", "spikes", "loss"])
def test_it_plays_evenly_where_the_newest_wins_stutters(name: str) -> None:
    newest, even = shown(name, 0.0), shown(name, 1.0)
    assert newest.unevenness_ms > 12
    assert even.unevenness_ms < 1.0
    assert even.jerk < newest.jerk / 8
    assert even.error_mrad() < 5.0


@pytest.mark.parametrize("name", ["jitter", "spikes", "loss"])
def test_the_setting_trades_delay_for_smoothness(name: str) -> None:
    runs = [shown(name, smoothness) for smoothness in (0.25, 0.5, 1.0)]
    assert [run.delay_ms for run in runs] == sorted(run.delay_ms for run in runs)
    jerks = [run.jerk for run in runs]
    assert jerks[0] > jerks[1] > 0.9 * jerks[2]
    assert jerks[0] < shown(name, 0.0).jerk / 2  # with less delay, too, on a path with jitter
    assert runs[0].delay_ms < shown(name, 0.0).delay_ms + 3


def test_the_delay_is_what_the_path_needs_and_no_more() -> None:
    """A frame to interpolate to, and the jitter's 99 %."""
    frame_ms = FRAME_NS / MS
    assert shown("steady", 1.0).delay_ms == pytest.approx(LEAST_MS + frame_ms, abs=1)
    assert shown("jitter", 1.0).delay_ms == pytest.approx(LEAST_MS + frame_ms + 20, abs=3)
    assert shown("jitter", 0.5).delay_ms == pytest.approx(LEAST_MS + (frame_ms + 20) / 2, abs=3)


def test_the_delay_follows_the_path_down_without_a_leap() -> None:
    count = len(packets())
    delays = np.where(np.arange(count) < 60, LEAST_MS + np.random.default_rng(3).uniform(0, 60, count), LEAST_MS)
    run = display(Path(delays, np.zeros(count, bool)).arrivals(packets()), 1.0)
    assert run.buffer is not None
    assert run.buffer.counts["jumps"] == 0
    late, early = run.at_ns[-1] - run.capture_ns[-1], run.at_ns[0] - run.capture_ns[0]
    assert early - late > 20 * MS
    steps = np.diff(run.capture_ns) / np.diff(run.at_ns)
    assert 0.89 < steps.min() <= steps.max() < 1.11


def test_a_single_lost_frame_is_filled_from_the_packet_after_it() -> None:
    lossy = path("loss").arrivals(packets())
    without = [(at_ns, replace(packet, previous=None, previous_age_ns=0)) for at_ns, packet in lossy]
    filled, bridged = display(lossy, 1.0), display(without, 1.0)
    gaps = np.diff([packet.sequence for _, packet in lossy])
    assert filled.buffer is not None
    assert filled.buffer.counts["filled"] == (gaps >= 2).sum() > 5
    received = np.array([packet.capture_ns for _, packet in lossy])
    lost = [packet.capture_ns for packet in packets() if packet.capture_ns not in received]
    near = [np.abs(run.capture_ns[:, None] - lost).min(axis=1) < FRAME_NS for run in (filled, bridged)]
    assert bridged.error_mrad(near[1]) > 2 * filled.error_mrad(near[0])


@pytest.mark.parametrize("divisor", [2, 4])
def test_who_takes_fewer_skeletons_has_the_repeated_frames_all_the_same(divisor: int) -> None:
    taken = [each for each in path("jitter").arrivals(packets()) if each[1].sequence % divisor == 0]
    without = [(at_ns, replace(packet, previous=None, previous_age_ns=0)) for at_ns, packet in taken]
    filled, bridged = display(taken, 1.0), display(without, 1.0)
    assert filled.buffer is not None
    assert filled.buffer.counts["filled"] == len(taken) - 2  # before the first is none, and the last comes at the end
    assert filled.unevenness_ms < 1.0
    assert bridged.error_mrad() > 1.5 * filled.error_mrad()


def test_an_outage_is_extrapolated_within_a_bound_then_held_and_life_goes_on() -> None:
    outage = np.zeros(len(packets()), bool)
    outage[150:210] = True  # two seconds
    run = display(Path(np.full(len(outage), LEAST_MS), outage).arrivals(packets()), 0.5)
    assert run.buffer is not None
    last_ns = packets()[149].capture_ns
    during = run.capture_ns[(run.capture_ns > last_ns) & (run.capture_ns < packets()[210].capture_ns)]
    assert during[np.diff(during, append=0) == 0].max() == last_ns + AHEAD_MAX_NS
    assert run.buffer.counts["held"] > 90
    assert np.diff(run.capture_ns).min() >= 0
    assert run.at_ns[-1] - OFFSET_NS - run.capture_ns[-1] < 100 * MS  # not two seconds behind for good


@pytest.mark.parametrize("smoothness", [0.05, 0.5, 1.0])
def test_time_never_goes_back_and_never_far_ahead_whatever_arrives(smoothness: float) -> None:
    chance = np.random.default_rng(11)
    for _ in range(2):
        count = len(packets())
        delays = LEAST_MS + chance.exponential(chance.uniform(1, 120), count)
        arrivals = Path(delays, chance.random(count) < chance.uniform(0, 0.5)).arrivals(packets())
        buffer, last_ns, newest_ns = JitterBuffer(smoothness), 0, 0
        for at_ns, packet in arrivals:
            buffer.push(packet, BODY, at_ns)
            newest_ns = packet.capture_ns
            due = buffer.play(at_ns + int(chance.uniform(0, 200)) * MS)
            if due is not None:
                assert last_ns <= due.packet.capture_ns <= newest_ns + AHEAD_MAX_NS
                last_ns = due.packet.capture_ns


def test_a_new_run_of_the_sender_begins_anew() -> None:
    buffer = JitterBuffer(1.0)
    for packet in packets()[:30]:
        buffer.push(packet, BODY, packet.capture_ns + 5 * S)
        buffer.play(packet.capture_ns + 5 * S)
    again = replace(packets()[0], epoch=2, capture_ns=7)  # another host's clock
    buffer.push(again, BODY, 900 * S)
    due = buffer.play(900 * S)
    assert due is not None
    assert (due.packet.epoch, due.packet.capture_ns) == (2, 7)


def test_before_the_first_frame_there_is_nothing_and_alone_it_is_shown() -> None:
    buffer = JitterBuffer(1.0)
    assert buffer.play(5 * S) is None
    buffer.push(packets()[0], BODY, 6 * S)
    due = buffer.play(6 * S)
    assert due is not None
    assert due.packet.capture_ns == packets()[0].capture_ns


@pytest.mark.parametrize("smoothness", [0.0, -1.0, 1.01, float("nan")])
def test_a_smoothness_that_is_none_is_refused(smoothness: float) -> None:
    with pytest.raises(ValueError, match="smoothness"):
        JitterBuffer(smoothness)
