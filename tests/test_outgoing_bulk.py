"""What goes next: poses and residual maps share a link by the stated rule, and no old map goes before a new one."""

from __future__ import annotations

import pytest

from sender.candidate_poses.mesh_scheduler import MeshScheduler, SendRecord
from sender.candidate_poses.usable_pose_set import Quotients
from sender.outgoing_bulk import LIVE_LEAST_BYTES_S, LIVE_SHARE, Outgoing, OutgoingBulk
from sender.residual_path import Residual

MS, SECOND_NS = 1_000_000, 1_000_000_000
RATE = 250_000  # bytes/s
FRAME_NS = SECOND_NS // 30
KEY_EVERY = 30


class Bench:
    """A link of ``RATE`` on which each message takes its time, and what went over it."""

    def __init__(self, share: float = 0.5, pose_bytes: int = 40_000) -> None:
        self.scheduler = MeshScheduler()
        self.scheduler.receiver_joined("wall", 1)
        self.records: list[SendRecord] = []
        self.choice = OutgoingBulk("wall", self.scheduler, self.records.append, share)
        self.choice.wants_residuals = True
        self.sent: list[Outgoing] = []
        self.sent_bytes = {"pose": 0, "residual": 0}
        self.poses = 0
        self.pose_bytes = pose_bytes
        self._residuals = self._key = 0
        self._busy_until_ns, self._pose_left = 0.0, 0.0

    def pose(self) -> None:
        self.poses += 1
        self.scheduler.offer(self.poses, b"p" * self.pose_bytes, self.poses, Quotients({self.poses: 0.5}))

    def residual(self, size: int) -> None:
        sequence, self._residuals = self._residuals, self._residuals + 1
        if sequence % KEY_EVERY == 0:
            self._key = sequence
        self.choice.offer(Residual(sequence, self._key, b"r" * size, 50.0))

    def carry(self, until_ns: int) -> None:
        """A pose goes in pieces of 2 KB, residual packets between them."""
        while self._busy_until_ns < until_ns:
            if self._pose_left > 0:
                chosen = self.choice.next_urgent()
            else:
                chosen = self.choice.next_message(RATE, int(self._busy_until_ns))
            if chosen is not None:
                assert isinstance(chosen.name, tuple)
                self.sent.append(chosen)
                self.sent_bytes[chosen.name[0]] += len(chosen.payload)
                assert chosen.urgent == (chosen.name[0] == "residual")
            if chosen is not None and not chosen.urgent:
                self._pose_left = len(chosen.payload)
                continue
            if chosen is None and self._pose_left <= 0:
                self._busy_until_ns = until_ns
                return
            size = min(2000.0, self._pose_left) if chosen is None else len(chosen.payload)
            self._pose_left -= size if chosen is None else 0
            self._busy_until_ns += size / RATE * SECOND_NS

    def run(self, seconds: float, residual_bytes: int | None, poses: bool) -> None:
        """``residual_bytes`` a frame, None: as many as the choice says they may take."""
        begin = round(self._busy_until_ns / FRAME_NS)
        for frame in range(begin + 1, begin + 1 + round(30 * seconds)):
            now_ns = frame * FRAME_NS
            if poses and frame % 3 == 0:
                self.pose()
            budget = self.choice.residual_bytes_s(RATE, now_ns) / 30
            self.residual(int(budget) if residual_bytes is None else residual_bytes)
            self.carry(now_ns)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.8])
def test_when_both_have_plenty_each_gets_its_share(share):
    bench = Bench(share)
    bench.run(8.0, residual_bytes=RATE // 30, poses=True)
    both = sum(bench.sent_bytes.values())
    assert both > 0.95 * 8 * RATE
    assert bench.sent_bytes["residual"] / both == pytest.approx(share, abs=0.06)


def test_what_poses_have_no_use_for_goes_to_residuals_and_back():
    bench = Bench()
    bench.run(8.0, None, poses=True)
    assert bench.choice.residual_bytes_s(RATE, 8 * SECOND_NS) == pytest.approx(
        RATE / 2, rel=0.1
    )  # a pose moves it by 8 %
    bench.run(8.0, None, poses=False)
    assert bench.choice.residual_bytes_s(RATE, 16 * SECOND_NS) > 0.95 * RATE
    before = dict(bench.sent_bytes)
    bench.run(2.0, None, poses=True)
    poses, residuals = (bench.sent_bytes[layer] - before[layer] for layer in ("pose", "residual"))
    assert poses == pytest.approx(residuals, rel=0.35)  # no debt is left from when there were no poses


def test_residuals_that_take_little_leave_the_rest_to_poses():
    bench = Bench()
    bench.run(4.0, residual_bytes=500, poses=True)
    assert bench.sent_bytes["residual"] == 4 * 30 * 500
    assert bench.sent_bytes["pose"] > 0.9 * (4 * RATE - 4 * 30 * 500)


def test_only_the_newest_waits_and_drives_out_the_one_before():
    choice = Bench().choice
    choice.offer(Residual(0, 0, b"key", 50.0))
    key = choice.next_message(RATE, 0)
    assert key is not None
    assert (key.name, key.supersedes) == (("residual", 0), None)
    for sequence in (1, 2, 3):
        choice.offer(Residual(sequence, 0, b"difference", 50.0))
    first = choice.next_message(RATE, 0)
    choice.offer(Residual(4, 0, b"difference", 50.0))
    second = choice.next_message(RATE, 0)
    assert first is not None
    assert second is not None
    assert (first.name, first.supersedes) == (("residual", 3), None)  # the key is seen through
    assert (second.name, second.supersedes) == (("residual", 4), ("residual", 3))
    assert choice.next_message(RATE, 0) is None
    assert choice.counts["dropped"] == 2


def test_a_difference_never_takes_the_place_of_the_key_it_needs():
    choice = Bench().choice
    choice.offer(Residual(30, 30, b"key", 50.0))
    choice.offer(Residual(31, 30, b"difference", 50.0))
    chosen = choice.next_message(RATE, 0)
    assert chosen is not None
    assert chosen.name == ("residual", 30)
    choice.offer(Residual(32, 30, b"difference", 50.0))
    choice.offer(Residual(60, 60, b"key", 50.0))
    assert (chosen := choice.next_message(RATE, 0)) is not None
    assert chosen.name == ("residual", 60)


def test_who_begins_to_want_residuals_needs_a_key():
    choice = Bench().choice
    choice.wants_residuals = False
    choice.offer(Residual(0, 0, b"key", 50.0))
    assert choice.next_message(RATE, 0) is None
    assert not choice.needs_key
    choice.wants_residuals = True
    assert choice.needs_key
    choice.offer(Residual(1, 0, b"difference of a key that went elsewhere", 50.0))
    assert choice.next_message(RATE, 0) is None
    assert choice.needs_key
    choice.offer(Residual(2, 2, b"key", 50.0))
    assert not choice.needs_key
    assert choice.next_message(RATE, 0) is not None
    assert not choice.needs_key


def test_a_receiver_that_wants_none_costs_poses_nothing():
    bench = Bench()
    bench.choice.wants_residuals = False
    bench.run(2.0, None, poses=True)
    assert bench.sent_bytes["residual"] == 0
    assert bench.sent_bytes["pose"] > 0.9 * 2 * RATE


def test_a_live_surface_takes_a_tenth_and_nothing_of_a_thin_link():
    bench = Bench(0.5)
    bench.choice.want(points=False, live=True, poses=True, bytes_s=RATE)
    bench.run(6.0, None, poses=True)
    both = sum(bench.sent_bytes.values())
    assert bench.sent_bytes["residual"] / both == pytest.approx(LIVE_SHARE, abs=0.04)
    for bytes_s, wanted in ((1.1, True), (0.9, False), (1.1, False), (1.3, True)):  # × the least: no to and fro
        bench.choice.want(points=False, live=True, poses=True, bytes_s=bytes_s * LIVE_LEAST_BYTES_S)
        assert bench.choice.wants_residuals == wanted
    bench.choice.want(points=True, live=True, poses=True, bytes_s=0.1 * LIVE_LEAST_BYTES_S)
    assert bench.choice.wants_residuals
    assert bench.choice.residual_bytes_s(RATE, 0) >= 0.5 * RATE


def test_who_spares_poses_gets_residuals_alone_until_poses_are_wanted_again():
    bench = Bench()
    bench.choice.want(points=True, live=False, poses=False, bytes_s=RATE)
    bench.run(3.0, None, poses=True)
    assert bench.sent_bytes["pose"] == 0
    assert bench.sent_bytes["residual"] > 0.9 * 3 * RATE
    bench.choice.want(points=False, live=False, poses=True, bytes_s=RATE)
    bench.run(1.0, None, poses=True)
    assert bench.sent_bytes["pose"] > 0.8 * RATE
