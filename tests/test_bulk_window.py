"""The bulk window on a simulated link in virtual time: skeletons wait little, the link is used, faults do no harm."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.transport.bulk_arrivals import BulkArrivals, LeastDelay
from common.transport.bulk_window import BulkWindow, WindowSettings
from common.transport.chunks import CHUNK_MAX_BYTES, Chunk
from common.wire.receiver_report import ReceiverReport

MS = 1_000_000
S = 1000 * MS
EPOCH = 7
SKELETON_BYTES = 320  # with the headers of TCP/IP
CLOCK_SKEW_NS = 1234 * S  # the receiver's clock minus the sender's


@dataclass
class Link:
    """One direction: ``rate_bps``, ``delay_ns``, a drop-tail queue of ``queue_ns``, and outages."""

    rate_bps: float
    delay_ns: int
    queue_ns: int = 200 * MS
    down: bool = False
    loss: float = 0.0
    jitter_ns: int = 0
    busy_until_ns: int = 0

    def arrival_ns(self, size: int, now_ns: int, chance: random.Random) -> int | None:
        """When a packet sent now arrives; None: dropped."""
        waiting_ns = max(0, self.busy_until_ns - now_ns)
        if self.down or waiting_ns > self.queue_ns or chance.random() < self.loss:
            return None
        self.busy_until_ns = now_ns + waiting_ns + int(size * 8 / self.rate_bps * S)
        return self.busy_until_ns + self.delay_ns + int(chance.random() * self.jitter_ns)


class Receiver:
    """The receiving end: notes arrivals, and writes reports."""

    def __init__(self) -> None:
        self.arrivals, self.skeleton_delay, self.bulk_delay = BulkArrivals(), LeastDelay(), LeastDelay()
        self.skeleton: tuple[int, int] | None = None
        self.numbers = count(1)
        self.epoch = 1

    def report(self, now_ns: int) -> ReceiverReport:
        next_chunk, missing = self.arrivals.resolved()
        send_ns, came_ns = self.skeleton or (None, now_ns)
        return ReceiverReport(
            number=next(self.numbers),
            receiver_id=1,
            receiver_epoch=self.epoch,
            sender_epoch=EPOCH,
            clock_ns=now_ns + CLOCK_SKEW_NS,
            skeleton_send_ns=send_ns,
            skeleton_hold_ns=now_ns - came_ns,
            skeleton_delay_ns=self.skeleton_delay.take(),
            bulk_delay_ns=self.bulk_delay.take(),
            bulk_bytes=self.arrivals.bulk_bytes,
            next_chunk=next_chunk,
            missing_chunks=missing,
            body_revision=None,
            repository_poses=0,
        )


class Simulation:
    """30 skeletons a second and as much bulk as the window lets through, over ``there``; reports over ``back``."""

    def __init__(
        self, there: Link, back: Link | None = None, settings: WindowSettings | None = None, skeletons: bool = True
    ) -> None:
        self.there = there
        self.back = back or Link(there.rate_bps, there.delay_ns)
        self.window = BulkWindow(EPOCH, settings)
        self.receiver = Receiver()
        self.now_ns = 0
        self.skeletons: list[tuple[int, int]] = []  # (sent, delay)
        self.chunks: list[tuple[int, int]] = []  # (arrival, bytes)
        self.sent: list[tuple[int, int]] = []  # (time, bytes) of chunks
        self.resolved: list[int] = []
        self.lost = 0
        self._chance = random.Random(1)
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = count()
        if skeletons:
            self._at(0, self._send_skeleton)
        self._at(10 * MS, self._send_report)
        self._at(0, self._tick)

    def _at(self, when_ns: int, action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (when_ns, next(self._order), action))

    def at(self, seconds: float, action: Callable[[], None]) -> None:
        self._at(int(seconds * S), action)

    def run(self, seconds: float) -> Simulation:
        end_ns = int(seconds * S)
        while self._events[0][0] < end_ns:
            self.now_ns, _, action = heapq.heappop(self._events)
            action()
        return self

    def _send_skeleton(self) -> None:
        sent_ns = self.now_ns
        self._at(sent_ns + S // 30, self._send_skeleton)
        arrival_ns = self.there.arrival_ns(SKELETON_BYTES, sent_ns, self._chance)
        if arrival_ns is not None:
            self._at(arrival_ns, lambda: self._skeleton_arrives(sent_ns))

    def _skeleton_arrives(self, sent_ns: int) -> None:
        self.skeletons.append((sent_ns, self.now_ns - sent_ns))
        self.receiver.skeleton = (sent_ns, self.now_ns)
        self.receiver.skeleton_delay.note(sent_ns, self.now_ns + CLOCK_SKEW_NS)

    def _send_report(self) -> None:
        self._at(self.now_ns + 50 * MS, self._send_report)
        report = self.receiver.report(self.now_ns)
        arrival_ns = self.back.arrival_ns(200, self.now_ns, self._chance)
        if arrival_ns is not None:
            self._at(arrival_ns, lambda: self.take(report))

    def take(self, report: ReceiverReport) -> None:
        outcome = self.window.on_report(report, self.now_ns)
        self.resolved += outcome.arrived + outcome.lost
        self.lost += len(outcome.lost)

    def _tick(self) -> None:
        """The sender's timer, each millisecond."""
        self._at(self.now_ns + MS, self._tick)
        gone = self.window.expire(self.now_ns).lost
        self.resolved += gone
        self.lost += len(gone)
        while True:
            size = self.window.chunk_bytes
            when_ns = self.window.next_send_ns(size, self.now_ns)
            if when_ns is None or when_ns > self.now_ns:
                return
            oldest, sent_ns = self.window.oldest_sequence, self.now_ns
            chunk = Chunk(EPOCH, 0, 0, 1, 0, self.window.on_sent(size, sent_ns), oldest, sent_ns, b"")
            self.sent.append((sent_ns, size))
            arrival_ns = self.there.arrival_ns(size + 70, sent_ns, self._chance)
            if arrival_ns is not None:
                self._at(arrival_ns, lambda chunk=chunk, size=size: self._chunk_arrives(chunk, size))  # type: ignore[misc]

    def _chunk_arrives(self, chunk: Chunk, size: int) -> None:
        self.chunks.append((self.now_ns, size))
        self.receiver.arrivals.note(chunk, size)
        self.receiver.bulk_delay.note(chunk.send_ns, self.now_ns + CLOCK_SKEW_NS)

    def goodput_bps(self, begin_s: float, end_s: float) -> float:
        inside = (size for when_ns, size in self.chunks if begin_s * S <= when_ns < end_s * S)
        return sum(inside) * 8 / (end_s - begin_s)

    def extra_ms(self, begin_s: float, end_s: float, percent: float = 99) -> float:
        """The percentile of how much longer skeletons took than the path's delay [ms]."""
        extra = sorted(d - self.there.delay_ns for sent, d in self.skeletons if begin_s * S <= sent < end_s * S)
        return extra[min(len(extra) - 1, int(len(extra) * percent / 100))] / MS


MBIT = 1e6


def ten_megabit(**faults: Any) -> Link:
    """10 Mbit/s and 50 ms there and back."""
    return Link(10 * MBIT, 25 * MS, **faults)


@pytest.mark.parametrize(
    ("rate_bps", "delay_ms", "extra_ms", "share"),
    [(10e6, 25, 40, 0.9), (1e6, 25, 60, 0.8), (100e6, 10, 30, 0.9), (10e6, 100, 40, 0.85), (2e6, 100, 40, 0.8)],
    ids=["10M/50", "1M/50", "100M/20", "10M/200", "2M/200"],
)
def test_skeletons_wait_little_and_the_link_is_used(
    rate_bps: float, delay_ms: int, extra_ms: float, share: float
) -> None:
    run = Simulation(Link(rate_bps, delay_ms * MS)).run(20)
    assert run.extra_ms(5, 20) <= extra_ms
    assert run.goodput_bps(5, 20) >= share * rate_bps
    assert run.lost == 0


def test_from_the_first_moment_on_ten_megabit() -> None:
    run = Simulation(ten_megabit()).run(15)
    assert run.extra_ms(0, 15) <= 40
    assert run.goodput_bps(0, 15) >= 0.85 * 10 * MBIT


def test_without_the_window_the_same_bulk_would_drown_the_skeletons() -> None:
    run = Simulation(ten_megabit(), settings=WindowSettings(target_ms=200)).run(10)
    assert run.extra_ms(5, 10, 50) > 60  # so the figures above are the window's doing


@pytest.mark.parametrize("outage_s", [0.3, 1.0, 5.0, 30.0])
def test_an_outage_stops_bulk_and_it_recovers_afterwards(outage_s: float) -> None:
    there, back = ten_megabit(), ten_megabit()
    run = Simulation(there, back)

    def switch(down: bool) -> None:
        there.down = back.down = down

    end_s = 5 + outage_s
    run.at(5, lambda: switch(True))
    run.at(end_s, lambda: switch(False))
    run.run(end_s + 6)
    assert not [when_ns for when_ns, _ in run.sent if 5.5 * S < when_ns < end_s * S]
    assert run.extra_ms(end_s, end_s + 2) <= 60
    assert run.extra_ms(end_s + 2, end_s + 6) <= 40
    assert run.goodput_bps(end_s + 2, end_s + 6) >= 0.85 * 10 * MBIT
    assert run.lost


def test_bulk_stops_when_only_the_reports_die() -> None:
    back = ten_megabit()
    run = Simulation(ten_megabit(), back)
    run.at(5, lambda: setattr(back, "down", True))
    run.run(8)
    assert run.sent[-1][0] <= 5.5 * S
    assert run.extra_ms(6, 8) <= 1
    assert run.window.next_send_ns(1200, run.now_ns) is None


@pytest.mark.parametrize(("rate_bps", "delay_ms"), [(10e6, 25), (100e6, 10), (500e6, 0)])
def test_bulk_flows_without_skeletons_too(rate_bps: float, delay_ms: int) -> None:
    """A late joiner may be sent a repository while nobody is tracked: then round trip and delay are those of chunks."""
    run = Simulation(Link(rate_bps, delay_ms * MS), skeletons=False).run(10)
    assert run.goodput_bps(5, 10) >= 0.7 * rate_bps
    assert run.window.queueing_delay_s < 0.05


def test_nothing_is_sent_before_the_first_report() -> None:
    window = BulkWindow(EPOCH)
    assert window.next_send_ns(1200, 0) is None
    window.on_report(Receiver().report(0), 0)
    assert window.next_send_ns(1200, 0) is not None


def test_a_slower_link_is_noticed_and_a_faster_one_too() -> None:
    there = ten_megabit()
    run = Simulation(there)
    run.at(5, lambda: setattr(there, "rate_bps", MBIT))
    run.at(12, lambda: setattr(there, "rate_bps", 10 * MBIT))
    run.run(18)
    assert run.extra_ms(7, 12) <= 45  # within base + 3 τ two seconds after the cut
    assert run.goodput_bps(8, 12) >= 0.8 * MBIT
    assert run.goodput_bps(14, 18) >= 0.9 * 10 * MBIT


def test_a_cut_of_a_fast_link_drains_the_queue_it_left() -> None:
    there = Link(100 * MBIT, 10 * MS, queue_ns=S)
    run = Simulation(there)
    run.at(5, lambda: setattr(there, "rate_bps", 10 * MBIT))
    run.run(8)
    assert run.extra_ms(5, 6, 50) <= 450
    assert run.extra_ms(6, 8) <= 50


def test_room_that_appears_on_a_long_path_is_found_by_slow_start() -> None:
    there = Link(10 * MBIT, 100 * MS)
    run = Simulation(there)
    run.at(5, lambda: setattr(there, "rate_bps", MBIT))
    run.at(12, lambda: setattr(there, "rate_bps", 10 * MBIT))
    run.run(18)
    assert run.goodput_bps(15, 18) >= 0.75 * 10 * MBIT


def test_a_queue_shorter_than_the_target_is_found_by_its_losses() -> None:
    run = Simulation(ten_megabit(queue_ns=5 * MS)).run(15)
    assert run.lost <= 0.12 * len(run.sent)  # without giving way to losses, four chunks of five would be
    assert run.goodput_bps(3, 15) >= 0.5 * 10 * MBIT


def test_chunks_shrink_with_the_rate() -> None:
    slow, fast = Simulation(Link(MBIT, 25 * MS)).run(5), Simulation(Link(100 * MBIT, 10 * MS)).run(5)
    assert slow.window.chunk_bytes == 1200
    assert fast.window.chunk_bytes == CHUNK_MAX_BYTES
    assert 7_000 < Simulation(ten_megabit()).run(5).window.chunk_bytes < 12_000  # 8 ms of the link


def test_bulk_yields_to_a_competitor_keeps_its_floor_and_comes_back() -> None:
    there = ten_megabit()
    run = Simulation(there)

    def compete() -> None:
        """A download that keeps 100 ms of the queue filled."""
        if run.now_ns < 12 * S:
            run.at(run.now_ns / S + 0.001, compete)
            there.busy_until_ns = max(there.busy_until_ns, run.now_ns + 100 * MS)

    run.at(4, compete)
    run.run(20)
    assert 0.8 * 100_000 < run.goodput_bps(6, 12) < MBIT
    assert run.goodput_bps(17, 20) >= 0.85 * 10 * MBIT


@pytest.mark.parametrize(("fault", "share"), [({"loss": 0.01}, 0.8), ({"jitter_ns": 10 * MS}, 0.85)])
def test_loss_and_jitter_are_survived(fault: dict[str, Any], share: float) -> None:
    run = Simulation(ten_megabit(**fault)).run(15)
    assert run.goodput_bps(3, 15) >= share * 10 * MBIT
    assert run.extra_ms(3, 15) <= 50


def test_each_chunk_is_resolved_once_and_what_is_lost_is_said() -> None:
    run = Simulation(ten_megabit(loss=0.05)).run(10)
    assert sorted(run.resolved) == sorted(set(run.resolved))
    assert run.lost > 0
    assert abs(run.window.in_flight_bytes - sum(size for _, size in run.sent[-100:])) < 1 << 20
    arrived = len(run.chunks)
    assert arrived + run.lost == pytest.approx(len(run.sent), abs=60)  # the rest is on its way


def test_a_restarted_receiver_has_nothing_and_gets_everything_in_flight_again() -> None:
    run = Simulation(ten_megabit()).run(5)
    in_flight = run.window.in_flight_bytes
    run.receiver = Receiver()
    run.receiver.epoch = 2
    report = run.receiver.report(run.now_ns)
    outcome = run.window.on_report(report, run.now_ns + 20 * MS)
    assert in_flight > 0
    assert outcome.restarted
    assert outcome.lost
    assert not outcome.arrived
    assert run.window.in_flight_bytes == 0
    run.run(12)
    assert run.goodput_bps(8, 12) >= 0.85 * 10 * MBIT


def test_reports_about_another_run_acknowledge_nothing() -> None:
    run = Simulation(ten_megabit()).run(5)
    before = run.window.in_flight_bytes
    report = replace(run.receiver.report(run.now_ns), sender_epoch=EPOCH - 1, next_chunk=10**9)
    assert run.window.on_report(report, run.now_ns + 20 * MS).arrived == ()
    assert run.window.in_flight_bytes == before


def test_old_and_too_frequent_reports_are_counted_and_ignored() -> None:
    run = Simulation(ten_megabit()).run(5)
    window, before, now_ns = run.window, run.window.window_bytes, run.now_ns + 50 * MS
    report = run.receiver.report(now_ns)
    assert window.on_report(report, now_ns).arrived
    for step in range(100):  # 10 kHz
        window.on_report(replace(report, number=report.number + 1 + step, next_chunk=1 << 50), now_ns + step * 100_000)
    window.on_report(replace(report, number=1), now_ns + S // 10)
    assert window.counts["report too soon"] == 100
    assert window.counts["old report"] == 1
    assert window.window_bytes <= 2 * before


u62 = st.integers(0, 1 << 62)
hostile = st.builds(
    ReceiverReport,
    number=st.integers(0, 1 << 32),
    receiver_id=st.just(1),
    receiver_epoch=st.integers(1, 2),
    sender_epoch=st.sampled_from([None, EPOCH, EPOCH, EPOCH, 8]),
    clock_ns=u62,
    skeleton_send_ns=st.none() | u62,
    skeleton_hold_ns=u62,
    skeleton_delay_ns=st.none() | st.integers(-(1 << 62), 1 << 62),
    bulk_delay_ns=st.none() | st.integers(-(1 << 62), 1 << 62),
    bulk_bytes=st.integers(0, 1 << 53),
    next_chunk=st.integers(0, 1 << 53) | st.integers(0, 60),
    missing_chunks=st.lists(st.integers(0, 60), max_size=20, unique=True).map(lambda x: tuple(sorted(x))),
    body_revision=st.none(),
    repository_poses=st.just(0),
)


@given(st.lists(st.tuples(hostile, st.integers(0, 3 * S)), max_size=30))
def test_no_report_moves_the_window_out_of_its_bounds(reports: list[tuple[ReceiverReport, int]]) -> None:
    settings = WindowSettings()
    window, now_ns, sent, resolved = BulkWindow(EPOCH, settings), 0, 0, 0
    for report, pause_ns in reports:
        outcome = window.on_report(report, now_ns)
        gone = window.expire(now_ns)
        resolved += len(outcome.arrived) + len(outcome.lost) + len(gone.lost)
        for _ in range(4):
            when_ns = window.next_send_ns(window.chunk_bytes, now_ns)
            if when_ns is not None and when_ns <= now_ns:
                window.on_sent(window.chunk_bytes, now_ns)
                sent += 1
        assert 2 * 1200 <= window.window_bytes <= settings.max_window_bytes
        assert 1200 <= window.chunk_bytes <= CHUNK_MAX_BYTES
        assert 0 <= window.in_flight_bytes <= settings.max_window_bytes
        assert 0 <= window.queueing_delay_s < 1e11
        assert window.budget_bytes(S) >= 0
        assert window.time_to_deliver_s(1000) > 0
        assert resolved <= sent == window.next_sequence
        now_ns += pause_ns


def test_a_receiver_that_claims_everything_arrived_is_still_paced() -> None:
    """The window ends at its maximum, and what was sent stays below the pace that this allows."""
    settings = WindowSettings()
    window, receiver, sent = BulkWindow(EPOCH, settings), Receiver(), 0
    for step in range(2000):
        now_ns = step * 5 * MS
        if step % 10 == 0:
            window.on_report(replace(receiver.report(now_ns), next_chunk=1 << 50), now_ns)
        while (when_ns := window.next_send_ns(CHUNK_MAX_BYTES, now_ns)) is not None and when_ns <= now_ns:
            window.on_sent(CHUNK_MAX_BYTES, now_ns)
            sent += CHUNK_MAX_BYTES
    assert window.counts["future chunk"] > 0
    assert window.window_bytes <= settings.max_window_bytes
    assert sent <= 10 * 1.2 * settings.max_window_bytes / 0.05


def test_a_budget_follows_the_rate() -> None:
    run = Simulation(ten_megabit()).run(10)
    assert run.window.rate_bytes_s * 8 == pytest.approx(10 * MBIT, rel=0.1)
    assert run.window.budget_bytes(S) == pytest.approx(0.9 * run.window.rate_bytes_s - run.window.in_flight_bytes, 0.01)
    assert run.window.time_to_deliver_s(1_000_000) == pytest.approx(0.9, abs=0.25)


@pytest.mark.parametrize(
    "wrong", [{"target_ms": 0.0}, {"floor_bps": 1}, {"max_window_bytes": 1000}, {"report_period_ms": 1.0}]
)
def test_settings_out_of_range_are_named(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        WindowSettings(**wrong)  # type: ignore[arg-type]
