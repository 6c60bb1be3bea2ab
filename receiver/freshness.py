"""Whether a skeleton is worth showing: one that waited in queues on its way shows what was, not what is.

How long it waited is its transit above the least of late, so that no common clock is needed. What waited for long comes
after an outage, or where a path cannot carry the stream. Pure: times are arguments.
"""

from __future__ import annotations

from collections import deque

STALE_NS = 400_000_000  # with an idle path of up to 100 ms nothing is shown that is older than 500 ms
REMEMBERED = 300  # arrivals: a sender whose timeline is slower than life is late by little within these


class Freshness:
    """One receiver's, of one stream. ``stale``: how many were not fresh."""

    def __init__(self) -> None:
        self.stale = 0
        self._epoch: int | None = None
        self._transits_ns: deque[int] = deque(maxlen=REMEMBERED)

    def is_fresh(self, epoch: int, send_ns: int, arrival_ns: int) -> bool:
        """Of a skeleton of the sender's run ``epoch``: sent by its clock, arrived by ours."""
        if epoch != self._epoch:
            self._epoch = epoch
            self._transits_ns.clear()
        self._transits_ns.append(arrival_ns - send_ns)
        fresh = self._transits_ns[-1] - min(self._transits_ns) <= STALE_NS
        self.stale += not fresh
        return fresh
