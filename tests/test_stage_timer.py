"""Stage times: percentiles of known durations, bounded memory, and the manual clock itself."""

from __future__ import annotations

from contextlib import suppress

import pytest

from common.runtime.clock import ManualClock, MonotonicClock
from common.runtime.stage_timer import StageTimer

MS = 1_000_000


def test_percentiles_are_nearest_rank() -> None:
    timer = StageTimer(ManualClock())
    for duration_ms in range(100, 0, -1):
        timer.add("fit", duration_ms * MS)
    times = timer.statistics()["fit"]
    assert (times.count, times.p50_ms, times.p95_ms, times.p99_ms, times.max_ms) == (100, 50.0, 95.0, 99.0, 100.0)


def test_one_run_is_every_percentile() -> None:
    timer = StageTimer(ManualClock())
    timer.add("fit", 7 * MS)
    times = timer.statistics()["fit"]
    assert (times.p50_ms, times.p99_ms, times.max_ms) == (7.0, 7.0, 7.0)


def test_only_the_latest_runs_count_for_the_percentiles() -> None:
    timer = StageTimer(ManualClock(), remembered=3)
    for duration_ms in (1000, 1, 2, 3):
        timer.add("fit", duration_ms * MS)
    times = timer.statistics()["fit"]
    assert (times.count, times.max_ms) == (4, 3.0)


def test_a_stage_is_timed_even_when_it_raises() -> None:
    clock = ManualClock()
    timer = StageTimer(clock)
    with suppress(KeyError), timer.stage("decode"):
        clock.advance(4 * MS)
        raise KeyError
    with timer.stage("draw"):
        clock.advance(2 * MS)
    statistics = timer.statistics()
    assert list(statistics) == ["decode", "draw"]
    assert (statistics["decode"].p50_ms, statistics["draw"].p50_ms) == (4.0, 2.0)


def test_a_timer_that_remembers_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        StageTimer(ManualClock(), remembered=0)


def test_clocks_never_go_back() -> None:
    clock = MonotonicClock()
    assert clock.now_ns() <= clock.now_ns()
    with pytest.raises(ValueError, match="cannot go back"):
        ManualClock().advance(-1)
