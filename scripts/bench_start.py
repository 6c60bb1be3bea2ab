"""The automatic start in mid-motion: how soon, how exact, and whether left and right or front and back are swapped.

Every clip on every body, begun at several places of the motion, facing every direction, a third of them away from
camera 1. Conditions: ``points`` (2,500 of the true surface), ``depth4``, ``depth2`` (front and back) and ``depth1``
(virtual depth cameras with their noise, real reconstruction). Clouds come ten a second: a step takes about 50 ms, so a
live sender looks at no more than 20. A start within 2 s counts; its joints are compared with the truth of its frame.
``swapped_share``: the pelvis and shoulders face backwards, or arms or legs are nearer to the other side's by 5 cm.
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import NAMED_JOINTS, SIDES
from common.body.skeleton_pose import named_joint_positions
from common.geometry.point_cloud import PointCloud
from scripts.run_bench import Row
from scripts.tracking_conditions import MOTION_BEGINS_S, surface_points
from sender.capture.frame_set import DepthFrame
from sender.capture.performer import Performer, PerformerMesh, open_performer
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import RigRenderer
from sender.fitting.initial_pose import InitialPose
from sender.fitting.initial_pose_search import InitialPoseSearch
from sender.reconstruction.background import BackgroundModel
from sender.reconstruction.foreground_points import PointSampler

Array = NDArray[Any]

WITHIN_S, CLOUDS_PER_S = 2.0, 10
POINTS = 2500
SURFACE_PLACES = (0.0, 0.15, 0.30, 0.45, 0.60, 0.75, 0.90)  # of the clip
CAMERA_PLACES = (0.0, 0.30, 0.60)
VIEWS = {"depth4": (0, 1, 2, 3), "depth2": (0, 2), "depth1": (0,)}  # of four cameras around
BAD_M = 0.15
SWAPPED_M = 0.05
GOLDEN = 0.618
_INDEX = {name: row for row, (name, _) in enumerate(NAMED_JOINTS)}
_OURS = "this bench"


@dataclass(frozen=True)
class Start:
    """One try: ``time_s`` to the first skeleton (None: none within 2 s), mean ``error_m`` of the joints, ``swapped``:
    what is on the wrong side, ``cpu_ms`` of each step."""

    time_s: float | None
    error_m: float
    swapped: str
    cpu_ms: tuple[float, ...]


class Turned:
    """A performer turned about the vertical by ``heading_rad``."""

    def __init__(self, performer: Performer, heading_rad: float) -> None:
        c, s = np.cos(heading_rad), np.sin(heading_rad)
        self.name = performer.name
        self.mesh: PerformerMesh = performer.mesh
        self.duration_s = performer.duration_s
        self._performer = performer
        self._turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32)

    def surface(self, time_s: float) -> NDArray[np.float32]:
        """See ``Performer``."""
        return np.ascontiguousarray(self._performer.surface(time_s) @ self._turn.T)

    def named_joints(self, time_s: float) -> NDArray[np.float32]:
        """See ``Performer``."""
        return np.ascontiguousarray(self._performer.named_joints(time_s) @ self._turn.T)


def run(data: Path | None, seconds: float | None = None, clips: tuple[str, ...] = ()) -> Iterator[Row]:
    """Rows for every clip, body and condition, and over all of them; ``seconds``: only starts within so much of a clip
    (default: all places); ``clips``: only these."""
    if data is None:
        raise SystemExit("this bench needs --data, a folder with bodies/ and mocap/")
    there = json.loads((data / "mocap" / "clips.json").read_text())
    if unknown := set(clips) - set(there):
        raise SystemExit(f"no clip {', '.join(sorted(unknown))}; there are: {', '.join(sorted(there))}")
    everything: dict[str, list[Start]] = defaultdict(list)
    number = 0
    for clip in clips or there:
        for body in sorted(path.stem for path in (data / "bodies").glob("*.npz")):
            performer = open_performer(body, clip, data)
            length_s = (performer.duration_s - MOTION_BEGINS_S) / 2  # clips are played to and fro
            starts: dict[str, list[Start]] = defaultdict(list)
            for place in SURFACE_PLACES:
                if seconds is not None and place * length_s > seconds:
                    continue
                number += 1
                heading = np.pi if number % 3 == 0 else 2 * np.pi * (number * GOLDEN % 1)
                turned, begin_s = Turned(performer, heading), MOTION_BEGINS_S + place * length_s
                starts["points"].append(_tried(turned, begin_s, _surface_clouds(turned, begin_s, number)))
                if place in CAMERA_PLACES:
                    for condition, clouds in _camera_clouds(turned, begin_s).items():
                        starts[condition].append(_tried(turned, begin_s, clouds))
            for condition, found in starts.items():
                everything[condition] += found
                yield from _rows(f"{body}/{clip}/{condition}", found)
                print(f"{body}/{clip}/{condition}: {_summary(found)}", file=sys.stderr, flush=True)
    for condition, found in everything.items():
        yield from _rows(f"all/all/{condition}", found)
        print(f"all {condition}: {_summary(found)}", file=sys.stderr, flush=True)


def _times(begin_s: float) -> list[float]:
    return [begin_s + frame / CLOUDS_PER_S for frame in range(int(WITHIN_S * CLOUDS_PER_S) + 1)]


def _surface_clouds(performer: Turned, begin_s: float, seed: int) -> list[PointCloud]:
    random, mesh = np.random.default_rng(seed), performer.mesh
    surfaces = (performer.surface(time_s) for time_s in _times(begin_s))
    return [surface_points(surface, mesh.faces, mesh.vertex_colours, POINTS, random) for surface in surfaces]


def _camera_clouds(performer: Turned, begin_s: float) -> dict[str, list[PointCloud]]:
    """What all four cameras, two and one of them make of the person."""
    renderer = RigRenderer(performer, RigSettings(cameras=4))
    cameras = renderer.cameras
    backgrounds = [
        BackgroundModel(c, renderer.empty_room(i), room_colour=renderer.empty_room_colour(i))
        for i, c in enumerate(cameras)
    ]
    sampler = PointSampler(cameras, POINTS)
    clouds: dict[str, list[PointCloud]] = {condition: [] for condition in VIEWS}
    for number, time_s in enumerate(_times(begin_s)):
        views = []
        for index, camera in enumerate(cameras):
            depth = np.empty((camera.height, camera.width), np.uint16)
            colour = np.empty((camera.height, camera.width, 3), np.uint8)
            renderer.view(index, time_s, depth, colour)
            views.append(backgrounds[index].foreground(DepthFrame(index, number, round(time_s * 1e9), depth, colour)))
        for condition, chosen in VIEWS.items():
            seen = [view for view in (views[index] for index in chosen) if view is not None]
            clouds[condition].append(sampler.points(seen))
    return clouds


def _tried(performer: Turned, begin_s: float, clouds: list[PointCloud]) -> Start:
    search = InitialPoseSearch()
    cpu_ms = []
    for time_s, cloud in zip(_times(begin_s), clouds, strict=True):
        begun = time.thread_time()
        found = search.step(cloud, round((time_s - begin_s) * 1e9))
        cpu_ms.append((time.thread_time() - begun) * 1e3)
        if isinstance(found, InitialPose):
            joints = named_joint_positions(found.skeleton, found.pose).astype(np.float64)
            truth = performer.named_joints(time_s).astype(np.float64)
            error_m = float(np.linalg.norm(joints - truth, axis=1).mean())
            return Start(time_s - begin_s, error_m, swapped(joints, truth), tuple(cpu_ms))
    return Start(None, np.nan, "", tuple(cpu_ms))


def swapped(joints: Array, truth: Array) -> str:
    """What of ``joints`` (16, 3) is on the wrong side of the ``truth``: "facing", "arms", "legs" or ""."""
    if _forwards(joints) @ _forwards(truth) < 0:
        return "facing"
    for limb, parts in (("arms", ("elbow", "wrist")), ("legs", ("knee", "ankle"))):
        left, right = ([_INDEX[f"{side}_{part}"] for part in parts] for side in SIDES)
        as_is = np.linalg.norm(joints[left + right] - truth[left + right], axis=1).mean()
        exchanged = np.linalg.norm(joints[left + right] - truth[right + left], axis=1).mean()
        if exchanged < as_is - SWAPPED_M:
            return limb
    return ""


def _forwards(joints: Array) -> Array:
    left, right = (joints[_INDEX[f"{side}_hip"]] + joints[_INDEX[f"{side}_shoulder"]] for side in SIDES)
    forwards: Array = np.cross(left - right, joints[_INDEX["neck"]] - joints[_INDEX["pelvis"]])
    return forwards


def _rows(case: str, starts: list[Start]) -> Iterator[Row]:
    started = [start for start in starts if start.time_s is not None]
    errors_m = np.array([start.error_m for start in started])
    cpu_ms = np.concatenate([start.cpu_ms for start in starts])
    figures: list[tuple[str, float | None, str]] = [("started_share", len(started) / len(starts), "1")]
    if started:
        times_s = [start.time_s for start in started if start.time_s is not None]
        figures += [
            ("time_to_skeleton_s", float(np.mean(times_s)), "s"),
            ("time_to_skeleton_s_p90", float(np.percentile(times_s, 90)), "s"),
            ("swapped_share", float(np.mean([bool(start.swapped) for start in started])), "1"),
            ("joint_error_m", float(errors_m.mean()), "m"),
            ("joint_error_over_15cm_share", float((errors_m > BAD_M).mean()), "1"),
        ]
    figures.append(("ms_per_step_p50", float(np.percentile(cpu_ms, 50)), "ms (CPU of the thread)"))
    for metric, value, unit in figures:
        yield Row(case=case, metric=metric, value=value, unit=unit, reference=None, source=_OURS)


def _summary(starts: list[Start]) -> str:
    return "  ".join(f"{row['metric']} {row['value']:.3g}" for row in _rows("", starts))
