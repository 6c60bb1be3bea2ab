"""Something done at a steady rate on the loop: on one raster, whatever holds the loop up meanwhile."""

from __future__ import annotations

import asyncio
from collections.abc import Callable


async def steadily(period_s: float, action: Callable[[], None], on_missed: Callable[[int], None] | None = None) -> None:
    """Call ``action`` now and every ``period_s`` from now on, until cancelled.

    A tick may be late, but not later than the next one is due: those are left out, and ``on_missed`` is told how many.
    """
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    while True:
        action()
        due_s += period_s
        missed = int(max(loop.time() - due_s, 0) / period_s)
        if missed and on_missed is not None:
            on_missed(missed)
        due_s += missed * period_s
        await asyncio.sleep(max(due_s - loop.time(), 0))
