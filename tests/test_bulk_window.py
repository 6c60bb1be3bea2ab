"""The bulk window over simulated paths in virtual time: skeletons wait little, the path is used, faults do no harm.

The figures are issue goals (10 Mbit/s: p50 ≤ idle + 15 ms, p99 ≤ idle + 40 ms, 90 %; and so on), not what it reaches.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.transport.bulk_window import BulkWindow, WindowSettings
from common.transport.chunks import CHUNK_MAX_BYTES
from common.transport.reception import Reception
from common.wire.receiver_report import ReceiverReport
from scripts.bulk_simulation import EPOCH, MS, BulkSimulation, Competitor, S
from scripts.link_model import BurstLoss, LinkConditions

MBIT = 1e6


def path(rate_bps: float, round_trip_ms: float, **faults: Any) -> LinkConditions:
    return LinkConditions(rate_bps, round_trip_ms / 2, **faults)


TEN_MEGABIT = path(10 * MBIT, 50)


def report(now_ns: int, number: int = 1) -> ReceiverReport:
    """Of a receiver that has heard a skeleton of ours and no chunk."""
    reception = Reception(1, 1)
    reception.skeleton(EPOCH, now_ns, now_ns)
    return replace(reception.report(now_ns, None, 0), number=number)


@pytest.mark.parametrize(
    ("conditions", "p50_ms", "p99_ms", "share"),
    [
        (TEN_MEGABIT, 15, 40, 0.9),
        (path(MBIT, 50), 30, 60, 0.8),
        (path(100 * MBIT, 20), 20, 40, 0.9),
        (path(10 * MBIT, 200), 20, 40, 0.85),
        (path(50 * MBIT, 200), 20, 50, 0.85),
        (path(2 * MBIT, 200), 30, 60, 0.8),
        (path(10 * MBIT, 50, queue_ms=2000), 15, 40, 0.9),
        (path(0.4 * MBIT, 50), 30, 60, 0.6),
    ],
    ids=["10M/50", "1M/50", "100M/20", "10M/200", "50M/200", "2M/200", "bufferbloat", "400k/50"],
)
def test_skeletons_wait_little_and_the_path_is_used(
    conditions: LinkConditions, p50_ms: float, p99_ms: float, share: float
) -> None:
    run = BulkSimulation(conditions).run(9)
    assert run.over_idle_ms(5, 9, 50) <= p50_ms
    assert run.over_idle_ms(5, 9) <= p99_ms
    assert run.goodput_bps(5, 9) >= share * conditions.rate_bps
    assert run.wrong == 0
    assert run.messages > 0


def test_from_the_first_moment_on_ten_megabit() -> None:
    run = BulkSimulation(TEN_MEGABIT).run(10)
    assert run.over_idle_ms(0, 10) <= 50  # slow start ends in a queue of its own
    assert run.goodput_bps(0, 10) >= 0.85 * 10 * MBIT


def test_without_the_window_the_same_bulk_would_drown_the_skeletons() -> None:
    run = BulkSimulation(TEN_MEGABIT, settings=WindowSettings(target_ms=200)).run(10)
    assert run.over_idle_ms(5, 10, 50) > 60  # so the figures above are the window's doing


def test_the_queue_does_not_creep_up_while_bulk_never_pauses() -> None:
    """The delay's base is the least of the last minute: a queue that never empties would become the base."""
    run = BulkSimulation(path(4 * MBIT, 50)).run(90)
    assert run.over_idle_ms(70, 90, 50) <= 15
    assert run.over_idle_ms(70, 90, 1) <= 5


@pytest.mark.parametrize("outage_s", [0.3, 1.0, 5.0, 30.0])
def test_an_outage_stops_bulk_and_it_recovers_afterwards(outage_s: float) -> None:
    run, end_s = BulkSimulation(TEN_MEGABIT), 5 + outage_s
    for lane in (run.there, run.back):
        run.at(5, lambda lane=lane: lane.change(outage=True))
        run.at(end_s, lambda lane=lane: lane.change(outage=False))
    run.run(end_s + 8)
    assert not [when_ns for when_ns, _ in run.sent if 5.5 * S < when_ns < end_s * S]
    assert run.over_idle_ms(end_s + 3, end_s + 8) <= 40
    assert run.goodput_bps(end_s + 3, end_s + 8) >= 0.9 * 10 * MBIT  # the goal is within five seconds
    assert run.window.counts["written off"] or run.window.counts["lost"]
    assert run.wrong == 0


def test_bulk_stops_when_only_the_reports_die() -> None:
    run = BulkSimulation(TEN_MEGABIT)
    run.at(5, lambda: run.back.change(outage=True))
    run.run(8)
    assert run.sent[-1][0] <= 5.5 * S
    assert run.over_idle_ms(6, 8) <= 1
    assert run.window.next_send_ns(1200, run.loop.now_ns()) is None


@pytest.mark.parametrize(("rate_bps", "round_trip_ms"), [(10e6, 50), (100e6, 20), (200e6, 0)])
def test_bulk_flows_without_skeletons_too(rate_bps: float, round_trip_ms: float) -> None:
    """A late joiner may be sent a repository while nobody is tracked: then round trip and delay are those of chunks."""
    run = BulkSimulation(path(rate_bps, round_trip_ms), skeleton_hz=0).run(4)
    assert run.goodput_bps(2, 4) >= 0.7 * rate_bps
    assert run.window.queueing_delay_s < 0.05


def test_nothing_is_sent_before_the_first_report() -> None:
    window = BulkWindow(EPOCH)
    assert window.next_send_ns(1200, 0) is None
    window.on_report(report(0), 0)
    assert window.next_send_ns(1200, 0) is not None


@pytest.mark.parametrize("slow_bps", [MBIT, 2 * MBIT])
def test_a_slower_path_is_noticed_and_a_faster_one_too(slow_bps: float) -> None:
    run = BulkSimulation(TEN_MEGABIT)
    run.at(5, lambda: run.there.change(rate_bps=slow_bps))
    run.at(12, lambda: run.there.change(rate_bps=10 * MBIT))
    run.run(19)
    assert run.over_idle_ms(7, 12) <= 60  # two seconds after the cut
    assert run.goodput_bps(8, 12) >= 0.8 * slow_bps
    assert run.goodput_bps(15, 19) >= 0.9 * 10 * MBIT


def test_a_cut_of_a_fast_path_drains_the_queue_it_left() -> None:
    run = BulkSimulation(path(100 * MBIT, 20, queue_ms=1000))
    run.at(5, lambda: run.there.change(rate_bps=10 * MBIT))
    run.run(8)
    assert run.over_idle_ms(5, 6, 50) <= 450
    assert run.over_idle_ms(6.5, 8) <= 50


def test_room_that_appears_on_a_long_path_is_found_within_five_seconds() -> None:
    run = BulkSimulation(path(10 * MBIT, 200))
    run.at(5, lambda: run.there.change(rate_bps=MBIT))
    run.at(12, lambda: run.there.change(rate_bps=10 * MBIT))
    run.run(20)
    assert run.goodput_bps(17, 20) >= 0.85 * 10 * MBIT


@pytest.mark.parametrize("round_trip_ms", [50, 200])
def test_bulk_yields_to_a_download_keeps_its_floor_and_is_back_within_five_seconds(round_trip_ms: float) -> None:
    run = BulkSimulation(path(10 * MBIT, round_trip_ms))
    Competitor(run, 4, 12)
    run.run(20)
    assert 0.6 * 100_000 < run.goodput_bps(7, 12) < MBIT
    assert run.goodput_bps(17, 20) >= 0.9 * 10 * MBIT
    assert run.over_idle_ms(17, 20) <= 40


def test_a_queue_shorter_than_the_target_is_found_by_its_losses() -> None:
    run = BulkSimulation(path(10 * MBIT, 50, queue_ms=5)).run(12)
    assert run.window.counts["lost"] <= 0.25 * len(run.sent)  # without giving way, four chunks of five would be
    assert run.goodput_bps(3, 12) >= 0.3 * 10 * MBIT


def test_chunks_shrink_with_the_rate() -> None:
    slow, fast = BulkSimulation(path(MBIT, 50)).run(4), BulkSimulation(path(100 * MBIT, 20)).run(4)
    assert slow.window.chunk_bytes == 1200
    assert fast.window.chunk_bytes == CHUNK_MAX_BYTES
    assert 4_500 < BulkSimulation(TEN_MEGABIT).run(4).window.chunk_bytes < 8_000  # 5 ms of the link


@pytest.mark.parametrize(
    ("fault", "share"),
    [
        ({"loss": 0.01}, 0.85),
        ({"loss": 0.05}, 0.7),
        ({"loss": 0.2}, 0.02),  # as a full queue would: it is still whole what arrives
        ({"burst": BurstLoss(0.01, 0.4)}, 0.8),
        ({"jitter_ms": 10, "reorder": True}, 0.6),
        ({"jitter_ms": 2}, 0.8),
        ({"duplicates": 0.05}, 0.9),
    ],
    ids=["1 %", "5 %", "20 %", "bursts", "reordering", "jitter", "duplicates"],
)
def test_loss_jitter_and_duplicates_are_survived(fault: dict[str, Any], share: float) -> None:
    run = BulkSimulation(replace(TEN_MEGABIT, **fault)).run(8)
    assert run.goodput_bps(3, 8) >= share * 10 * MBIT
    assert run.over_idle_ms(3, 8) <= 40
    assert run.messages > 0
    assert run.wrong == 0
    assert len(run.delivered) == len(set(run.delivered))


def test_chunks_that_were_only_overtaken_are_not_sent_again() -> None:
    run = BulkSimulation(replace(TEN_MEGABIT, jitter_ms=10, reorder=True)).run(10)
    assert run.window.counts["lost"] == 0
    assert run.sender.repeated == 0


def test_when_the_last_chunks_are_lost_a_full_window_probes() -> None:
    window = BulkWindow(EPOCH)
    window.on_report(report(0), 0)
    size = window.chunk_bytes
    now_ns = 0
    while (when_ns := window.next_send_ns(size, now_ns)) is not None:
        now_ns = max(now_ns, when_ns)
        window.on_sent(size, now_ns)
    before = window.in_flight_bytes
    for number in range(2, 12):  # the receiver is there, and hears nothing
        now_ns += 50 * MS
        window.on_report(report(now_ns, number), now_ns)
        if window.next_send_ns(size, now_ns) is not None:
            break
    assert 5 <= number <= 11  # two round trips of 0.2 s and two periods, not at once and not never
    window.on_sent(size, now_ns)
    assert window.in_flight_bytes == before + size
    assert window.next_send_ns(size, now_ns + 50 * MS) is None  # one at a time


def test_what_a_stall_held_up_does_not_look_like_a_faster_path() -> None:
    """TCP that waits for a lost packet delivers nothing for some reports, and then all at once."""
    window, size, arrived, number = BulkWindow(EPOCH), 1200, 0, 1
    window.on_report(report(0), 0)
    for step in range(1, 800):
        now_ns = step * 5 * MS
        while (when_ns := window.next_send_ns(size, now_ns)) is not None and when_ns <= now_ns:
            window.on_sent(size, now_ns)
        if step % 40 == 0:  # at most 100 chunks in 200 ms
            arrived = min(arrived + 100, window.next_sequence)
        if step % 10 == 0:
            number += 1
            window.on_report(replace(report(now_ns, number), next_chunk=arrived), now_ns)
    assert 0.5 * 100 * size / 0.2 < window.rate_bytes_s <= 100 * size / 0.2


def test_each_chunk_is_resolved_once_and_what_is_lost_is_sent_again() -> None:
    run = BulkSimulation(replace(TEN_MEGABIT, loss=0.05)).run(10)
    assert run.window.counts["lost"] == run.sender.repeated > 0
    assert len(run.arrived) + run.window.counts["lost"] == pytest.approx(len(run.sent), abs=80)  # others are under way


def test_a_restarted_receiver_has_nothing_and_gets_everything_in_flight_again() -> None:
    run = BulkSimulation(TEN_MEGABIT)
    run.at(5, run.restart_receiver)
    run.run(12)
    assert run.goodput_bps(8, 12) >= 0.9 * 10 * MBIT
    assert run.wrong == 0


def test_a_restart_is_told_with_all_that_was_in_flight() -> None:
    window = BulkWindow(EPOCH)
    window.on_report(report(0), 0)
    sent = [window.on_sent(1200, 0) for _ in range(3)]
    outcome = window.on_report(replace(report(60 * MS), receiver_epoch=2), 60 * MS)
    assert outcome.restarted
    assert list(outcome.lost) == sent
    assert not outcome.arrived
    assert window.in_flight_bytes == 0


def test_reports_about_another_run_acknowledge_nothing() -> None:
    window = BulkWindow(EPOCH)
    window.on_report(report(0), 0)
    window.on_sent(1200, 0)
    other = replace(report(60 * MS, 2), sender_epoch=EPOCH - 1, next_chunk=10**9)
    assert window.on_report(other, 60 * MS).arrived == ()
    assert window.in_flight_bytes == 1200


def test_the_time_before_a_receiver_heard_of_the_run_is_no_part_of_the_rate() -> None:
    """Its clock shows hours; the first chunks were on their way before its first skeleton was there."""
    window, hours_ns = BulkWindow(EPOCH), 8 * 3600 * S
    strange = replace(report(0), sender_epoch=None, clock_ns=hours_ns)
    window.on_report(strange, 0)
    for _ in range(10):
        window.on_sent(1500, 10 * MS)
    window.on_report(replace(strange, number=2, clock_ns=hours_ns + 50 * MS), 50 * MS)
    heard = replace(report(100 * MS, 3), clock_ns=hours_ns + 100 * MS, next_chunk=10)
    assert len(window.on_report(heard, 100 * MS).arrived) == 10
    assert window.rate_bytes_s > 15_000 / 0.2


def test_however_slow_a_path_seems_the_floor_is_in_the_budget() -> None:
    """Who is told of no budget sends nothing, and the rate would never be known better."""
    window = BulkWindow(EPOCH)
    window.on_report(report(0), 0)
    for number in range(2, 10):
        for _ in range(9):
            window.on_sent(1200, 10 * number * S)
        answer = replace(
            report(10 * number * S, number), clock_ns=10 * (number + 1) * S - 1, next_chunk=9 * (number - 1)
        )
        window.on_report(answer, 10 * (number + 1) * S - 1)
    assert window.rate_bytes_s < 2000
    assert window.budget_bytes(S) == int(0.9 * WindowSettings().floor_bps / 8)


def test_old_and_too_frequent_reports_are_counted_and_ignored() -> None:
    run = BulkSimulation(TEN_MEGABIT).run(5)
    window, before, now_ns = run.window, run.window.window_bytes, run.loop.now_ns() + 50 * MS
    next_report = replace(report(now_ns, 1000), receiver_epoch=run.receiver_epoch)
    window.on_report(next_report, now_ns)
    for step in range(100):  # 10 kHz
        window.on_report(replace(next_report, number=1001 + step, next_chunk=1 << 50), now_ns + step * 100_000)
    window.on_report(replace(next_report, number=1), now_ns + S // 10)
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
    window, sent = BulkWindow(EPOCH, settings), 0
    for step in range(2000):
        now_ns = step * 5 * MS
        if step % 10 == 0:
            window.on_report(replace(report(now_ns, step + 1), next_chunk=1 << 50), now_ns)
        while (when_ns := window.next_send_ns(CHUNK_MAX_BYTES, now_ns)) is not None and when_ns <= now_ns:
            window.on_sent(CHUNK_MAX_BYTES, now_ns)
            sent += CHUNK_MAX_BYTES
    assert window.counts["future chunk"] > 0
    assert window.window_bytes <= settings.max_window_bytes
    assert sent <= 10 * 1.2 * settings.max_window_bytes / 0.05


def test_a_budget_follows_the_rate() -> None:
    run = BulkSimulation(TEN_MEGABIT).run(10)
    assert run.window.rate_bytes_s * 8 == pytest.approx(10 * MBIT, rel=0.1)
    assert run.window.budget_bytes(S) == pytest.approx(0.9 * run.window.rate_bytes_s - run.window.in_flight_bytes, 0.01)
    assert run.window.time_to_deliver_s(1_000_000) == pytest.approx(0.9, abs=0.25)


@pytest.mark.parametrize(
    "wrong", [{"target_ms": 0.0}, {"floor_bps": 1}, {"max_window_bytes": 1000}, {"report_period_ms": 1.0}]
)
def test_settings_out_of_range_are_named(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        WindowSettings(**wrong)  # type: ignore[arg-type]
