"""Virtual time: nothing waits, order and times are exact, and what would wait for ever says so."""

from __future__ import annotations

import asyncio
import time

import pytest

from scripts.virtual_time import Deadlock, VirtualTimeLoop, run_virtually


def test_an_hour_passes_at_once_and_timers_fire_in_order_at_their_time() -> None:
    loop, fired = VirtualTimeLoop(), []

    async def wait(seconds: float) -> None:
        await asyncio.sleep(seconds)
        fired.append((seconds, loop.now_ns()))

    async def main() -> None:
        await asyncio.gather(*(wait(seconds) for seconds in (3600.0, 0.001, 7.5)))

    begin = time.monotonic()
    run_virtually(main(), loop)
    assert time.monotonic() - begin < 5
    assert fired == [(0.001, 1_000_000), (7.5, 7_500_000_000), (3600.0, 3_600_000_000_000)]


def test_waiting_for_nothing_is_an_error() -> None:
    async def main() -> None:
        await asyncio.Event().wait()

    with pytest.raises(Deadlock):
        run_virtually(main(), VirtualTimeLoop())


def test_an_error_in_a_timer_or_a_task_left_behind_is_raised() -> None:
    loop = VirtualTimeLoop()

    async def main() -> None:
        loop.at(1, lambda: 1 / 0)
        await asyncio.sleep(1)

    with pytest.raises(ZeroDivisionError):
        run_virtually(main(), loop)
