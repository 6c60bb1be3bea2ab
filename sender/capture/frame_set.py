"""What cameras deliver: depth frames, and sets of them taken at one instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera


@dataclass(frozen=True, slots=True, eq=False)
class DepthFrame:
    """One image of one camera.

    ``camera_index``: position in ``FrameSource.cameras``. ``capture_ns``: monotonic capture time [ns] of the source's
    clock. ``depth_mm`` (H, W) uint16, 0 = no reading. ``colour`` (H, W, 3) uint8 RGB registered to the depth, or None.
    """

    camera_index: int
    sequence: int
    capture_ns: int
    depth_mm: NDArray[np.uint16]
    colour: NDArray[np.uint8] | None


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """All cameras at one instant; ``frames[i]`` is camera i's frame or None when it is missing.

    ``capture_ns``: the instant (median of the members' capture times) [ns].
    """

    capture_ns: int
    frames: tuple[DepthFrame | None, ...]


class FrameSource(Protocol):
    """Where frames come from: virtual rig, recording, later live cameras.

    ``read`` blocks up to ``timeout_s`` for the next frame of any camera and returns None when none came in time;
    it raises ``EndOfFrames`` when there will be no more and ``CaptureError`` when the source broke.
    ``empty_room`` is the depth of each camera without a person (H, W) uint16 mm, where the source has one.
    ``start_joints`` (16, 3) [m, world; ``NAMED_JOINTS`` order] are the person's joints in the first frame, where the
    source knows them, as a sensor with a tracker of its own does.
    """

    @property
    def cameras(self) -> tuple[Camera, ...]: ...
    @property
    def empty_room(self) -> tuple[NDArray[np.uint16] | None, ...]: ...
    @property
    def frame_rate_hz(self) -> float: ...
    @property
    def start_joints(self) -> NDArray[np.floating] | None: ...
    def read(self, timeout_s: float) -> DepthFrame | None: ...
    def close(self) -> None: ...


class CaptureError(Exception):
    """A frame source cannot be opened or broke while running; the message says what and where."""


class EndOfFrames(Exception):
    """The source has played its last frame."""
