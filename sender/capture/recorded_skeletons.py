"""Recorded skeletons as a ``FrameSource``: no images, one set of skeletons an instant."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from sender.capture.frame_set import EndOfFrames, FrameSet
from sender.capture.outside_skeleton import Instant, SkeletonRecording
from sender.capture.recorded_rig import sleep_until
from sender.capture.skeleton_recording import open_skeleton_recording


class RecordedSkeletons:
    """Plays a recording of skeletons; ``realtime``, ``loop`` and ``start_ns`` as in ``RecordedRig``."""

    cameras: tuple[Camera, ...] = ()
    empty_room: tuple[NDArray[np.uint16] | None, ...] = ()
    room_colour: tuple[NDArray[np.uint8] | None, ...] = ()
    start_joints: NDArray[np.floating] | None = None
    has_depth = False

    def __init__(
        self, recording: SkeletonRecording, realtime: bool = True, loop: bool = False, start_ns: int | None = None
    ) -> None:
        self.recording = recording
        self.frame_rate_hz = recording.frame_rate_hz
        self._realtime = realtime
        self._schedule = _in_order(recording, loop)
        self._next = next(self._schedule, None)
        self._start_ns = start_ns

    @classmethod
    def open(
        cls, path: Path, realtime: bool = True, loop: bool = False, start_ns: int | None = None
    ) -> RecordedSkeletons:
        """The recording at ``path``; raises CaptureError as ``open_skeleton_recording`` does."""
        return cls(open_skeleton_recording(path), realtime, loop, start_ns)

    @property
    def epoch_ns(self) -> int | None:
        """The recording's time 0 on the clock of the capture times; None before the first ``read``."""
        return self._start_ns

    @property
    def duration_ns(self) -> int:
        """From the first instant to the last, played once."""
        return max(skeleton.capture_ns for skeleton in self.recording.instants[-1])

    def read(self, timeout_s: float) -> FrameSet | None:
        """The next instant, or None when none is due in time.

        Raises:
            EndOfFrames: the recording is over.
        """
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns()
        if self._next is None:
            raise EndOfFrames("the recording is over")
        start_ns, instant = self._start_ns, self._next
        capture_ns = start_ns + max(skeleton.capture_ns for skeleton in instant)
        if self._realtime and not sleep_until(capture_ns, deadline_ns):
            return None
        self._next = next(self._schedule, None)
        return FrameSet(capture_ns, (), _later(instant, start_ns))

    def close(self) -> None:
        """Nothing is held open."""


def _in_order(recording: SkeletonRecording, loop: bool) -> Iterator[Instant]:
    last_ns = max(skeleton.capture_ns for instant in recording.instants for skeleton in instant)
    length_ns = last_ns + round(1e9 / recording.frame_rate_hz)
    repetition = 0
    while repetition == 0 or loop:
        for instant in recording.instants:
            yield _later(instant, repetition * length_ns)
        repetition += 1


def _later(instant: Instant, by_ns: int) -> Instant:
    return tuple(replace(skeleton, capture_ns=skeleton.capture_ns + by_ns) for skeleton in instant)
