"""The one source of time: a monotonic clock in integer nanoseconds, passed to whoever needs it."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Something that tells the monotonic time [ns] of this host. Its zero means nothing; only differences do."""

    def now_ns(self) -> int: ...


class MonotonicClock:
    """The host's monotonic clock: unaffected by wall-clock steps, shared by all processes of the host."""

    def now_ns(self) -> int:
        return time.monotonic_ns()


class ManualClock:
    """A clock that stands still until it is advanced: time for tests and simulations."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def advance(self, duration_ns: int) -> None:
        """Move on by ``duration_ns``.

        Raises:
            ValueError: the duration is negative (a monotonic clock never goes back).
        """
        if duration_ns < 0:
            raise ValueError(f"a monotonic clock cannot go back by {-duration_ns} ns")
        self._now_ns += duration_ns
