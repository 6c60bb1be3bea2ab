"""What the cameras of a virtual rig saw of a performance, frame by frame, with both skeletons: the true and our own.

Captured once and played to every method and bandwidth alike. Long sessions repeat the motion; its first two seconds
(start pose and blend) are played once.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common.geometry.rasterizer import render
from scripts.capture_files import CapturedFrame, load_frames, save_frames
from scripts.fidelity import Picture, centres, finer, measuring_cameras, smooth
from scripts.true_skeleton import TrueSkeleton
from sender.capture.frame_set import DepthFrame
from sender.capture.fundamental_poses import FUNDAMENTAL_S, PREFIX
from sender.capture.performer import Performer, open_performer
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import RigRenderer
from sender.fitting.open_tracker import open_tracker
from sender.reconstruction.background import BackgroundModel
from sender.reconstruction.foreground_points import PointSampler
from sender.reconstruction.outline import completed

FRAME_RATE_HZ = 30
FRAME_NS = round(1e9 / FRAME_RATE_HZ)
START_S = 2.0  # start pose and blend
POINTS = 2500
TRUTHS_KEPT = 64  # of 14 MB


class Capture:
    """A performance in memory; ``frame(k)`` is the k-th frame of a session of any length, of which ``once_s`` are
    played once and the rest repeats."""

    def __init__(self, performer: Performer, frames: list[CapturedFrame], once_s: float = START_S) -> None:
        self.performer = performer
        self._frames = frames
        self._once = round(once_s * FRAME_RATE_HZ)
        self._truth: dict[int, tuple[list[Picture], list[NDArray[np.uint8]]]] = {}

    @property
    def length(self) -> int:
        """How many frames there are before the motion repeats."""
        return len(self._frames)

    def index(self, k: int) -> int:
        """Which captured frame is the k-th of a session."""
        once, all_frames = self._once, len(self._frames)
        return k if k < all_frames else once + (k - all_frames) % (all_frames - once)

    def frame(self, k: int) -> CapturedFrame:
        """The k-th frame of a session."""
        return self._frames[self.index(k)]

    def truth(self, k: int) -> list[Picture]:
        """The true person at frame k in the six measuring views; kept."""
        return self._truths(k)[0]

    def smooth_truth(self, k: int) -> list[NDArray[np.uint8]]:
        """The same as means of several samples a pixel."""
        return self._truths(k)[1]

    def _truths(self, k: int) -> tuple[list[Picture], list[NDArray[np.uint8]]]:
        index = self.index(k)
        if index not in self._truth:
            if len(self._truth) >= TRUTHS_KEPT:
                self._truth.clear()
            surface = self.performer.surface(self._frames[index].time_s)
            look = self.performer.mesh
            colours = look.vertex_colours if look.uv is None or look.texture is None else (look.uv, look.texture)
            cameras = [finer(camera) for camera in measuring_cameras(surface)]
            fine = [render(surface, look.faces, colours, camera) for camera in cameras]
            self._truth[index] = [centres(picture) for picture in fine], [smooth(colour) for colour, _ in fine]
        return self._truth[index]


def capture(
    body: str,
    motion: str | None,
    data: Path | None,
    cameras: int,
    seconds: float,
    progress: Callable[[float], None] | None = None,
    kept: Path | None = None,
) -> Capture:
    """Render, cut out and track ``seconds`` of a performance (at most until it repeats), or load what was ``kept`` in a
    folder of that name when it was captured last. Fundamental poses come before those seconds.

    Raises:
        CaptureError: no such body or motion.
    """
    performer = open_performer(body, motion, data)
    renderer = RigRenderer(performer, RigSettings(cameras=cameras))
    folder = None if kept is None else kept / f"{body}-{motion or 'routine'}-{cameras}-{seconds:g}s"
    once_s = START_S + (FUNDAMENTAL_S if (motion or "").startswith(PREFIX) else 0)
    frames = None if folder is None else load_frames(folder, renderer.cameras)
    if frames is None:
        count = int(min(seconds + once_s - START_S, performer.duration_s + START_S) * FRAME_RATE_HZ)
        frames = _captured(performer, renderer, count, progress or (lambda _: None))
        if folder is not None:
            save_frames(folder, frames, renderer.cameras)
    return Capture(performer, frames, once_s)


def _captured(
    performer: Performer, renderer: RigRenderer, count: int, progress: Callable[[float], None]
) -> list[CapturedFrame]:
    truth = TrueSkeleton(performer)
    rooms = [
        BackgroundModel(camera, renderer.empty_room(index), room_colour=renderer.empty_room_colour(index))
        for index, camera in enumerate(renderer.cameras)
    ]
    sampler = PointSampler(renderer.cameras, POINTS)
    tracker = open_tracker("gauss-newton")
    frames = []
    for k in range(count):
        time_s = k / FRAME_RATE_HZ
        views = []
        for index, camera in enumerate(renderer.cameras):
            depth = np.empty((camera.height, camera.width), np.uint16)
            colour = np.empty((camera.height, camera.width, 3), np.uint8)
            renderer.view(index, time_s, depth, colour)
            view = rooms[index].foreground(DepthFrame(index, k, k * FRAME_NS, depth, colour))
            if view is not None:
                views.append(view)
        fit = tracker.track(sampler.points(views), k * FRAME_NS)
        own = None if fit is None else (fit.skeleton, fit.pose, fit.confidence)
        frames.append(
            CapturedFrame(time_s, tuple(completed(view) for view in views), (truth.skeleton, truth.pose(time_s)), own)
        )
        if k % FRAME_RATE_HZ == 0:
            progress(k / count)
    return frames


def show_progress(what: str) -> Callable[[float], None]:
    """Progress on stderr, one line that is written over."""
    return lambda share: print(f"\r{what} {share:4.0%}", end="", file=sys.stderr, flush=True)
