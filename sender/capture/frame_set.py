"""What cameras deliver: frames, with depth or without, and sets of them taken at one instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from sender.capture.outside_skeleton import Instant


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

    @property
    def shape(self) -> tuple[int, ...]:
        """Height and width [pixels]; ValueError when depth and colour are not images of one size."""
        return _common_shape((self.depth_mm, np.uint16, 2), (self.colour, np.uint8, 3))


@dataclass(frozen=True, slots=True, eq=False)
class ColourFrame:
    """One image of a camera without depth; index, sequence and time as a ``DepthFrame``'s.

    ``colour`` (H, W, 3) uint8 RGB; ``silhouette`` (H, W) uint8, 128 and more = a person, where the source has found
    the people itself. One of them may be None.
    """

    camera_index: int
    sequence: int
    capture_ns: int
    colour: NDArray[np.uint8] | None
    silhouette: NDArray[np.uint8] | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Height and width [pixels]; ValueError without an image, or when the two are not of one size."""
        return _common_shape((self.silhouette, np.uint8, 2), (self.colour, np.uint8, 3))


Frame = DepthFrame | ColourFrame


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """All cameras at one instant; ``frames[i]`` is camera i's frame or None when it is missing.

    ``capture_ns``: the instant (median of the members' capture times) [ns]. ``skeletons``: found by the
    sensors' own software, in place of frames.
    """

    capture_ns: int
    frames: tuple[Frame | None, ...]
    skeletons: Instant = ()


class FrameSource(Protocol):
    """Where frames come from: virtual rig, recording, later live cameras.

    ``read`` blocks up to ``timeout_s`` for the next frame of any camera and returns None when none came in time; a
    source of skeletons, without cameras, returns a whole set;
    it raises ``EndOfFrames`` when there will be no more and ``CaptureError`` when the source broke.
    ``has_depth``: whether its frames are ``DepthFrame``s; else they are ``ColourFrame``s.
    ``empty_room`` shows each camera's view without a person, where the source has it: the depth (H, W) uint16 mm, or
    frames (F, H, W, 3) uint8 RGB of a colour camera. ``room_colour``: its picture (H, W, 3) uint8 RGB without a person,
    of a depth camera of which the source has that, too.
    ``start_joints`` (16, 3) [m, world; ``NAMED_JOINTS`` order] are the person's joints in the first frame, where the
    source knows them, as a sensor with a tracker of its own does.
    """

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
    def start_joints(self) -> NDArray[np.floating] | None: ...
    def read(self, timeout_s: float) -> Frame | FrameSet | None: ...
    def close(self) -> None: ...


class CaptureError(Exception):
    """A frame source cannot be opened or broke while running; the message says what and where."""


class EndOfFrames(Exception):
    """The source has played its last frame."""


def _common_shape(*images: tuple[NDArray[Any] | None, type, int]) -> tuple[int, ...]:
    """Height and width of the images there are (image, its dtype, its axes)."""
    shapes = set()
    for image, dtype, axes in images:
        if image is None:
            continue
        if image.dtype != dtype or image.ndim != axes or image.shape[2:] not in ((), (3,)):
            raise ValueError(f"an image of {image.dtype} {image.shape}")
        shapes.add(image.shape[:2])
    if len(shapes) != 1:
        raise ValueError(f"images of sizes {sorted(shapes)}" if shapes else "a frame without an image")
    return shapes.pop()
