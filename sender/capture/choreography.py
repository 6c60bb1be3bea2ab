"""The built-in performer's routine."""

from __future__ import annotations

from sender.capture.frame_set import CaptureError
from sender.capture.mocap import MotionClip


def routine() -> MotionClip:
    """The routine."""
    raise CaptureError("the built-in routine is not there yet")
