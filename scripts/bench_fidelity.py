"""How good the distant person looks at each bandwidth, by DISPOSE and by what it claims to beat."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scripts.fidelity import Fidelity, compare, measuring_cameras
from scripts.fidelity_capture import FRAME_RATE_HZ, Capture, capture, show_progress
from scripts.fidelity_methods import METHODS, Method
from scripts.run_bench import Row

SESSION_S = 180.0
CAPTURED_S = 14.0  # of a motion, repeated: what is held in memory
WARM_UP_S = 10.0
MEASURED_EVERY = 15  # frames
BANDWIDTHS_BPS = (0.1e6, 0.2e6, 1e6, 10e6)
SEEN_AFTER = 3  # frames: 100 ms
CASES = (("male_avg", "14_06"), ("male_avg", "02_10"))


def add_options(parser: argparse.ArgumentParser) -> None:
    """This bench's own options."""
    parser.add_argument("--methods", default=",".join(METHODS), help=f"of {', '.join(METHODS)}, separated by commas")
    parser.add_argument(
        "--bandwidths", default=",".join(f"{bps / 1e6:g}" for bps in BANDWIDTHS_BPS), help="Mbit/s, separated by commas"
    )
    parser.add_argument("--skeletons", default="true,own", help="true, own (our tracker's), or both")
    parser.add_argument("--captures", type=Path, help="folder where captured motions are kept for the next time")


def run(
    data: Path | None, seconds: float | None, clips: tuple[str, ...], methods: str, bandwidths: str, skeletons: str,
    captures: Path | None = None,
) -> Iterator[Row]:  # fmt: skip
    """Rows for every body, motion, bandwidth, method and skeleton. ``seconds``: length of a session."""
    chosen = _chosen(methods, tuple(METHODS))
    owns = [word == "own" for word in _chosen(skeletons, ("true", "own"))]
    rates_bps = [float(word) * 1e6 for word in bandwidths.split(",")]
    for body, motion in _cases(data, clips):
        case = f"{body}/{motion or 'routine'}/4"
        recorded = capture(body, motion, data, 4, CAPTURED_S, show_progress(f"capturing {case}"), captures)
        for bandwidth_bps in rates_bps:
            for name in chosen:
                for own in owns:
                    label = f"{case}/{bandwidth_bps / 1e6:g}M/{name}-{'own' if own else 'true'}"
                    begun = time.monotonic()
                    figures = measured(METHODS[name](bandwidth_bps, own), recorded, seconds or SESSION_S)
                    yield from (Row(case=label, metric=metric, value=value, unit=unit, reference=None, source="")
                                for metric, (value, unit) in figures.items())  # fmt: skip
                    told = "  ".join(f"{m} {v:.2f}" for m, (v, _) in figures.items())
                    print(f"\r{label}: {told}  ({time.monotonic() - begun:.0f} s)", file=sys.stderr, flush=True)


def _chosen(words: str, known: tuple[str, ...]) -> list[str]:
    """The words of an option, in the order given; unknown ones end the bench."""
    chosen = [word for word in words.split(",") if word]
    for word in chosen:
        if word not in known:
            raise SystemExit(f"{word}: unknown, there are {', '.join(known)}")
    return chosen


def measured(method: Method, recorded: Capture, seconds: float) -> dict[str, tuple[float, str]]:
    """Plays a session to a method and compares what is on screen with the truth at the time of what is shown."""
    count = int(seconds * FRAME_RATE_HZ)
    results: list[Fidelity] = []
    cold: list[Fidelity] = []
    nobody = 0
    first_body_s = float("nan")
    for k in range(count):
        method.frame(k, recorded.frame(k))
        if method.shown_k is not None and np.isnan(first_body_s):
            first_body_s = k / FRAME_RATE_HZ
        if k % MEASURED_EVERY:
            continue
        if method.shown_k is None:
            nobody += 1
            continue
        surface = recorded.performer.surface(recorded.frame(method.shown_k).time_s)
        picture = method.picture(measuring_cameras(surface))
        if picture is None:
            nobody += 1
            continue
        fidelity = compare(recorded.truth(method.shown_k), picture)
        (cold if k < WARM_UP_S * FRAME_RATE_HZ else results).append(fidelity)
    warm = results or cold
    psnr = np.array([fidelity.psnr_db for fidelity in warm])
    return {
        "psnr_db": (float(psnr.mean()), "dB"),
        "psnr_p5_db": (float(np.percentile(psnr, 5)), "dB"),
        "psnr_inside_db": (float(np.mean([fidelity.psnr_inside_db for fidelity in warm])), "dB"),
        "iou": (float(np.mean([fidelity.iou for fidelity in warm])), "1"),
        "psnr_cold_db": (float(np.mean([fidelity.psnr_db for fidelity in cold])) if cold else float("nan"), "dB"),
        "kbit_per_s": (method.link.sent_bytes * 8e-3 / seconds + 0.25 * 8 * FRAME_RATE_HZ, "kbit/s"),
        "first_body_s": (first_body_s, "s"),
        "switches_per_s": (method.switches / seconds, "1/s"),
        "nobody_share": (nobody / max(count // MEASURED_EVERY, 1), "1"),
    }


def _cases(data: Path | None, clips: tuple[str, ...]) -> list[tuple[str, str | None]]:
    known: list[tuple[str, str | None]] = [("builtin", None)]
    if data is not None:
        known += CASES
    return [(body, motion) for body, motion in known if not clips or (motion or "routine") in clips]
