"""A strip of pictures: the truth and what methods show of it, row by row, at some instants of a session.

``python -m scripts.fidelity_strip OUT.jpg [--data DIR --body B --motion M] [--bandwidth MBIT] [--at S,S,...]``
Each row is what is seen 100 ms after the instant, as ``psnr_seen_db`` counts it, with that figure below.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections import deque
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scripts.bench_fidelity import CAPTURED_S, SEEN_AFTER
from scripts.fidelity import compare, measuring_cameras
from scripts.fidelity_capture import FRAME_RATE_HZ, Capture, capture, show_progress
from scripts.fidelity_methods import Screen
from scripts.fidelity_rivals import WITHOUT_SKELETON, open_method

METHODS = ("dispose", "last-mesh", "per-frame-yang", "h265-warp")
TILE = 300, 430  # pixels of a measuring picture kept, around its middle
SCALE = 0.6  # of them, in the strip
LABEL_WIDTH, QUALITY = 130, 82


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts.fidelity_strip", description="Pictures of methods side by side.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, help="folder with bodies and motion capture")
    parser.add_argument("--body", default="builtin")
    parser.add_argument("--motion", help="a clip of the data; else the built-in routine")
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--bandwidth", type=float, default=0.2, help="Mbit/s")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--at", default="11,12,13,14,15,16,17", help="instants of the session [s]")
    parser.add_argument("--view", type=int, default=0, help="which of the six measuring views")
    parser.add_argument("--captures", type=Path, help="folder where captured motions are kept for the next time")
    parser.add_argument("--skeleton", default="own", choices=("own", "true"))
    options = parser.parse_args()
    kept = options.captures or Path(tempfile.gettempdir()) / f"telepose-captures-{os.getuid()}"
    recorded = capture(options.body, options.motion, options.data, options.cameras, CAPTURED_S,
                       show_progress("capturing"), kept)  # fmt: skip
    instants = [round(float(word) * FRAME_RATE_HZ) for word in options.at.split(",")]
    rows = [labelled_row("truth", [recorded.truth(k)[options.view][0] for k in instants], [""] * len(instants))]
    for name in options.methods.split(","):
        own = options.skeleton == "own" and name not in WITHOUT_SKELETON
        pictures, told = _seen(recorded, name, own, options.bandwidth * 1e6, instants, options.view)
        rows.append(labelled_row(name, pictures, told))
    strip = cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(options.out), strip, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def _seen(
    recorded: Capture, name: str, own: bool, rate_bps: float, instants: list[int], view: int
) -> tuple[list[NDArray[np.uint8]], list[str]]:
    """What a method's screen shows of each instant, and its PSNR."""
    method = open_method(name, recorded, rate_bps, own)
    screens: deque[Screen | None] = deque(maxlen=SEEN_AFTER + 1)
    pictures, told = [], []
    for k in range(max(instants) + SEEN_AFTER + 1):
        method.frame(k, recorded.frame(k))
        screens.append(method.screen)
        instant = k - SEEN_AFTER
        if instant not in instants:
            continue
        cameras = measuring_cameras(recorded.performer.surface(recorded.frame(instant).time_s))
        at = next((s for s in reversed(screens) if s is not None and s.shown_k <= instant), None)
        if at is None:
            pictures.append(np.full((cameras[view].height, cameras[view].width, 3), 255, np.uint8))
            told.append("nobody yet")
            continue
        shown = at.picture(cameras)
        pictures.append(shown[view][0])
        told.append(f"{compare(recorded.truth(instant), shown).psnr_db:.1f} dB")
    return pictures, told


def labelled_row(name: str, pictures: list[NDArray[np.uint8]], told: list[str]) -> NDArray[np.uint8]:
    """A label and the pictures' middles, each with what is told of it."""
    height = round(TILE[1] * SCALE)
    label = np.full((height, LABEL_WIDTH, 3), 255, np.uint8)
    _write(label, name, (6, height // 2))
    tiles = [label]
    for picture, words in zip(pictures, told, strict=True):
        top, left = (picture.shape[0] - TILE[1]) // 2, (picture.shape[1] - TILE[0]) // 2
        middle = picture[top : top + TILE[1], left : left + TILE[0]]
        tile = np.asarray(cv2.resize(middle, (round(TILE[0] * SCALE), height), interpolation=cv2.INTER_AREA), np.uint8)
        _write(tile, words, (60, height - 4))
        tiles.append(tile)
    return np.hstack(tiles)


def _write(picture: NDArray[np.uint8], words: str, at: tuple[int, int]) -> None:
    cv2.putText(picture, words, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)


if __name__ == "__main__":
    main()
