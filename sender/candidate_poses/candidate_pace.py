"""How often a frame is made into a candidate pose: at most every so often, and only as often as the machine can bear.

Meshing takes a fast machine's core a fifth of its time and a slow one's half, where the skeletons would have to wait.
So the dearer a candidate was, the later the next one begins.
"""

from __future__ import annotations


class CandidatePace:
    """One candidate at a time. ``interval_ns``: of capture time, between two; ``busy_share`` (0..1]: at most this share
    of a core's time is spent on them."""

    def __init__(self, interval_ns: int, busy_share: float) -> None:
        self._interval_ns = interval_ns
        self._time_per_work = 1.0 / busy_share
        self._next_capture_ns: int | None = None
        self._begun_ns: int | None = None  # of the one at work
        self._rest_until_ns: int | None = None

    def due(self, capture_ns: int, now_ns: int) -> bool:
        """Whether the frame captured then may become one now."""
        if self._begun_ns is not None or (self._rest_until_ns is not None and now_ns < self._rest_until_ns):
            return False
        return self._next_capture_ns is None or capture_ns >= self._next_capture_ns

    def begin(self, capture_ns: int, now_ns: int) -> None:
        """That frame is being worked on."""
        self._next_capture_ns = capture_ns + self._interval_ns
        self._begun_ns = now_ns

    def done(self, work_ns: int) -> None:
        """It is a candidate now, and took so much time of a core."""
        if self._begun_ns is not None:
            self._rest_until_ns = self._begun_ns + int(work_ns * self._time_per_work)
            self._begun_ns = None
