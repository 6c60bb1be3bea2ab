"""The capture thread: sets come out, the end of a recording ends it, a broken source fails it."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

import numpy as np
import pytest

from common.runtime.clock import MonotonicClock
from sender.capture.capture_thread import CaptureThread
from sender.capture.frame_set import CaptureError, DepthFrame, EndOfFrames, FrameSet
from sender.capture.synchronizer import Synchronizer

FRAME_NS = 33_333_333


class ScriptedSource:
    """Gives the frames of a list, then raises."""

    cameras = ()
    empty_room = ()
    frame_rate_hz = 30.0
    start_joints = None

    def __init__(self, frames: Iterable[DepthFrame], end: Exception) -> None:
        self._frames = iter(frames)
        self._end = end

    def read(self, timeout_s: float) -> DepthFrame | None:
        frame = next(self._frames, None)
        if frame is None:
            raise self._end
        return frame

    def close(self) -> None:
        pass


class SilentSource(ScriptedSource):
    """Never has a frame."""

    def read(self, timeout_s: float) -> DepthFrame | None:
        return None


def frames(count: int) -> list[DepthFrame]:
    image = np.zeros((4, 4), np.uint16)
    return [DepthFrame(camera, i, i * FRAME_NS, image, None) for i in range(count) for camera in (0, 1)]


def thread(source: ScriptedSource, sets: list[FrameSet]) -> CaptureThread:
    return CaptureThread(source, Synchronizer(2, FRAME_NS // 2, 10**9), sets.append, MonotonicClock())


async def test_frames_of_two_cameras_become_sets_and_the_end_is_no_failure():
    sets: list[FrameSet] = []
    capture = thread(ScriptedSource(frames(5), EndOfFrames("over")), sets)
    await asyncio.wait_for(capture.run(), 5)
    assert [s.capture_ns for s in sets] == [i * FRAME_NS for i in range(5)]
    assert (capture.frames, capture.sets) == (10, 5)


async def test_a_broken_source_fails_the_owner():
    with pytest.raises(CaptureError, match="unplugged"):
        await asyncio.wait_for(thread(ScriptedSource([], CaptureError("unplugged")), []).run(), 5)


async def test_cancelling_stops_the_thread():
    task = asyncio.create_task(thread(SilentSource([], EndOfFrames("")), []).run())
    await asyncio.sleep(0.05)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asyncio.wait_for(task, 5)
