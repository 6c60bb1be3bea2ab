"""The pictures of docs/compression.md, from the residuals bench's rows and from one motion coded again.

``python -m scripts.residual_figures OUT_DIR --data DIR ROWS.json…``: compression_rate.svg (quality over bytes, from the
rows), compression_frames.svg (PSNR of each frame, as Lien's Fig. 9) and compression_strip.jpg (what it looks like).
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from common.geometry.point_cloud import PointCloud
from receiver.residual_decoder import ResidualDecoder, cloud
from scripts.bench_residuals import CAPTURED_S
from scripts.fidelity import finer, smooth
from scripts.fidelity_capture import FRAME_RATE_HZ, Capture, capture, show_progress
from scripts.fidelity_live import DisposeLive
from scripts.fidelity_strip import QUALITY, labelled_row
from scripts.line_chart import line_chart
from scripts.residual_quality import SAMPLES, fixed_cameras, pictures
from scripts.residual_rivals import filmed
from scripts.residual_sequences import PosedSequence, captured_sequence
from scripts.run_bench import Row
from sender.capture.rig_layout import cameras_around
from sender.residual_encoder import ResidualEncoder

RATE_UP_TO_BYTES = 45_000
STRIP_S = (2.0, 4.0, 6.0, 8.0, 10.0)
STRIP_LEVELS = (0.0, 25.0, 100.0)
FRAMES_EVERY = 5
LIVE_BPS = 1e6


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts.residual_figures", description="Pictures of the compression page.")
    parser.add_argument("out", type=Path)
    parser.add_argument("rows", type=Path, nargs="*", help="JSON files of the residuals bench")
    parser.add_argument("--data", type=Path, required=True, help="folder with bodies and motion capture")
    parser.add_argument("--body", default="male_avg")
    parser.add_argument("--motion", default="14_06")
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=max(STRIP_S) + 0.5)
    parser.add_argument("--captures", type=Path, help="folder where captured motions are kept for the next time")
    options = parser.parse_args()
    kept = options.captures or Path(tempfile.gettempdir()) / f"telepose-captures-{os.getuid()}"
    case = f"{options.body}/{options.motion}/{options.cameras}"
    rows = [row for file in options.rows for row in json.loads(file.read_text())["rows"]]
    if rows:
        (options.out / "compression_rate.svg").write_text(rate_chart(case, rows))
    recorded = capture(options.body, options.motion, options.data, options.cameras, CAPTURED_S,
                       show_progress(f"capturing {case}"), kept)  # fmt: skip
    count = round(options.seconds * FRAME_RATE_HZ)
    sequence = captured_sequence(case, recorded, cameras_around(options.cameras), count)
    shown = {level: residual_clouds(sequence, level) for level in STRIP_LEVELS}
    (options.out / "compression_frames.svg").write_text(
        frames_chart(case, sequence, {level: clouds for level, (clouds, _) in shown.items()})
    )
    strip = strip_of(sequence, shown, recorded)
    cv2.imwrite(str(options.out / "compression_strip.jpg"), strip[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def rate_chart(case: str, rows: Sequence[Row]) -> str:
    """Quality over size of every method in the rows of a ``case``."""
    sizes, db = (
        {r["case"]: float(r["value"] or 0) for r in rows if r["metric"] == metric and r["case"].startswith(f"{case}/")}
        for metric in ("bytes_per_frame", "psnr_db")
    )
    lines: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for name, size in sizes.items():
        if size <= RATE_UP_TO_BYTES:
            lines[name.split("/")[3]].append((size / 1000, db[name]))
    drawn = {method: ([x for x, _ in sorted(at)], [y for _, y in sorted(at)]) for method, at in lines.items()}
    return line_chart(
        f"{case}: likeness over size",
        "kB a frame",
        "dB",
        drawn,
        dots=True,
        low=_whole_tens(y for _, ys in drawn.values() for y in ys),
    )


def residual_clouds(sequence: PosedSequence, level: float) -> tuple[list[PointCloud], float]:
    """The points shown of every frame, and the bytes of a frame."""
    ours, theirs = ResidualEncoder(0, 1), ResidualDecoder()
    shown, size = [], 0
    for k in range(sequence.length):
        frame = sequence.residual_frame(k)
        packet = ours.encode(frame, level)
        if packet is not None:
            theirs.decode(packet, {frame.body_revision: frame.skeleton})
            size += len(packet)
        assert theirs.newest is not None
        shown.append(cloud(theirs.newest, frame.T_world_link))
    return shown, size / sequence.length


def frames_chart(case: str, sequence: PosedSequence, shown: dict[float, list[PointCloud]]) -> str:
    """PSNR of one frame in five at each level."""
    ks = range(0, sequence.length, FRAMES_EVERY)
    lines = {
        f"{level:g} %": ([k / FRAME_RATE_HZ for k in ks], [sequence.likeness(k, clouds[k]).psnr_db for k in ks])
        for level, clouds in sorted(shown.items(), reverse=True)
    }
    return line_chart(
        f"{case}: likeness of each frame", "s", "dB", lines, low=_whole_tens(y for _, ys in lines.values() for y in ys)
    )


def _whole_tens(values: Iterable[float]) -> float:
    """What a chart of them begins at."""
    return float(10 * np.floor(min(values) / 10))


def strip_of(
    sequence: PosedSequence, shown: dict[float, tuple[list[PointCloud], float]], recorded: Capture
) -> np.ndarray:
    """Input, levels, H.265 at the rate of 25 %, and meshes with a live surface, at some instants."""
    ks = [round(s * FRAME_RATE_HZ) for s in STRIP_S if round(s * FRAME_RATE_HZ) < sequence.length]
    rows = [labelled_row("input", [_seen(sequence, k, sequence.cloud(k)) for k in ks], [""] * len(ks))]
    for level, (clouds, size) in sorted(shown.items()):
        rows.append(_row(sequence, f"{level:g} %, {size / 1000:.1f} kB", ks, [clouds[k] for k in ks]))
    rate_bps = shown[25.0][1] * 8 * FRAME_RATE_HZ
    h265 = filmed("h265", rate_bps, sequence)
    coded = [h265(sequence, k) for k in ks]
    label = f"H.265, {coded[0].size_bytes / 1000:.1f} kB"
    rows.append(_row(sequence, label, ks, [frame.decoded() for frame in coded]))
    rows.append(labelled_row(f"live, {LIVE_BPS / 1e6:g} Mbit/s", _live(sequence, recorded, ks), [""] * len(ks)))
    return np.vstack(rows)


def _live(sequence: PosedSequence, recorded: Capture, ks: list[int]) -> list[np.ndarray]:
    """What a receiver with a live surface shows of these frames, from the front."""
    method, found = DisposeLive(LIVE_BPS, own=True), []
    for k in range(max(ks) + 1):
        method.frame(k, recorded.frame(k))
        if k in ks:
            assert method.screen is not None
            camera = finer(fixed_cameras(sequence.cloud(k), sequence.height_m)[0], SAMPLES)
            found.append(smooth(method.screen.picture([camera])[0][0], SAMPLES))
    return found


def _row(sequence: PosedSequence, label: str, ks: list[int], clouds: list[PointCloud]) -> np.ndarray:
    told = [f"{sequence.likeness(k, c).psnr_db:.1f} dB" for k, c in zip(ks, clouds, strict=True)]
    return labelled_row(label, [_seen(sequence, k, c) for k, c in zip(ks, clouds, strict=True)], told)


def _seen(sequence: PosedSequence, k: int, shown: PointCloud) -> np.ndarray:
    """A cloud from the front."""
    camera = fixed_cameras(sequence.cloud(k), sequence.height_m)[0]
    return pictures(shown, [camera])[0][0]


if __name__ == "__main__":
    main()
