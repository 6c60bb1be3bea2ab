"""A small virtual rig rendered in the test's own process, and the sender's paths before it."""

from __future__ import annotations

from functools import cache

import numpy as np

from common.runtime.clock import ManualClock
from common.runtime.stage_timer import StageTimer
from sender.capture.frame_set import DepthFrame, FrameSet
from sender.capture.performer import Performer, open_performer
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import RigRenderer
from sender.fitting.gauss_newton_tracker import GaussNewtonSettings, GaussNewtonTracker
from sender.pipeline import SkeletonPath, StreamIdentity, TrackedFrame
from sender.reconstruction.person_points import DepthReconstruction

RATE_HZ = 30.0
IDENTITY = StreamIdentity(person=0, epoch=77)


@cache
def performer() -> Performer:
    """The built-in performer."""
    return open_performer("builtin")


@cache
def renderer() -> RigRenderer:
    """Four noisy cameras of 320×240 around them."""
    return RigRenderer(performer(), RigSettings(width=320, height=240))


@cache
def frame_set(sequence: int) -> FrameSet:
    """What the cameras see at frame ``sequence``; the performer stands in an A-pose for the first 30."""
    frames = []
    capture_ns = round(sequence / RATE_HZ * 1e9)
    for index, camera in enumerate(renderer().cameras):
        depth = np.zeros((camera.height, camera.width), np.uint16)
        colour = np.zeros((camera.height, camera.width, 3), np.uint8)
        renderer().view(index, sequence / RATE_HZ, depth, colour)
        frames.append(DepthFrame(index, sequence, capture_ns, depth, colour))
    return FrameSet(capture_ns, tuple(frames))


def skeleton_path(tracker: GaussNewtonTracker | None = None) -> SkeletonPath:
    """The sender's fast path before those cameras."""
    cameras = renderer().cameras
    rooms = [renderer().empty_room(index) for index in range(len(cameras))]
    pictures = [renderer().empty_room_colour(index) for index in range(len(cameras))]
    return SkeletonPath(
        IDENTITY,
        DepthReconstruction(cameras, rooms, room_colour=pictures),
        tracker or GaussNewtonTracker(GaussNewtonSettings()),
        RATE_HZ,
        StageTimer(ManualClock()),
        ManualClock(),
    )


@cache
def tracked(frames: int = 45) -> tuple[TrackedFrame, ...]:
    """The first frames after the fast path."""
    path = skeleton_path()
    return tuple(path.process(frame_set(sequence)) for sequence in range(1, frames + 1))
