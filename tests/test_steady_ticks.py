"""Ticks keep their raster and count what they missed, however the loop is held up."""

from __future__ import annotations

import asyncio
import time

import pytest

from common.runtime.steady_ticks import steadily

PERIOD_S = 0.02


async def ticks(seconds: float, hold_up_s: dict[int, float]) -> tuple[list[float], int]:
    """When the ticks were, in periods since the first, and how many were missed. ``hold_up_s``: by number of the tick,
    how long it holds the loop up."""
    loop, times, missed = asyncio.get_running_loop(), list[float](), list[int]()

    def tick() -> None:
        times.append(loop.time())
        time.sleep(hold_up_s.get(len(times), 0))  # a hog: nothing else gets a turn

    with pytest.raises(TimeoutError):
        async with asyncio.timeout(seconds):
            await steadily(PERIOD_S, tick, missed.append)
    return [(at_s - times[0]) / PERIOD_S for at_s in times], sum(missed)


async def test_a_held_up_loop_misses_ticks_which_are_counted_and_the_raster_stays() -> None:
    times, missed = await ticks(0.6, hold_up_s={3: 7.4 * PERIOD_S, 8: 3.4 * PERIOD_S})
    raster = [round(at - 0.5) for at in times]  # late ones belong to the tick that was due
    assert len(set(raster)) == len(raster)
    assert missed >= 6 + 2
    assert abs(len(times) + missed - (raster[-1] + 1)) <= 2


async def test_a_free_loop_misses_none_and_does_not_drift() -> None:
    times, missed = await ticks(0.5, hold_up_s={})
    assert len(times) + missed >= 0.5 / PERIOD_S - 3
    assert times[-1] - (len(times) - 1) - missed < 2
