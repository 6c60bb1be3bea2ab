"""A short recording of the built-in performer, and the session that ``telepose-send encode`` makes of it."""

from __future__ import annotations

from pathlib import Path

from sender.capture.recording_folder import write_recording
from sender.config import SenderSettings
from sender.encode import EncodeOptions, encode
from tests.rig_scene import RATE_HZ, frame_set, renderer

FRAMES = 30
SITE = "studio"


def write_frames(folder: Path, count: int = FRAMES) -> Path:
    """The performer's first frames, by four noisy cameras, as a recording."""
    frames = [frame for sequence in range(1, count + 1) for frame in frame_set(sequence).frames if frame is not None]
    rooms = [renderer().empty_room(index) for index in range(len(renderer().cameras))]
    write_recording(folder, renderer().cameras, frames, RATE_HZ, rooms)
    return folder


def encoded(recording: Path, file: Path, mbit: float = 4.0, settings: SenderSettings | None = None) -> list[str]:
    """Encodes; what was said."""
    said: list[str] = []
    assert encode(settings or SenderSettings(), EncodeOptions(recording, file, mbit), said.append) == 0
    return said
