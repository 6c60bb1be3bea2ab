"""``telepose-send encode``: a recording into a session file, without a network."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from common.runtime.clock import MonotonicClock
from common.runtime.progress import ProgressLine
from common.runtime.session_recording import RecordingError, SessionWriter, StoredMessage
from common.transport.channels import SCHEMA
from common.wire.residual_video import VideoUnavailable
from sender.capture.frame_set import CaptureError
from sender.capture.open_source import open_player
from sender.capture.recorded_rig import RecordedRig
from sender.capture.recorded_skeletons import RecordedSkeletons
from sender.config import SenderSettings
from sender.fitting.particle_weights_opencl import OpenClUnavailable
from sender.session_encoder import EncodedAmount, SessionEncoder, frame_sets

LAYERS = {"skeleton": "skeletons", "pose": "candidate poses", "residual": "residual maps"}
INTERRUPTED = 130


class EncodeError(Exception):
    """No session could be made; the text says why."""


@dataclass(frozen=True, slots=True)
class EncodeOptions:
    """``recording`` → ``file`` over a link of ``mbit`` Mbit/s; at most ``seconds`` of it, None: all."""

    recording: Path
    file: Path
    mbit: float
    seconds: float | None = None


def encode(settings: SenderSettings, options: EncodeOptions, say: Callable[[str], None]) -> int:
    """Write the session and ``say`` what it takes; the exit code. Stopped by Ctrl-C, what there is by then is kept.

    Raises:
        EncodeError: the recording cannot be played, the file not be written, or nobody is found in it.
    """
    try:
        source = open_player(options.recording, realtime=False, start_ns=0)
        try:
            return _encode(settings, options, source, say)
        finally:
            source.close()
    except (CaptureError, RecordingError, OpenClUnavailable, VideoUnavailable) as error:
        raise EncodeError(str(error)) from error


def _encode(
    settings: SenderSettings,
    options: EncodeOptions,
    source: RecordedRig | RecordedSkeletons,
    say: Callable[[str], None],
) -> int:
    clock = MonotonicClock()
    encoder = SessionEncoder(settings, source, options.mbit * 1e6)
    with SessionWriter(options.file, SCHEMA, _about(settings, options, source)) as writer:
        interrupted = False
        try:
            _work(encoder, writer, source, options.seconds, settings.capture.patience_ms, clock)
        except KeyboardInterrupt:
            interrupted = True
        _write(writer, encoder.finish())
        if encoder.amount.skeletons == 0:
            raise EncodeError(f"{options.recording}: nobody was found in {encoder.amount.seconds:.1f} s of it")
        size = writer.finish()
    if interrupted:
        say("stopped; what was encoded by then is kept")
    for line in summary(encoder.amount, size, len(source.cameras), options.file):
        say(line)
    if isinstance(source, RecordedRig) and source.dropped:
        say(f"{source.dropped} frames could not be read, the last one: {source.last_error}")
    return INTERRUPTED if interrupted else 0


def _work(
    encoder: SessionEncoder,
    writer: SessionWriter,
    source: RecordedRig | RecordedSkeletons,
    seconds: float | None,
    patience_ms: float,
    clock: MonotonicClock,
) -> None:
    length_s = source.duration_ns / 1e9
    length_s = length_s if seconds is None else min(seconds, length_s)
    progress = ProgressLine("encode", sys.stderr, clock)
    begin_ns = clock.now_ns()
    for frames in frame_sets(source, patience_ms):
        if frames.capture_ns / 1e9 > length_s:
            break
        _write(writer, encoder.process(frames))
        done_s, passed_s = frames.capture_ns / 1e9, (clock.now_ns() - begin_ns) / 1e9
        speed = done_s / max(passed_s, 1e-3)
        progress.show(done_s / max(length_s, 1e-3), f"{done_s:.1f} of {length_s:.1f} s, {speed:.2f} x real time")
    progress.clear()


def _write(writer: SessionWriter, messages: Iterable[StoredMessage]) -> None:
    for message in messages:
        writer.add(message.key, message.time_ns, message.payload)


def _about(settings: SenderSettings, options: EncodeOptions, source: RecordedRig | RecordedSkeletons) -> dict[str, str]:
    return {
        "site": settings.site,
        "person": str(settings.person),
        "recording": options.recording.name,
        "mbit": f"{options.mbit:g}",
        "frame_rate_hz": f"{source.frame_rate_hz:g}",
    }


def summary(amount: EncodedAmount, size: int, cameras: int, file: Path) -> list[str]:
    """What the session takes: bytes per second of each layer and of the whole file, and raw images over each."""
    seconds = max(amount.seconds, 1e-3)
    lines = [
        f"{file}: {seconds:.1f} s, {amount.frame_sets} frames of {cameras} cameras, "
        f"{amount.skeletons} skeletons, {amount.poses} candidate poses{_level(amount)}",
        f"{'':18}{'bytes/s':>12}{'raw images : 1':>18}",
    ]
    if amount.raw_bytes:
        lines.append(f"{'raw images':18}{amount.raw_bytes / seconds:12,.0f}{1:18}")
    named = [(words, amount.layer_bytes[layer]) for layer, words in LAYERS.items() if amount.layer_bytes[layer]]
    for words, taken in [*named, ("the file", size)]:
        ratio = f"{amount.raw_bytes / taken:18,.0f}" if amount.raw_bytes else f"{'–':>18}"
        lines.append(f"{words:18}{taken / seconds:12,.0f}{ratio}")
    return lines


def _level(amount: EncodedAmount) -> str:
    return f", residual maps at {amount.level_sum / amount.residuals:.0f} % on average" if amount.residuals else ""
