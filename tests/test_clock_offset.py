"""The clock offset: exact on a symmetric path, within half a round trip on any, and following a drift."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.transport.clock_offset import ClockOffset

MS = 1_000_000
S = 1000 * MS
OFFSET_NS = -987_654_321_987


def exchange(
    clock: ClockOffset, at_ns: int, there_ns: int, back_ns: int, offset_ns: int = OFFSET_NS, held_ns: int = MS
) -> bool:
    t1 = at_ns + there_ns + offset_ns
    return clock.add(at_ns, t1, t1 + held_ns, at_ns + there_ns + held_ns + back_ns)


def test_a_symmetric_exchange_gives_the_exact_offset() -> None:
    clock = ClockOffset()
    exchange(clock, 5 * S, 25 * MS, 25 * MS)
    assert clock.offset_ns(5 * S) == OFFSET_NS
    assert clock.to_local_ns(7 * S + OFFSET_NS, 5 * S) == 7 * S
    assert clock.error_ns(5 * S) == 25 * MS


def test_the_answer_may_come_at_once() -> None:
    clock = ClockOffset()
    exchange(clock, 0, 3 * MS, 3 * MS, held_ns=0)
    assert clock.offset_ns(0) == OFFSET_NS


@given(st.lists(st.tuples(st.integers(0, 200 * MS), st.integers(0, 200 * MS)), min_size=1, max_size=50))
def test_the_error_stays_within_what_is_claimed(delays: list[tuple[int, int]]) -> None:
    clock, now_ns = ClockOffset(), 0
    for there_ns, back_ns in delays:
        exchange(clock, now_ns, there_ns, back_ns)
        now_ns += S
        assert abs(clock.offset_ns(now_ns) - OFFSET_NS) <= clock.error_ns(now_ns) + 1


def test_jitter_is_filtered_by_the_quickest_exchange() -> None:
    chance, clock, now_ns = random.Random(1), ClockOffset(), 0
    for _ in range(32):
        exchange(clock, now_ns, 10 * MS + int(chance.expovariate(1 / (8 * MS))), 10 * MS)
        now_ns += S // 2
    assert abs(clock.offset_ns(now_ns) - OFFSET_NS) < 1 * MS  # one exchange alone is 4 ms off on average


def test_a_drift_is_followed() -> None:
    chance, clock, drift = random.Random(2), ClockOffset(), 50e-6
    worst_ns, now_ns = 0, 0
    for step in range(600):
        now_ns = step * S
        offset_ns = OFFSET_NS + int(now_ns * drift)
        exchange(
            clock, now_ns, 5 * MS + int(chance.random() * 4 * MS), 5 * MS + int(chance.random() * 4 * MS), offset_ns
        )
        worst_ns = max(worst_ns, abs(clock.offset_ns(now_ns) - offset_ns))
    assert worst_ns < 2 * MS  # while the clocks have parted by 30 ms


def test_impossible_times_are_refused_and_counted() -> None:
    clock = ClockOffset()
    assert not clock.add(0, 10, 5, 100)  # answered before it was received
    assert not clock.add(0, 10, 200, 100)  # held longer than the round trip
    assert clock.refused == 2
    assert not clock.known
    with pytest.raises(LookupError):
        clock.offset_ns(0)


@pytest.mark.parametrize("step_ns", [3600 * S, -3600 * S, 200 * MS, -200 * MS])
def test_a_step_is_followed_at_once_although_the_exchanges_before_were_quicker(step_ns: int) -> None:
    clock = ClockOffset()
    for second in range(20):
        exchange(clock, second * S, 2 * MS, 2 * MS)
    exchange(clock, 20 * S, 40 * MS, 40 * MS, offset_ns=OFFSET_NS + step_ns)
    assert clock.offset_ns(20 * S) == OFFSET_NS + step_ns
    assert clock.steps == 1


@given(
    st.lists(st.tuples(st.integers(0, 500 * MS), st.integers(0, 500 * MS)), min_size=1, max_size=60),
    st.sampled_from([60e-6, -60e-6]),
)
def test_jitter_and_ordinary_drift_are_no_step(delays: list[tuple[int, int]], drift: float) -> None:
    clock = ClockOffset()
    for number, (there_ns, back_ns) in enumerate(delays):
        at_ns = 4 * number * S
        exchange(clock, at_ns, there_ns, back_ns, OFFSET_NS + int(at_ns * drift))
    assert clock.steps == 0


def test_what_is_forgotten_does_not_count() -> None:
    clock = ClockOffset()
    exchange(clock, 0, MS, MS)
    clock.forget()
    assert not clock.known
