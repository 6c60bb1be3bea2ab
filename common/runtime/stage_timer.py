"""How long each stage of a pipeline takes: percentiles over its latest runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from common.runtime.clock import Clock

REMEMBERED = 1024  # runs per stage: half a minute at 30 frames a second


@dataclass(frozen=True, slots=True)
class StageStatistics:
    """Durations [ms] of one stage. ``count``: all runs so far; the percentiles cover the latest ``REMEMBERED``."""

    count: int
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


class StageTimer:
    """Collects durations by stage name. One thread adds to a stage; any thread may read."""

    def __init__(self, clock: Clock, remembered: int = REMEMBERED) -> None:
        if remembered < 1:
            raise ValueError(f"remembered must be at least 1, not {remembered}")
        self._clock = clock
        self._remembered = remembered
        self._durations_ns: dict[str, deque[int]] = {}
        self._counts: dict[str, int] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block and add it to ``name``, also when it raises."""
        begin_ns = self._clock.now_ns()
        try:
            yield
        finally:
            self.add(name, self._clock.now_ns() - begin_ns)

    def add(self, name: str, duration_ns: int) -> None:
        """Add one run of ``duration_ns`` to stage ``name``."""
        recent = self._durations_ns.get(name)
        if recent is None:
            recent = self._durations_ns[name] = deque(maxlen=self._remembered)
        recent.append(duration_ns)
        self._counts[name] = self._counts.get(name, 0) + 1

    def statistics(self) -> dict[str, StageStatistics]:
        """Statistics of every stage that ran, in the order of their first runs."""
        return {
            name: _statistics(self._counts.get(name, 0), sorted(durations_ns.copy()))
            for name, durations_ns in self._durations_ns.copy().items()
            if durations_ns
        }


def _statistics(count: int, ordered_ns: list[int]) -> StageStatistics:
    """Nearest-rank percentiles of ``ordered_ns``, which is sorted and not empty."""

    def percentile_ms(percent: int) -> float:
        rank = -(-percent * len(ordered_ns) // 100)  # the smallest rank that covers ``percent`` of the runs
        return ordered_ns[rank - 1] / 1e6

    return StageStatistics(count, percentile_ms(50), percentile_ms(95), percentile_ms(99), percentile_ms(100))
