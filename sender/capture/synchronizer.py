"""Frames of several cameras into sets of one instant, by capture time.

Cameras deliver in order, so once every camera has shown a frame of an instant or of a later one, nothing more of it
can come and it is delivered, complete or not; the patience bounds the wait when a camera has stopped altogether. Time
comes in as an argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from sender.capture.frame_set import Frame, FrameSet

MAX_OPEN = 8  # instants waited for at once; the oldest has to go when there are more
RESTART_NS = 2_000_000_000  # a frame so much older than the last set means that the source's clock started anew


@dataclass(slots=True)
class SynchronizerCounters:
    """``sets`` delivered, of which ``complete``; ``missing``: frames that sets lacked; ``late``: frames of an instant
    already delivered; ``duplicate``; ``rejected``: unknown camera or wrong image; ``restarts`` of the source's clock.
    """

    sets: int = 0
    complete: int = 0
    missing: int = 0
    late: int = 0
    duplicate: int = 0
    rejected: int = 0
    restarts: int = 0


@dataclass(slots=True)
class _OpenSet:
    anchor_ns: int  # capture time of the first frame to arrive
    opened_ns: int
    frames: list[Frame | None] = field(default_factory=list)


class Synchronizer:
    """Sets of up to ``camera_count`` frames whose capture times differ by at most ``tolerance_ns`` from the first one.

    ``patience_ns``: how long after a set's first frame the others are waited for. ``shapes``: (height, width) of each
    camera's images; frames of another shape are rejected. Without cameras there is nothing to synchronise.
    """

    def __init__(
        self,
        camera_count: int,
        tolerance_ns: int,
        patience_ns: int,
        shapes: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        if camera_count < 0 or tolerance_ns < 0 or patience_ns < 0:
            raise ValueError(f"synchronizer: {camera_count} cameras, tolerance {tolerance_ns}, patience {patience_ns}")
        if shapes is not None and len(shapes) != camera_count:
            raise ValueError(f"synchronizer: {len(shapes)} image shapes for {camera_count} cameras")
        self.counters = SynchronizerCounters()
        self._count = camera_count
        self._tolerance_ns = tolerance_ns if camera_count > 1 else 0
        self._patience_ns = patience_ns
        self._shapes = shapes
        self._open: list[_OpenSet] = []  # by capture time
        self._delivered_ns: int | None = None  # anchor of the last delivered set
        self._seen_ns: list[list[int]] = [[] for _ in range(camera_count)]  # last capture times of each camera

    def push(self, frame: Frame, now_ns: int) -> list[FrameSet]:
        """Take a frame in; the sets that can be delivered now, oldest first."""
        if not self._acceptable(frame):
            self.counters.rejected += 1
            return self.expire(now_ns)
        if self._delivered_ns is not None and frame.capture_ns < self._delivered_ns - RESTART_NS:
            self.counters.restarts += 1
            self._open, self._delivered_ns, self._seen_ns = [], None, [[] for _ in range(self._count)]
        camera, time_ns = frame.camera_index, frame.capture_ns
        home = self._home(time_ns)
        if time_ns in self._seen_ns[camera] or (home is not None and home.frames[camera] is not None):
            self.counters.duplicate += 1
        elif home is None and self._delivered_ns is not None and time_ns <= self._delivered_ns + self._tolerance_ns:
            self.counters.late += 1
        else:
            if home is None:
                home = _OpenSet(time_ns, now_ns, [None] * self._count)
                self._open.append(home)
                self._open.sort(key=lambda waiting: waiting.anchor_ns)
            home.frames[camera] = frame
            self._seen_ns[camera] = [*self._seen_ns[camera][-MAX_OPEN:], time_ns]
        return self.expire(now_ns)

    def expire(self, now_ns: int) -> list[FrameSet]:
        """The sets that are complete, hopeless or out of patience at ``now_ns``, oldest first."""
        newest_due = -1
        for index, waiting in enumerate(self._open):
            out_of_patience = now_ns - waiting.opened_ns >= self._patience_ns
            too_many = len(self._open) - index > MAX_OPEN
            if self._nothing_to_come(waiting) or out_of_patience or too_many:
                newest_due = index
        due, self._open = self._open[: newest_due + 1], self._open[newest_due + 1 :]
        return [self._deliver(waiting) for waiting in due]

    @property
    def waiting_since_ns(self) -> int | None:
        """When the oldest waiting set was opened, to know when ``expire`` has something to do."""
        return min((waiting.opened_ns for waiting in self._open), default=None)

    def _acceptable(self, frame: Frame) -> bool:
        if not 0 <= frame.camera_index < self._count:
            return False
        try:
            return self._shapes is None or frame.shape == self._shapes[frame.camera_index]
        except ValueError:
            return False

    def _home(self, time_ns: int) -> _OpenSet | None:
        """The nearest open set within tolerance."""
        near = [w for w in self._open if abs(w.anchor_ns - time_ns) <= self._tolerance_ns]
        return min(near, key=lambda waiting: abs(waiting.anchor_ns - time_ns), default=None)

    def _nothing_to_come(self, waiting: _OpenSet) -> bool:
        """Whether each camera has delivered its frame of this instant or a later one."""
        later_ns = waiting.anchor_ns + self._tolerance_ns
        return all(
            frame is not None or any(seen > later_ns for seen in self._seen_ns[camera])
            for camera, frame in enumerate(waiting.frames)
        )

    def _deliver(self, waiting: _OpenSet) -> FrameSet:
        times = sorted(frame.capture_ns for frame in waiting.frames if frame is not None)
        missing = self._count - len(times)
        self._delivered_ns = waiting.anchor_ns
        self.counters.sets += 1
        self.counters.complete += missing == 0
        self.counters.missing += missing
        median_ns = (times[(len(times) - 1) // 2] + times[len(times) // 2]) // 2
        return FrameSet(median_ns, tuple(waiting.frames))
