"""Visual hulls of the virtual rig's silhouettes: time, how near the body they are, and tracking without depth.

Cases: ``hull/N/WxH``, N colour cameras around the built-in performer, 4,000 points in the volume and 2,500 on the
surface; ``hull/cost/WxH``, a straight line through the times over N (Rao & Hodges §7: O(n)); ``tracked/TRACKER/N``, the
sender's whole path on N cameras of 640×480 without depth, nothing given. Pictures have noise of 3 grey levels (real
cameras here: 1.5), silhouettes come from the sender's own background subtraction. Times are the thread's CPU time, of
the hull alone unless they say silhouette.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from common.body.skeleton_pose import joint_positions
from common.geometry.point_cloud import PointCloud
from common.runtime.clock import MonotonicClock
from common.runtime.stage_timer import StageTimer
from scripts.run_bench import Row
from scripts.tracking_conditions import FRAME_RATE_HZ, Sight
from scripts.tracking_conditions import surface_points as points_on_mesh
from scripts.tracking_run import Run
from sender.capture.body_performer import BodyPerformer
from sender.capture.frame_set import ColourFrame, FrameSet
from sender.capture.performer import open_performer
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import RigRenderer
from sender.fitting.open_tracker import open_tracker
from sender.reconstruction.hull_points import surface_points, volume_points
from sender.reconstruction.person_points import HullReconstruction
from sender.reconstruction.silhouette import SilhouetteModel, SilhouetteSettings
from sender.reconstruction.visual_hull import VisualHull

Array = NDArray[Any]

CAMERAS = range(2, 9)
SIZES = ((320, 240), (640, 480))
TRACKED = (("gauss-newton", 4), ("gauss-newton", 8), ("particles", 4), ("particles", 8))
TRACKED_S = 10.0
VOLUME_POINTS, SURFACE_POINTS = 4000, 2500
INSTANTS, REPEATS = 12, 5
BODY_POINTS = 30_000
NOISE_LEVELS = 3.0
ROOM_FRAMES = 20
NEAR_M = (0.02, 0.05)


class ColourRig:
    """Colour cameras around a performer, with noise, and what they see of the empty room."""

    def __init__(self, performer: BodyPerformer, cameras: int, size: tuple[int, int]) -> None:
        self._random = np.random.default_rng(0)
        width, height = size
        self._renderer = RigRenderer(performer, RigSettings(cameras=cameras, width=width, height=height, noise=False))
        self._noise = self._random.normal(0, NOISE_LEVELS, (height, width, 3)).round().astype(np.int16)
        self._depth = np.empty((height, width), np.uint16)
        self.cameras = self._renderer.cameras
        self.empty_room = [
            np.stack([self._noisy(self._renderer.empty_room_colour(index)) for _ in range(ROOM_FRAMES)])
            for index in range(cameras)
        ]

    def frames(self, number: int, time_s: float) -> FrameSet:
        """What all cameras see at ``time_s`` of the performance."""
        capture_ns = round(time_s * 1e9)
        frames = []
        for index in range(len(self.cameras)):
            colour = np.empty((*self._depth.shape, 3), np.uint8)
            self._renderer.view(index, time_s, self._depth, colour)
            frames.append(ColourFrame(index, number, capture_ns, self._noisy(colour)))
        return FrameSet(capture_ns, tuple(frames))

    def _noisy(self, colour: NDArray[np.uint8]) -> NDArray[np.uint8]:
        shift = tuple(self._random.integers(0, size) for size in self._noise.shape[:2])
        return np.asarray(np.clip(colour + np.roll(self._noise, shift, (0, 1)), 0, 255), np.uint8)


def run(data: Path | None, seconds: float | None, clips: tuple[str, ...]) -> Iterator[Row]:
    """Rows of every case. ``seconds``: of motion in each tracked case (default 10). ``clips``: motions of ``data`` for
    the tracked cases, on the spot; without any, the built-in routine."""
    performer = open_performer("builtin")
    for size in SIZES:
        yield from _sized(performer, size)
    for clip in clips or (None,):
        moving = open_performer("builtin", clip, data, on_the_spot=True)
        for tracker, cameras in TRACKED:
            case = f"tracked/{tracker}/{cameras}" + (f"/{clip}" if clip else "")
            metrics = _tracked(moving, tracker, cameras, seconds or TRACKED_S).metrics()
            _tell(case, metrics)
            yield from (_row(case, name, value, _unit(name)) for name, value in metrics.items())


def _sized(performer: BodyPerformer, size: tuple[int, int]) -> Iterator[Row]:
    """One image size, every number of cameras, and the line through their times."""
    label = f"{size[0]}x{size[1]}"
    times_ms = []
    for cameras in CAMERAS:
        metrics = _hulls(performer, ColourRig(performer, cameras, size))
        times_ms.append(metrics["volume_ms_p50"])
        _tell(f"hull/{cameras}/{label}", metrics)
        for name, value in metrics.items():
            yield _row(f"hull/{cameras}/{label}", name, value, _unit(name))
    slope, offset = np.polyfit(CAMERAS, times_ms, 1)
    rest = np.array(times_ms) - (slope * np.array(CAMERAS) + offset)
    yield _row(f"hull/cost/{label}", "ms_per_camera", float(slope), "ms")
    yield _row(f"hull/cost/{label}", "r2_of_line", float(1 - rest.var() / np.var(times_ms)), "1")


def _hulls(performer: BodyPerformer, rig: ColourRig) -> dict[str, float]:
    """Figures over some instants of the routine."""
    longest = SilhouetteSettings(longest_px=max(rig.cameras[0].width, rig.cameras[0].height))
    pairs = zip(rig.cameras, rig.empty_room, strict=True)
    models = [SilhouetteModel(camera, room, longest) for camera, room in pairs]
    times: dict[str, list[float]] = {"silhouette": [], "volume": [], "surface": []}
    inside: list[Array] = []
    outside: list[Array] = []
    for number, time_s in enumerate(np.linspace(0.5, performer.motion_s, INSTANTS)):
        frames = rig.frames(number, float(time_s)).frames
        seen = [(model, frame) for model, frame in zip(models, frames, strict=True) if isinstance(frame, ColourFrame)]
        silhouettes = [_timed(times["silhouette"], model.silhouette, frame) for model, frame in seen]
        for repeat in range(REPEATS + (number == 0)):
            first = number == 0 and repeat == 0  # compiles
            volume = _timed([] if first else times["volume"], _hull_points, volume_points, silhouettes, VOLUME_POINTS)
            surface = _timed(
                [] if first else times["surface"], _hull_points, surface_points, silhouettes, SURFACE_POINTS
            )
        body = _body(performer, float(time_s))
        inside.append(_outside_m(volume, body))
        outside.append(_outside_m(surface, body))
    volume_m, surface_m = np.concatenate(inside), np.concatenate(outside)
    figures = {f"{name}_ms_p{p}": float(np.percentile(of, p)) for name, of in times.items() for p in (50, 99)}
    for near_m in NEAR_M:
        figures[f"volume_within_{near_m * 100:.0f}cm"] = float((volume_m < near_m).mean())
        figures[f"surface_within_{near_m * 100:.0f}cm"] = float((np.abs(surface_m) < near_m).mean())
    return figures


def _hull_points(points: Callable[[VisualHull, int], PointCloud], silhouettes: list[Any], count: int) -> PointCloud:
    return points(VisualHull(silhouettes), count)


def _timed(times_ms: list[float], function: Callable[..., Any], *arguments: Any) -> Any:
    begun = time.thread_time()
    result = function(*arguments)
    times_ms.append((time.thread_time() - begun) * 1e3)
    return result


def _body(performer: BodyPerformer, time_s: float) -> PointCloud:
    """The true surface."""
    mesh = performer.mesh
    random = np.random.default_rng(0)
    return points_on_mesh(performer.surface(time_s), mesh.faces, mesh.vertex_colours, BODY_POINTS, random)


def _outside_m(cloud: PointCloud, body: PointCloud) -> Array:
    """How far each point lies outside the body (N,) [m]; negative inside it."""
    away, nearest = cKDTree(body.positions).query(cloud.positions)
    outwards = ((cloud.positions - body.positions[nearest]) * body.normals[nearest]).sum(axis=1)
    return np.asarray(np.where(outwards < 0, -away, away))


def _tracked(performer: BodyPerformer, name: str, cameras: int, seconds: float) -> Run:
    """The sender's path on colour frames: silhouettes, hull, person, tracker."""
    rig = ColourRig(performer, cameras, (640, 480))
    reconstruction = HullReconstruction(rig.cameras, rig.empty_room, inside=name == "particles")
    tracker, timer, result = open_tracker(name), StageTimer(MonotonicClock()), Run()
    joints: Array | None = None
    for number in range(int(min(seconds, performer.motion_s) * FRAME_RATE_HZ)):
        time_s = number / FRAME_RATE_HZ
        frames = rig.frames(number, time_s)
        begun = time.thread_time()
        person = reconstruction.person(frames, joints, timer)
        fit = tracker.track(person.cloud, frames.capture_ns)
        cpu_s = time.thread_time() - begun
        joints = joint_positions(fit.skeleton, fit.pose) if fit is not None and fit.confidence > 0 else None
        sight = Sight(time_s, person.cloud, performer.surface(time_s), performer.named_joints(time_s))
        result.add(fit, cpu_s, sight)
    return result


def _unit(metric: str) -> str:
    if "ms_" in metric:
        return "ms (CPU of the thread)"
    return "s" if metric.endswith("_s") else "R" if metric.startswith("e_t") else "1"


def _row(case: str, metric: str, value: float, unit: str) -> Row:
    return {"case": case, "metric": metric, "value": value, "unit": unit, "reference": None, "source": ""}


def _tell(case: str, metrics: dict[str, float]) -> None:
    print(
        f"{case}: " + "  ".join(f"{name} {value:.3f}" for name, value in metrics.items()), file=sys.stderr, flush=True
    )
