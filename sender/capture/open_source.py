"""From settings to a running frame source."""

from __future__ import annotations

from pathlib import Path

from sender.capture.frame_set import FrameSource
from sender.capture.recorded_rig import RecordedRig
from sender.capture.recorded_skeletons import RecordedSkeletons
from sender.capture.rig_layout import RigSettings
from sender.capture.skeleton_recording import SUFFIXES
from sender.capture.virtual_rig import VirtualRig
from sender.config import CaptureSettings


def open_source(settings: CaptureSettings) -> FrameSource:
    """The source the settings name.

    Raises:
        CaptureError: it cannot be opened; the message says what and where.
    """
    if settings.source == "recording":
        assert settings.recording is not None  # the settings were checked
        return open_player(settings.recording, settings.realtime, settings.loop)
    if settings.source == "rig":
        assert settings.rig_socket is not None
        return VirtualRig.attach(settings.rig_socket, settings.depth)
    return VirtualRig.start(
        RigSettings(
            performer=settings.body,
            motion=settings.motion,
            data=None if settings.data is None else str(settings.data),
            cameras=settings.cameras,
            width=settings.width,
            height=settings.height,
            fps=settings.frame_rate_hz,
            seed=settings.seed,
            noise=settings.noise,
        ),
        settings.depth,
    )


def open_player(
    recording: Path, realtime: bool, loop: bool = False, start_ns: int | None = None
) -> RecordedRig | RecordedSkeletons:
    """The recording at a path, of whatever kind; the rest as in ``RecordedRig``.

    Raises:
        CaptureError: there is none, or it is malformed.
    """
    if recording.suffix in SUFFIXES:
        return RecordedSkeletons.open(recording, realtime, loop, start_ns)
    return RecordedRig.open(recording, realtime, loop, start_ns)
