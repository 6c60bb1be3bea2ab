"""A recording as a ``FrameSource``: played at its own rate, or as fast as it is read."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from sender.capture.calibrated_videos import CalibratedVideos
from sender.capture.frame_set import CaptureError, ColourFrame, DepthFrame, EndOfFrames, Frame
from sender.capture.recording_folder import DepthkitFolder, RecordingFolder
from sender.capture.utd_mhad import UtdMhadSequence

_DECODED_AHEAD = 2  # frames per camera; decoding two PNGs takes milliseconds
_DECODERS = 2

Images = tuple[NDArray[Any] | None, NDArray[np.uint8] | None]


class Recording(Protocol):
    """What a folder or file holds. ``frames`` is the index of (time_ns, camera, number), sorted; ``has_depth``,
    ``empty_room`` and ``room_colour`` as a ``FrameSource``'s."""

    @property
    def cameras(self) -> tuple[Camera, ...]: ...
    @property
    def has_depth(self) -> bool: ...
    @property
    def empty_room(self) -> tuple[NDArray[Any] | None, ...]: ...
    @property
    def room_colour(self) -> tuple[NDArray[np.uint8] | None, ...]: ...
    @property
    def frame_rate_hz(self) -> float: ...
    @property
    def frames(self) -> tuple[tuple[int, int, int], ...]: ...
    @property
    def start_joints(self) -> NDArray[np.floating] | None: ...
    def load(self, camera_index: int, number: int) -> Images:
        """Depth (H, W) uint16 [mm], or, of a camera without depth, silhouette (H, W) uint8 or None; and colour
        (H, W, 3) uint8 RGB or None. CaptureError when they cannot be read."""
        ...


def open_recording(path: Path) -> Recording:
    """The recording at ``path``: our own folder (docs/recordings.md), a UTD-MHAD file or folder, a Depthkit folder,
    or videos or silhouettes of calibrated colour cameras.

    Raises:
        CaptureError: nothing there that is known, or it is malformed; the message names the file and the fault.
    """
    if path.suffix == ".mat" or (path / "Depth").is_dir():
        return UtdMhadSequence(path)
    if (path / "recording.json").exists():
        return RecordingFolder(path)
    if (path / "intrinsics.json").exists():
        return DepthkitFolder(path)
    if (path / "calibration.json").exists():
        return CalibratedVideos(path)
    known = "recording.json, intrinsics.json, calibration.json, Depth/*.mat or a .mat file"
    raise CaptureError(f"{path}: no recording here ({known})")


class RecordedRig:
    """Plays a recording.

    ``realtime``: frames come at the times at which they were taken, counted from the first ``read``; otherwise as fast
    as they are read, with the capture times they would have had. ``start_ns``: time 0 of the capture times, without it
    the first ``read``. ``loop``: start again at the end. Frames that cannot be decoded are left out; ``dropped`` counts
    them and ``last_error`` says why. Not thread-safe: close it when no thread is reading any more.
    """

    def __init__(
        self, recording: Recording, realtime: bool = True, loop: bool = False, start_ns: int | None = None
    ) -> None:
        self._recording = recording
        self._realtime = realtime
        self._decoders = ThreadPoolExecutor(_DECODERS, thread_name_prefix="decoder")
        self._schedule = self._in_order(loop)
        self._decoding: deque[tuple[int, int, int, Future[Images]]] = deque()
        self._start_ns = start_ns
        self.dropped = 0
        self.last_error = ""
        self._decode_ahead()

    @classmethod
    def open(cls, path: Path, realtime: bool = True, loop: bool = False, start_ns: int | None = None) -> RecordedRig:
        """The recording at ``path``; raises CaptureError as ``open_recording`` does."""
        return cls(open_recording(path), realtime, loop, start_ns)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self._recording.cameras

    @property
    def has_depth(self) -> bool:
        return self._recording.has_depth

    @property
    def empty_room(self) -> tuple[NDArray[Any] | None, ...]:
        return self._recording.empty_room

    @property
    def room_colour(self) -> tuple[NDArray[np.uint8] | None, ...]:
        return self._recording.room_colour

    @property
    def frame_rate_hz(self) -> float:
        return self._recording.frame_rate_hz

    @property
    def start_joints(self) -> NDArray[np.floating] | None:
        return self._recording.start_joints

    @property
    def epoch_ns(self) -> int | None:
        """The recording's time 0 on the clock of the capture times; None before the first ``read``."""
        return self._start_ns

    @property
    def duration_ns(self) -> int:
        """From the first frame to the last, played once."""
        return self._recording.frames[-1][0]

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, or None when none is due in time.

        Raises:
            EndOfFrames: the recording is over.
        """
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns()
        while self._decoding:
            time_ns, camera, sequence, images = self._decoding[0]
            capture_ns = self._start_ns + time_ns
            if self._realtime and not sleep_until(capture_ns, deadline_ns):
                return None
            self._decoding.popleft()
            self._decode_ahead()
            try:
                return self._frame(camera, sequence, capture_ns, *images.result())
            except CaptureError as error:
                self.dropped += 1
                self.last_error = str(error)
        raise EndOfFrames(f"the recording is over, {self.dropped} frames could not be read")

    def _frame(
        self, camera: int, sequence: int, capture_ns: int, first: NDArray[Any] | None, colour: NDArray[np.uint8] | None
    ) -> Frame:
        if not self.has_depth:
            return ColourFrame(camera, sequence, capture_ns, colour, first)
        assert first is not None
        return DepthFrame(camera, sequence, capture_ns, first, colour)

    def close(self) -> None:
        """Stop decoding."""
        self._decoding.clear()
        self._decoders.shutdown(wait=False, cancel_futures=True)

    def _decode_ahead(self) -> None:
        while len(self._decoding) < _DECODED_AHEAD * len(self.cameras):
            following = next(self._schedule, None)
            if following is None:
                return
            time_ns, camera, number, sequence = following
            images = self._decoders.submit(self._recording.load, camera, number)
            self._decoding.append((time_ns, camera, sequence, images))

    def _in_order(self, loop: bool) -> Iterator[tuple[int, int, int, int]]:
        """Time [ns], camera, number and a sequence that goes on over repetitions."""
        frames = self._recording.frames
        length_ns = frames[-1][0] + round(1e9 / self.frame_rate_hz)
        numbers = max(number for _, _, number in frames) + 1
        repetition = 0
        while repetition == 0 or loop:
            for time_ns, camera, number in frames:
                yield time_ns + repetition * length_ns, camera, number, number + repetition * numbers
            repetition += 1


def sleep_until(time_ns: int, deadline_ns: int) -> bool:
    """Sleep until ``time_ns``, or only until the deadline if that is earlier; whether the time has come."""
    wait_ns = min(time_ns, deadline_ns) - time.monotonic_ns()
    if wait_ns > 0:
        time.sleep(wait_ns / 1e9)
    return time_ns <= deadline_ns
