"""Residual maps at 0 to 100 % beside today's codecs: bytes, quality and time of Lien 2009's Tables 1 and 2.

Cases are ``body/motion/cameras/method/level``. Synthetic people before virtual cameras with a sensor's noise, poses by
our own tracker, each motion repeated to 20 s; real recordings with ``--clips``. Figures are against the 10 000 points a
frame that go in (``scripts/residual_quality.py``); a residual frame's bytes include the skeleton packet.

"residual-video": groups of eight frames as a short video. ``psnr_db`` is of everything shown so late that all of it is
of one instant, ``psnr_late_db`` of skeletons shown at once and maps when they come. ``added_delay_ms``: from capturing
a group's first frame until it can be shown, the network left out.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from common.wire.skeleton_packet import SKELETON_PACKET_BYTES
from receiver.residual_decoder import ResidualDecoder, cloud
from scripts.fidelity_capture import FRAME_RATE_HZ, capture, show_progress
from scripts.residual_quality import Likeness
from scripts.residual_rivals import Encode, rivals
from scripts.residual_sequences import POINTS, PosedSequence, captured_sequence, recorded_sequence
from scripts.run_bench import Row
from sender.capture.rig_layout import cameras_around
from sender.residual_encoder import ResidualEncoder, ResidualSettings

MOTIONS = {"05_08": "female_slim", "14_06": "male_avg", "135_06": "male_avg", "16_15": "female_slim"}
RECORDINGS = ("uva_turning_person", "ddrnet_person", "kinect2_laptop")
LEVELS = (0.0, 25.0, 50.0, 100.0)
SEQUENCE_S = 20.0
CAPTURED_S = 20.0  # whatever is measured of it, so that it is captured once; motions repeat
LOOKED_AT_EVERY = 7  # frames: what is compared; bytes are of all
VIDEO_FRAMES = 8  # of a group
POINT_BYTES = 15  # three float32 and a colour
# Means over the four motions of L Tables 1 and 2, by level; ratios of 0 % count the model once in 28 to 240 s.
PAPER_PSNR_DB = {0.0: 25.0, 25.0: 27.2, 100.0: 29.2}
PAPER_RATIO = {0.0: 4144.0, 25.0: 184.2, 100.0: 60.9}
PAPER_RIVALS = {"yang": 11.9, "h264": 49.9}


def add_options(parser: argparse.ArgumentParser) -> None:
    """This bench's own options."""
    parser.add_argument("--cameras", default="4,8", help="how many, separated by commas")
    parser.add_argument("--methods", default="", help=f"{', '.join(OURS)}, a rival, or a rival/level; all")
    parser.add_argument("--levels", default="", help="levels [%%] of residuals, separated by commas")
    parser.add_argument("--captures", type=Path, help="folder where captured motions are kept for the next time")


def run(
    data: Path | None, seconds: float | None, clips: tuple[str, ...], cameras: str = "4,8", methods: str = "",
    levels: str = "", captures: Path | None = None,
) -> Iterator[Row]:  # fmt: skip
    """Rows for every clip, number of cameras, method and level."""
    kept = captures or Path(tempfile.gettempdir()) / f"telepose-captures-{os.getuid()}"
    wanted = [float(word) for word in levels.split(",") if word] or LEVELS
    for case, sequence in _sequences(data, seconds or SEQUENCE_S, clips, cameras, kept):
        chosen = [word for word in methods.split(",") if word]
        for method, measure in OURS.items():
            if not chosen or method in chosen:
                for level in wanted:
                    yield from _rows(f"{case}/{method}/{level:g}", sequence, measure(sequence, level), level)
        for name, make in rivals().items():
            if not chosen or name in chosen or name.partition("/")[0] in chosen:
                yield from _rows(f"{case}/{name}", sequence, _rival(sequence, make(sequence)), None)


def _sequences(
    data: Path | None, seconds: float, clips: tuple[str, ...], cameras: str, kept: Path
) -> Iterator[tuple[str, PosedSequence]]:
    known = {**MOTIONS, **dict.fromkeys(RECORDINGS, "")} if data is not None else {}
    wanted = {clip: known.get(clip, "builtin") for clip in clips} or (known if known else {"routine": "builtin"})
    for clip, body in wanted.items():
        if clip in RECORDINGS:
            assert data is not None, f"{clip}: --data is needed"
            sequence = recorded_sequence(clip, data)
            yield f"real/{clip}/{len(sequence.cameras)}", sequence
            continue
        for count in map(int, cameras.split(",")):
            case = f"{body}/{clip}/{count}"
            motion = None if clip == "routine" else clip
            recorded = capture(body, motion, data, count, CAPTURED_S, show_progress(f"capturing {case}"), kept)
            yield case, captured_sequence(case, recorded, cameras_around(count), round(seconds * FRAME_RATE_HZ))


@dataclass(slots=True)
class Measured:
    """One case: bytes and seconds of every frame coded, likeness of those looked at. ``late``: likeness with maps that
    come later than skeletons; ``delay_s``: how much later."""

    sizes: list[float] = field(default_factory=list)
    encode_s: list[float] = field(default_factory=list)
    decode_s: list[float] = field(default_factory=list)
    likeness: dict[int, Likeness] = field(default_factory=dict)
    late: dict[int, Likeness] = field(default_factory=dict)
    delay_s: list[float] = field(default_factory=list)


def _residual(sequence: PosedSequence, level: float, reference: Literal["model", "previous"] = "model") -> Measured:
    """Every frame through the residual encoder and decoder."""
    ours = ResidualEncoder(0, 1, ResidualSettings(POINTS, reference))
    theirs, out = ResidualDecoder(), Measured()
    for k in range(sequence.length):
        frame = sequence.residual_frame(k)
        begun = time.perf_counter()
        packet = ours.encode(frame, level)
        coded = time.perf_counter()
        if packet is not None:
            received = theirs.decode(packet, {frame.body_revision: frame.skeleton})
            assert received
        assert theirs.newest is not None
        shown = cloud(theirs.newest, frame.T_world_link)
        out.decode_s.append(time.perf_counter() - coded)
        out.encode_s.append(coded - begun)
        out.sizes.append((0 if packet is None else len(packet)) + SKELETON_PACKET_BYTES)
        if k % LOOKED_AT_EVERY == 0:
            out.likeness[k] = sequence.likeness(k, shown)
    return out


def _video(sequence: PosedSequence, level: float) -> Measured:
    """Every frame in a group of ``VIDEO_FRAMES``; what does not fill one at the end is left out."""
    ours, theirs = ResidualEncoder(0, 1, ResidualSettings(POINTS, video_frames=VIDEO_FRAMES)), ResidualDecoder()
    out, encode_s = Measured(), 0.0
    for k in range(sequence.length):
        frame = sequence.residual_frame(k)
        begun = time.perf_counter()
        packet = ours.encode(frame, level)
        coded = time.perf_counter()
        encode_s += coded - begun
        if packet is None:
            continue
        found = theirs.decode(packet, {f.body_revision: f.skeleton for f in (sequence.frame(k - 1), sequence.frame(k))})
        decoded = time.perf_counter()
        for maps in found:
            at = maps.header.skeleton_sequence
            shown_begun = time.perf_counter()
            shown = cloud(maps, sequence.frame(at).T_world_link)
            out.decode_s.append(time.perf_counter() - shown_begun + (decoded - coded) / len(found))
            out.encode_s.append(encode_s / len(found))
            out.sizes.append(len(packet) / len(found) + SKELETON_PACKET_BYTES)
            if at % LOOKED_AT_EVERY == 0:
                out.likeness[at] = sequence.likeness(at, shown)
                then = at + VIDEO_FRAMES
                if then < sequence.length and sequence.frame(then).skeleton is maps.skeleton:
                    out.late[then] = sequence.likeness(then, cloud(maps, sequence.frame(then).T_world_link))
        out.delay_s.append((len(found) - 1) / FRAME_RATE_HZ + (decoded - begun))
        encode_s = 0.0
    return out


# Of our own methods, how a level of one is measured.
OURS: dict[str, Callable[[PosedSequence, float], Measured]] = {
    "residual": _residual,
    "previous": partial(_residual, reference="previous"),
    "residual-video": _video,
}


def _rival(sequence: PosedSequence, encode: Encode) -> Measured:
    """The frames looked at, coded by a rival."""
    out = Measured()
    for k in range(0, sequence.length, LOOKED_AT_EVERY):
        frame = encode(sequence, k)
        begun = time.perf_counter()
        shown = frame.decoded()
        out.decode_s.append(time.perf_counter() - begun)
        out.encode_s.append(frame.encode_s)
        out.sizes.append(frame.size_bytes)
        out.likeness[k] = sequence.likeness(k, shown)
    return out


def _rows(case: str, sequence: PosedSequence, measured: Measured, level: float | None) -> list[Row]:
    size = float(np.mean(measured.sizes))
    points = float(np.mean([len(sequence.cloud(k)) for k in measured.likeness]))
    all_db = [seen.psnr_db for seen in measured.likeness.values()]
    method = case.split("/")[3]
    paper_db = PAPER_PSNR_DB.get(level) if level is not None else None
    paper_ratio = PAPER_RATIO.get(level) if level is not None else PAPER_RIVALS.get(method)
    figures: dict[str, tuple[float, str, float | None, str]] = {
        "bytes_per_frame": (size, "B", None, ""),
        "ratio_to_raw_images": (sequence.raw_bytes / size, "1", paper_ratio, "L Table 2, mean"),
        "ratio_to_points": (POINT_BYTES * points / size, "1", None, f"{points:.0f} points of {POINT_BYTES} bytes"),
        "sequence_seconds": (sequence.length / FRAME_RATE_HZ, "s", None, ""),
        "psnr_db": (float(np.mean(all_db)), "dB", paper_db, "L Table 1, mean"),
        "psnr_p5_db": (float(np.percentile(all_db, 5)), "dB", None, ""),
        "psnr_min_db": (min(seen.worst_view_db for seen in measured.likeness.values()), "dB", None, "of all views"),
        "encode_ms": (1e3 * float(np.median(measured.encode_s)), "ms", None, "median"),
        "decode_ms": (1e3 * float(np.median(measured.decode_s)), "ms", None, "median"),
    }
    if measured.delay_s:
        about = f"{VIDEO_FRAMES - 1} frames to fill a group, to encode and decode it"
        figures["added_delay_ms"] = (1e3 * float(np.median(measured.delay_s)), "ms", None, about)
        late_db = [seen.psnr_db for seen in measured.late.values()]
        figures["psnr_late_db"] = (float(np.mean(late_db)), "dB", None, f"maps {VIDEO_FRAMES} frames after skeletons")
    told = "  ".join(f"{name} {value:.4g}" for name, (value, *_) in figures.items())
    print(f"\r{case}: {told}", file=sys.stderr, flush=True)
    return [
        Row(case=case, metric=name, value=value, unit=unit, reference=paper, source=source)
        for name, (value, unit, paper, source) in figures.items()
    ]
