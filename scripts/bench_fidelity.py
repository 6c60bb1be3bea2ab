"""How good the distant person looks at each bandwidth, by DISPOSE and by what it claims to beat.

The dataset of DISPOSE §7, twelve fundamental poses once and then free motion, from one frontal camera and from four:
``--bodies builtin,male_avg,female_slim --clips dispose12+routine,dispose12+14_06 --cameras 1,4``.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from scripts.fidelity import Fidelity, centres, compare, finer, measuring_cameras, smooth, smooth_psnr_db
from scripts.fidelity_capture import FRAME_RATE_HZ, Capture, capture, show_progress
from scripts.fidelity_link import SKELETON_BYTES
from scripts.fidelity_methods import Method, Screen
from scripts.fidelity_rivals import ALL_METHODS, WITHOUT_BANDWIDTH, WITHOUT_SKELETON, open_method
from scripts.run_bench import Row

SESSION_S = 180.0
CAPTURED_S = 14.0  # of a motion, repeated: what is held in memory
WARM_UP_S = 10.0
MEASURED_EVERY = 29  # frames: prime, so that a repeated motion is not looked at in the same few places
LONG_S, LONG_EVERY = 120.0, 61  # such sessions are looked at less often
BANDWIDTHS_BPS = (0.1e6, 0.2e6, 1e6, 10e6)
SEEN_AFTER = 3  # frames: 100 ms
CASES = (("male_avg", "14_06"), ("male_avg", "02_10"))


@dataclass(frozen=True, slots=True)
class Case:
    """Who does what before how many cameras."""

    body: str
    motion: str | None
    cameras: int

    def __str__(self) -> str:
        return f"{self.body}/{self.motion or 'routine'}/{self.cameras}"


@dataclass(frozen=True, slots=True)
class Likeness:
    """One instant by single samples, and by the pixels' means."""

    fidelity: Fidelity
    smooth_db: float


@dataclass(frozen=True, slots=True)
class Session:
    """What is the same for all methods: bandwidths, length, data and where captures are kept."""

    rates_bps: tuple[float, ...]
    seconds: float
    data: Path | None
    captures: Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """This bench's own options."""
    parser.add_argument(
        "--methods", default=",".join(ALL_METHODS), help=f"of {', '.join(ALL_METHODS)}, separated by commas"
    )
    parser.add_argument(
        "--bandwidths", default=",".join(f"{bps / 1e6:g}" for bps in BANDWIDTHS_BPS), help="Mbit/s, separated by commas"
    )
    parser.add_argument("--skeletons", default="true,own", help="true, own (our tracker's), or both")
    parser.add_argument("--captures", type=Path, help="folder where captured motions are kept for the next time")
    parser.add_argument("--cameras", default="4", help="how many, separated by commas: 1 is a frontal one")
    parser.add_argument("--bodies", default="", help="only these bodies, in every clip of --clips")
    parser.add_argument("--jobs", type=int, default=1, help="processes")


def run(
    data: Path | None, seconds: float | None, clips: tuple[str, ...], methods: str, bandwidths: str, skeletons: str,
    captures: Path | None = None, cameras: str = "4", bodies: str = "", jobs: int = 1,
) -> Iterator[Row]:  # fmt: skip
    """Rows for every body, motion, bandwidth, method and skeleton. ``seconds``: length of a session."""
    chosen = _chosen(methods, ALL_METHODS)
    owns = [word == "own" for word in _chosen(skeletons, ("true", "own"))]
    rates_bps = tuple(float(word) * 1e6 for word in bandwidths.split(","))
    kept = captures or Path(tempfile.gettempdir()) / f"telepose-captures-{os.getuid()}"
    session = Session(rates_bps, seconds or SESSION_S, data, kept)
    cases = [Case(*who, int(count)) for who in _cases(data, clips, bodies) for count in cameras.split(",")]
    tasks = [(case, name, own) for case in cases for name in chosen
             for own in (owns[:1] if name in WITHOUT_SKELETON else owns)]  # fmt: skip
    if jobs == 1:
        for task in tasks:
            yield from _rows(session, *task)
        return
    with ProcessPoolExecutor(jobs) as workers:
        list(workers.map(partial(_captured, session.data, kept), cases))
        for rows in workers.map(partial(_rows, session), *zip(*tasks, strict=True)):
            yield from rows


def _chosen(words: str, known: Sequence[str]) -> list[str]:
    """The words of an option, in the order given; unknown ones end the bench."""
    chosen = [word for word in words.split(",") if word]
    for word in chosen:
        if word not in known:
            raise SystemExit(f"{word}: unknown, there are {', '.join(known)}")
    return chosen


def _captured(data: Path | None, kept: Path, case: Case) -> None:
    _capture_of(data, kept, case)


@lru_cache(maxsize=1)
def _capture_of(data: Path | None, kept: Path, case: Case) -> Capture:
    return capture(case.body, case.motion, data, case.cameras, CAPTURED_S, show_progress(f"capturing {case}"), kept)


def _rows(session: Session, case: Case, name: str, own: bool) -> list[Row]:
    """One method's rows at every bandwidth."""
    recorded = _capture_of(session.data, session.captures, case)
    rows = []
    for rate_bps in session.rates_bps[-1:] if name in WITHOUT_BANDWIDTH else session.rates_bps:
        skeleton = "" if name in WITHOUT_SKELETON else "-own" if own else "-true"
        rate = "any" if name in WITHOUT_BANDWIDTH else f"{rate_bps / 1e6:g}M"
        label = f"{case}/{rate}/{name}{skeleton}"
        begun = time.monotonic()
        figures = measured(open_method(name, recorded, rate_bps, own), recorded, session.seconds)
        rows += [Row(case=label, metric=metric, value=value, unit=unit, reference=None, source="")
                 for metric, (value, unit) in figures.items()]  # fmt: skip
        told = "  ".join(f"{m} {v:.2f}" for m, (v, _) in figures.items())
        print(f"\r{label}: {told}  ({time.monotonic() - begun:.0f} s)", file=sys.stderr, flush=True)
    return rows


def measured(method: Method, recorded: Capture, seconds: float) -> dict[str, tuple[float, str]]:
    """Plays a session to a method and compares what is on screen with the truth: that of the frame shown, and
    (``psnr_seen_db``) that of the instant, for which the screen may wait 100 ms: a player shows, of what it has then,
    the newest that is not of a later instant. Where nobody is on screen yet there is nothing to compare."""
    count, every = int(seconds * FRAME_RATE_HZ), LONG_EVERY if seconds >= LONG_S else MEASURED_EVERY
    shown: dict[int, Likeness] = {}
    seen: dict[int, Likeness] = {}
    first_k, measured_count = None, 0
    screens: deque[Screen | None] = deque(maxlen=SEEN_AFTER + 1)
    for k in range(count):
        method.frame(k, recorded.frame(k))
        screens.append(method.screen)
        if method.screen is not None and first_k is None:
            first_k = k
        if k % every == 0:
            measured_count += 1
            if method.screen is not None:
                shown[k] = _fidelity(method.screen, recorded, method.screen.shown_k)
        instant = k - SEEN_AFTER
        if instant % every == 0:
            at = next((s for s in reversed(screens) if s is not None and s.shown_k <= instant), None)
            if at is not None and at is screens[0] and at.shown_k == instant:
                seen[instant] = shown[instant]
            elif at is not None:
                seen[instant] = _fidelity(at, recorded, instant)
    return {
        **_summary(shown, seen),
        "first_body_s": (float("nan") if first_k is None else first_k / FRAME_RATE_HZ, "s"),
        "kbit_per_s": (_bits_per_s(method, seconds) / 1e3, "kbit/s"),
        "switches_per_s": (method.switches / seconds, "1/s"),
        "nobody_share": (1 - len(shown) / max(measured_count, 1), "1"),
    }


def _fidelity(screen: Screen, recorded: Capture, k: int) -> Likeness:
    """What is on screen against the truth of frame k."""
    cameras = measuring_cameras(recorded.performer.surface(recorded.frame(k).time_s))
    fine = screen.picture([finer(camera) for camera in cameras])
    smooth_db = smooth_psnr_db(recorded.smooth_truth(k), [smooth(colour) for colour, _ in fine])
    return Likeness(compare(recorded.truth(k), [centres(picture) for picture in fine]), smooth_db)


def _summary(shown: dict[int, Likeness], seen: dict[int, Likeness]) -> dict[str, tuple[float, str]]:
    """Means once the session is warm (of a shorter one, all), and of the cold start."""
    warm_k = WARM_UP_S * FRAME_RATE_HZ
    if not any(k >= warm_k for k in shown):
        warm_k = 0
    warm = [likeness.fidelity for k, likeness in shown.items() if k >= warm_k]
    smooth_db = [likeness.smooth_db for k, likeness in shown.items() if k >= warm_k]
    seen_db = [likeness.fidelity.psnr_db for k, likeness in seen.items() if k >= warm_k]
    seen_smooth_db = [likeness.smooth_db for k, likeness in seen.items() if k >= warm_k]
    cold_db = [likeness.fidelity.psnr_db for k, likeness in shown.items() if k < WARM_UP_S * FRAME_RATE_HZ]
    cold_seen_db = [likeness.fidelity.psnr_db for k, likeness in seen.items() if k < WARM_UP_S * FRAME_RATE_HZ]
    psnr_db = [fidelity.psnr_db for fidelity in warm]
    return {
        "psnr_db": (_mean(psnr_db), "dB"),
        "psnr_p5_db": (_p5(psnr_db), "dB"),
        "psnr_seen_db": (_mean(seen_db), "dB"),
        "psnr_smooth_db": (_mean(smooth_db), "dB"),
        "psnr_smooth_p5_db": (_p5(smooth_db), "dB"),
        "psnr_seen_smooth_db": (_mean(seen_smooth_db), "dB"),
        "psnr_inside_db": (_mean([fidelity.psnr_inside_db for fidelity in warm]), "dB"),
        "iou": (_mean([fidelity.iou for fidelity in warm]), "1"),
        "psnr_cold_db": (_mean(cold_db), "dB"),
        "psnr_seen_cold_db": (_mean(cold_seen_db), "dB"),
    }


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


def _p5(values: list[float]) -> float:
    return float(np.percentile(values, 5)) if values else float("nan")


def _bits_per_s(method: Method, seconds: float) -> float:
    skeletons = SKELETON_BYTES * 8 * FRAME_RATE_HZ if method.link.skeletons else 0
    return method.link.sent_bytes * 8 / seconds + skeletons


def _cases(data: Path | None, clips: tuple[str, ...], bodies: str) -> list[tuple[str, str | None]]:
    if bodies:
        return [(body, None if clip == "routine" else clip) for body in bodies.split(",") for clip in clips]
    known: list[tuple[str, str | None]] = [("builtin", None), *(CASES if data is not None else ())]
    return [(body, motion) for body, motion in known if not clips or (motion or "routine") in clips]
