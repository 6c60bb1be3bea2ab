"""How well the pose tracker follows: e_t of 16 joints (Lien 2009 §6.2.1) on every body and clip there is.

Conditions: ``points-given``, as in the paper: 2,500 points of the true surface, first pose and sizes from the truth;
``depth4-auto``: four virtual depth cameras with their noise, reconstruction, automatic start, nothing given.
e_t = mean distance of the joints ÷ R, R = radius of the ball about the middle of the true surface's box, per frame.
``aligned``: after one constant offset per joint in its link's estimated frame, fitted over the run.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import NAMED_JOINT_LINKS
from common.body.skeleton_pose import forward_kinematics
from common.geometry.point_cloud import PointCloud
from scripts.fidelity import bounding_ball_radius
from sender.capture.frame_set import DepthFrame
from sender.capture.performer import Performer, open_performer
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import RigRenderer
from sender.fitting.gauss_newton_tracker import GaussNewtonSettings, GaussNewtonTracker
from sender.fitting.start_joints import skeleton_from_joints
from sender.fitting.tracker import FitResult
from sender.reconstruction.background import BackgroundModel, BackgroundSettings
from sender.reconstruction.foreground_points import PointSampler

Array = NDArray[Any]

FRAME_RATE_HZ = 30
POINTS = 2500
CAMERAS = 4
LOST_E_T = 0.1
CONDITIONS = ("points-given", "depth4-auto")
_REFERENCES = {
    "e_t_mean": (0.01, "Lien 2009 Fig. 6 (dance clip, points and first pose given)"),
    "e_t_max": (0.02, "Lien 2009 Fig. 6 (dance clip, points and first pose given)"),
    "ms_per_frame_p50": (1000 / 61.3, "Lien 2009 §6.2.1 (61.3 fps at best, 2,500 of 10,000 points)"),
}


@dataclass
class Run:
    """One tracked run. ``errors`` (F, 16) in R, ``offsets`` (F, 16, 3): true minus estimated in link frames, in R."""

    errors: list[Array] = field(default_factory=list)
    offsets: list[Array] = field(default_factory=list)
    missing: int = 0
    cpu_ms: list[float] = field(default_factory=list)
    time_to_skeleton_s: float | None = None

    def add(self, fit: FitResult | None, cpu_s: float, joints: Array, radius_m: float, time_s: float) -> None:
        self.cpu_ms.append(cpu_s * 1e3)
        if fit is None:
            self.missing += 1
            return
        if self.time_to_skeleton_s is None:
            self.time_to_skeleton_s = time_s
        T = forward_kinematics(fit.skeleton, fit.pose)[NAMED_JOINT_LINKS].astype(np.float64)
        away = joints - T[:, :3, 3]
        self.errors.append(np.linalg.norm(away, axis=1) / radius_m)
        self.offsets.append(np.einsum("jba,jb->ja", T[:, :3, :3], away) / radius_m)

    def metrics(self) -> dict[str, tuple[float | None, str]]:
        """Name → (value, unit); e_t over the frames with a skeleton, the others count as lost."""
        if not self.errors:
            return {"lost_share": (1.0, "1")}
        e_t = np.array(self.errors).mean(axis=1)
        offsets = np.array(self.offsets)
        aligned = np.linalg.norm(offsets - offsets.mean(axis=0), axis=2)
        lost = (self.missing + int((e_t > LOST_E_T).sum())) / (self.missing + len(e_t))
        return {
            "e_t_mean": (float(e_t.mean()), "R"),
            "e_t_mean_aligned": (float(aligned.mean()), "R"),
            "e_t_max": (float(e_t.max()), "R"),
            "lost_share": (lost, "1"),
            "time_to_skeleton_s": (self.time_to_skeleton_s, "s"),
            "ms_per_frame_p50": (float(np.percentile(self.cpu_ms, 50)), "ms (CPU of the thread)"),
            "ms_per_frame_p99": (float(np.percentile(self.cpu_ms, 99)), "ms (CPU of the thread)"),
        }


def run(data: Path | None, seconds: float | None = None, clips: list[str] | None = None) -> list[dict[str, Any]]:
    """Rows for every body and clip of ``data`` and for the built-in performer; progress on stderr.

    ``seconds``: at most this much of each clip (default: all of it, once). ``clips``: only these (``routine`` is the
    built-in one).
    """
    _warm_up()
    rows = []
    for body, motion in _cases(data, clips):
        performer = open_performer(body, motion, data)
        length_s = performer.duration_s + 2.0 if seconds is None else min(seconds, performer.duration_s + 2.0)
        for condition in CONDITIONS:
            case = f"gauss-newton/{body}/{motion or 'routine'}/{condition}"
            started = time.monotonic()
            result = (_points_given if condition == "points-given" else _depth_auto)(performer, length_s)
            metrics = result.metrics()
            rows += [_row(case, metric, *value) for metric, value in metrics.items()]
            summary = "  ".join(f"{m} {v:.4f}" for m, (v, _) in metrics.items() if v is not None)
            print(f"{case}: {summary}  ({time.monotonic() - started:.0f} s)", file=sys.stderr, flush=True)
    return rows


def _cases(data: Path | None, clips: list[str] | None) -> Iterator[tuple[str, str | None]]:
    if clips is None or "routine" in clips:
        yield "builtin", None
    if data is None:
        return
    there = json.loads((data / "mocap" / "clips.json").read_text())
    unknown = set(clips or ()) - set(there) - {"routine"}
    if unknown:
        raise SystemExit(f"no clip {', '.join(sorted(unknown))}; there are: routine, {', '.join(sorted(there))}")
    for clip in there if clips is None else [clip for clip in clips if clip != "routine"]:
        for body in sorted(path.stem for path in (data / "bodies").glob("*.npz")):
            yield body, clip


def _row(case: str, metric: str, value: float | None, unit: str) -> dict[str, Any]:
    reference, source = _REFERENCES.get(metric, (None, ""))
    return {"case": case, "metric": metric, "value": value, "unit": unit, "reference": reference, "source": source}


def _warm_up() -> None:
    """Compiles or loads every kernel, so that the first case's times are the tracker's own."""
    _depth_auto(open_performer("builtin", None, None), 0.2)


def _points_given(performer: Performer, length_s: float) -> Run:
    tracker = GaussNewtonTracker(GaussNewtonSettings())
    random = np.random.default_rng(0)
    result = Run()
    for frame in range(int(length_s * FRAME_RATE_HZ)):
        time_s = frame / FRAME_RATE_HZ
        surface, joints = performer.surface(time_s), performer.named_joints(time_s)
        cloud = surface_points(surface, performer.mesh.faces, performer.mesh.vertex_colours, POINTS, random)
        begun = time.thread_time()
        if frame == 0:
            skeleton, pose = skeleton_from_joints(joints.astype(np.float64), float(np.ptp(surface[:, 1])))
            fit: FitResult | None = tracker.start_from(skeleton, pose, cloud, 0)
        else:
            fit = tracker.track(cloud, round(time_s * 1e9))
        result.add(fit, time.thread_time() - begun, joints, bounding_ball_radius(surface), time_s)
    return result


def _depth_auto(performer: Performer, length_s: float) -> Run:
    renderer = RigRenderer(performer, RigSettings(cameras=CAMERAS))
    backgrounds = [
        BackgroundModel(camera, renderer.empty_room(index), BackgroundSettings())
        for index, camera in enumerate(renderer.cameras)
    ]
    sampler = PointSampler(renderer.cameras, POINTS)
    tracker = GaussNewtonTracker(GaussNewtonSettings())
    result = Run()
    for frame in range(int(length_s * FRAME_RATE_HZ)):
        time_s = frame / FRAME_RATE_HZ
        views = []
        for index, camera in enumerate(renderer.cameras):
            depth = np.empty((camera.height, camera.width), np.uint16)
            colour = np.empty((camera.height, camera.width, 3), np.uint8)
            renderer.view(index, time_s, depth, colour)
            views.append(backgrounds[index].foreground(DepthFrame(index, frame, round(time_s * 1e9), depth, colour)))
        cloud = sampler.points([view for view in views if view is not None])
        begun = time.thread_time()
        fit = tracker.track(cloud, round(time_s * 1e9))
        cpu_s = time.thread_time() - begun
        result.add(fit, cpu_s, performer.named_joints(time_s), bounding_ball_radius(performer.surface(time_s)), time_s)
    return result


def surface_points(
    vertices: Array, faces: Array, colours: Array, count: int, random: np.random.Generator
) -> PointCloud:
    """``count`` points spread evenly over a mesh: ``vertices`` (V, 3) [m], ``faces`` (F, 3), ``colours`` (V, 3)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    chosen = random.choice(len(faces), count, p=areas / areas.sum())
    s, t = np.sort(random.random((2, count, 1)), axis=0)
    points = a[chosen] * s + b[chosen] * (t - s) + c[chosen] * (1 - t)
    unit = normals[chosen] / np.maximum(areas[chosen, None], 1e-12)
    return PointCloud(points.astype(np.float32), unit.astype(np.float32), colours[faces[chosen, 0]])
