"""From settings and an open source to the fast path before it: the same for the daemon and for offline encoding."""

from __future__ import annotations

from common.runtime.clock import Clock
from common.runtime.stage_timer import StageTimer
from sender.capture.frame_set import FrameSource
from sender.capture.recorded_skeletons import RecordedSkeletons
from sender.capture.synchronizer import Synchronizer
from sender.config import TrackingSettings
from sender.fitting.outside_tracker import OutsideTracker
from sender.fitting.tracker import Tracker
from sender.pipeline import SkeletonPath, StreamIdentity
from sender.reconstruction.person_points import DepthReconstruction, HullReconstruction


def open_skeleton_path(
    identity: StreamIdentity,
    source: FrameSource,
    settings: TrackingSettings,
    tracker: Tracker,
    outside: OutsideTracker | None,
    timer: StageTimer,
    clock: Clock,
) -> SkeletonPath:
    """The fast path before ``source``'s cameras, or its sensors (``outside``)."""
    given = source.cameras, source.empty_room, settings.points
    inside = settings.tracker == "particles"
    reconstruction = (
        DepthReconstruction(*given, source.room_colour) if source.has_depth else HullReconstruction(*given, inside)
    )
    rate_hz = source.frame_rate_hz
    return SkeletonPath(identity, reconstruction, tracker, rate_hz, timer, clock, source.start_joints, outside)


def open_synchronizer(source: FrameSource, patience_ms: float) -> Synchronizer:
    """Sets of ``source``'s frames within half a frame's time."""
    cameras = source.cameras
    half_a_frame_ns = int(0.5e9 / source.frame_rate_hz)
    shapes = [(camera.height, camera.width) for camera in cameras]
    return Synchronizer(len(cameras), half_a_frame_ns, int(patience_ms * 1e6), shapes)


def outside_tracker(source: FrameSource) -> OutsideTracker | None:
    """For a source whose sensors track by themselves."""
    if not isinstance(source, RecordedSkeletons):
        return None
    return OutsideTracker(source.recording.kind, source.recording.sensors)
