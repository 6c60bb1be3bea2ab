"""``telepose-receive decode``: a session file played into a video, pictures or persons, as fast as it goes."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from common.runtime.clock import MonotonicClock
from common.runtime.progress import ProgressLine
from common.runtime.session_recording import RecordingError, SessionReader
from common.transport.channels import SCHEMA, SKELETON
from common.wire.header import WireError
from common.wire.skeleton_packet import decode_skeleton
from receiver.config import ReceiverSettings
from receiver.decoded_files import Output, PersonFolder, PictureFolder, PointFolder, VideoFile
from receiver.session_player import SessionPlayer, channel_of, display_ticks
from receiver.viewer.person_files import ExportError

DAMAGED, INTERRUPTED = 3, 130
DEFAULT_RATE_HZ, RATE_MAX_HZ = 30.0, 240.0
RATE_SKELETONS = 100  # so many tell at which rate they come
PERSONS_MAX = 255


class DecodeError(Exception):
    """The session cannot be played, or nothing be made of it; the text says why."""


@dataclass(frozen=True, slots=True)
class DecodeOptions:
    """``session`` → ``out``: a video if that ends in .mp4, else a folder of ``kind``: "png", "ply" or "glb".
    ``rate_hz``: None is the recording's own."""

    session: Path
    out: Path
    kind: str = "png"
    rate_hz: float | None = None
    width: int = 640
    height: int = 480
    angle_deg: float = 0.0


def decode(settings: ReceiverSettings, options: DecodeOptions, say: Callable[[str], None]) -> int:
    """Play the session into its files; the exit code: ``DAMAGED`` when it could be played only so far. Ctrl-C ends
    early and keeps what there is.

    Raises:
        DecodeError: no session, or nothing in it that can be shown; or a place that cannot be written.
    """
    try:
        reader = SessionReader(options.session, SCHEMA)
        rate_hz = options.rate_hz or frame_rate_hz(reader.about) or captured_rate_hz(options.session, person_of(reader))
        player = SessionPlayer(settings.repository, person_of(reader), (settings.view.mode,))
        output = _output(settings, options, rate_hz)
        try:
            interrupted = not _play(reader, player, output, rate_hz)
            check_played(reader, player)
            made = output.finish()
        finally:
            output.discard()
    except (RecordingError, ExportError) as error:
        raise DecodeError(str(error)) from error
    if interrupted:
        say("stopped; what was decoded by then is kept")
    say(made)
    for sentence in faults(reader, player):
        say(sentence)
    return INTERRUPTED if interrupted else DAMAGED if reader.damage else 0


def _play(reader: SessionReader, player: SessionPlayer, output: Output, rate_hz: float) -> bool:
    """To the end, or to Ctrl-C: then False."""
    progress = ProgressLine("decode", sys.stderr, MonotonicClock())
    try:
        for tick in display_ticks(reader.messages(), player, output.viewer, rate_hz):
            output.write(tick)
            progress.show(reader.share_read, f"{tick / rate_hz:.1f} s, {player.counts['poses']} meshes")
    except KeyboardInterrupt:
        return False
    finally:
        progress.clear()
    return True


def _output(settings: ReceiverSettings, options: DecodeOptions, rate_hz: float) -> Output:
    skinning = settings.view.skinning
    seen = options.width, options.height, options.angle_deg, skinning, settings.view.mode
    if options.out.suffix.lower() == ".mp4":
        return VideoFile(options.out, rate_hz, *seen)
    if options.kind == "png":
        return PictureFolder(options.out, *seen)
    if settings.view.mode != "points":
        return PersonFolder(options.out, f".{options.kind}", skinning)
    if options.kind != "ply":
        raise ExportError(f"points are written as ply, not as {options.kind}")
    return PointFolder(options.out)


def person_of(reader: SessionReader) -> int:
    """Whom the session shows.

    Raises:
        RecordingError: it does not say.
    """
    text = reader.about.get("person", "")
    if not (text.isascii() and text.isdigit() and len(text) <= 3 and int(text) <= PERSONS_MAX):
        raise RecordingError(f"the session does not say which person it shows: {text!r:.20}")
    return int(text)


def frame_rate_hz(about: Mapping[str, str]) -> float | None:
    """The recording's, None where the session does not say."""
    try:
        rate_hz = float(about.get("frame_rate_hz", ""))
    except ValueError:
        return None
    return rate_hz if 1 <= rate_hz <= RATE_MAX_HZ else None


def captured_rate_hz(session: Path, person: int) -> float:
    """At which a session's first skeletons were captured: a receiver that records does not know it when it begins.
    30 where there are too few.

    Raises:
        RecordingError: it cannot be read.
    """
    captured: dict[int, int] = {}  # by number; some may be lost
    for message in SessionReader(session, SCHEMA).messages():
        if channel_of(message.key, person) != SKELETON.name:
            continue
        with contextlib.suppress(WireError):
            packet = decode_skeleton(message.payload)
            captured[packet.sequence] = packet.capture_ns
        if len(captured) >= RATE_SKELETONS:
            break
    first, last = min(captured, default=0), max(captured, default=0)
    passed_ns = captured[last] - captured[first] if captured else 0
    rate_hz = (last - first) * 1e9 / passed_ns if passed_ns > 0 else DEFAULT_RATE_HZ
    return rate_hz if 1 <= rate_hz <= RATE_MAX_HZ else DEFAULT_RATE_HZ


def check_played(reader: SessionReader, player: SessionPlayer) -> None:
    """
    Raises:
        DecodeError: nothing of the session could be shown.
    """
    if player.counts["shown"]:
        return
    why = [f"its messages cannot be read: {player.last_error}"] if player.last_error else []
    why += [f"it is damaged: {reader.damage}"] if reader.damage else []
    raise DecodeError(f"nothing of the session could be shown: {'; '.join(why) or 'it holds no skeletons'}")


def faults(reader: SessionReader, player: SessionPlayer) -> list[str]:
    """What was wrong with a session that was played, one sentence each."""
    said = []
    if reader.damage:
        said.append(f"the session is damaged, and was played up to there: {reader.damage}")
    if player.counts["refused"]:
        said.append(f"{player.counts['refused']} messages could not be read, the last one: {player.last_error}")
    return said
