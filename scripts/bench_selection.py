"""What choosing costs: σ per pose, both searches over repository size, animation, keeping χ and coverage, coding and
meshing a candidate pose, and all of it live: 30 skeletons a second before 200 poses.

Poses are captured from the built-in performer's routine by four virtual cameras; repositories larger than what was
captured hold it several times, each copy in memory of its own. Times are the thread's own on a core, the fastest of
many, to be told apart from whatever else the machine does. ``--pictures DIR`` draws DISPOSE's Figs. 6 and 7 anew.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.body_regions import default_region_weights
from common.body.distortion_score import SessionThreshold, distortion_scores
from common.body.joint_edge_store import JointEdgeStore
from common.body.joint_edges import EDGES_MOST
from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton_pose import forward_kinematics
from common.body.skinning import Skinning, animate, link_motion
from common.body.surface_normals import vertex_normals
from common.geometry.rasterizer import render
from common.runtime.clock import Clock, MonotonicClock
from common.wire.candidate_pose import decode_candidate_pose, encode_candidate_pose
from receiver.pipeline import mesh_of
from receiver.repository.pose_repository import PoseRepository, RepositorySettings
from receiver.repository.pose_selection import PoseSelector, SelectionSettings
from scripts.fidelity import measuring_cameras
from scripts.fidelity_capture import Capture, capture, show_progress
from scripts.fidelity_methods import encoded_candidate
from scripts.line_chart import line_chart
from scripts.run_bench import Row
from scripts.selection_live import ThreadClock, played_live
from sender.candidate_poses.pose_coverage import CoverageSet
from sender.candidate_poses.preview import encode_preview
from sender.config import CandidateSettings

CAPTURED_S = 14.0
POSE_EVERY = 8  # frames
CODED_EVERY = 40  # frames
SIZES = (1, 5, 10, 19, 50, 100, 200, 500, 1000)  # of a repository; 19 is where the paper's exhaustive search ends
RUNS, FRAMES = 40, 20
LIVE_POSES, LIVE_S = 200, 20.0
_SKINNINGS: tuple[Skinning, ...] = ("rigid", "linear", "spherical")


@dataclass(frozen=True, slots=True, eq=False)
class _Material:
    meshes: list[RiggedMesh]
    largest: RiggedMesh
    targets: NDArray[np.float32]  # (N, L, 4, 4)


def add_options(parser: argparse.ArgumentParser) -> None:
    """This bench's own options."""
    parser.add_argument("--captures", type=Path, help="folder where captured motions are kept for the next time")
    parser.add_argument("--pictures", type=Path, help="folder for curves and pictures")


def run(
    data: Path | None, seconds: float | None, clips: tuple[str, ...], captures: Path | None, pictures: Path | None
) -> Iterator[Row]:
    """Rows of the built-in routine, or of the first of ``clips`` on ``male_avg``."""
    motion = clips[0] if clips else None
    body = "male_avg" if motion else "builtin"
    recorded = capture(body, motion, data, 4, seconds or CAPTURED_S, show_progress("capturing"), captures)
    material = _material(recorded)
    case = f"{body}/{motion or 'routine'}/4"
    yield from _costs(case, material)
    exhaustive, threshold = _searches(material)
    yield _row(case, "exhaustive_ms_at_1000", exhaustive[1000], "ms", None, "paper: 19 poses are too many")
    yield _row(case, "exhaustive_ms_at_200", exhaustive[200], "ms")
    yield _row(case, "threshold_ms_at_200", threshold[200], "ms", 33.0, "DISPOSE §8: 30 fps at about 200 poses")
    gaps = _gaps(material)
    yield _row(case, "exhaustive_vs_threshold_gap_max", float(gaps.max()), "1", 0.12, "DISPOSE §7.1.1")
    yield _row(case, "exhaustive_vs_threshold_gap_mean", float(gaps.mean()), "1")
    yield from _coding(case, recorded)
    yield from _live(case, recorded, material)
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        _draw_searches(pictures / "search-time.svg", exhaustive, threshold)
        _draw_scores(pictures / "rising-score.png", material, recorded)


def _material(recorded: Capture) -> _Material:
    count = recorded.length
    meshes = []
    for pose_id, k in enumerate(range(0, count, POSE_EVERY), start=1):
        encoded = encoded_candidate(pose_id, k, recorded.frame(k), own=False)
        assert encoded is not None
        meshes.append(mesh_of(encoded, 0).mesh)
    targets = np.stack([forward_kinematics(*recorded.frame(k).true) for k in range(count)])
    return _Material(meshes, max(meshes, key=lambda mesh: len(mesh.mesh.vertices)), targets)


def _costs(case: str, material: _Material) -> Iterator[Row]:
    weights = default_region_weights()
    mesh, targets = material.largest, material.targets
    edges = mesh.joint_edges
    size = f"{len(mesh.mesh.vertices)} vertices, {len(edges)} joint edges"
    hundred = JointEdgeStore(weights)
    for pose_id in range(100):
        hundred.add(pose_id, material.meshes[pose_id % len(material.meshes)].joint_edges)
    ids = list(range(100))
    sigma_us = _fastest_ms(lambda: hundred.scores(ids, targets[0])) * 10
    yield _row(case, "sigma_us_per_pose", sigma_us, "µs", None, size)
    most = sigma_us * EDGES_MOST / len(edges)
    yield _row(case, "sigma_us_per_pose_46k", most, "µs", None, f"as of any fine mesh: scaled to {EDGES_MOST} edges")
    buffered = np.resize(targets, (300, *targets.shape[1:]))
    chi_ms = _fastest_ms(lambda: distortion_scores(edges, buffered, weights))
    yield _row(case, "chi_update_ms", chi_ms, "ms", None, "σ of a new pose for 300 skeletons")
    yield _row(case, "skeleton_update_ms", _skeleton_update_ms(material), "ms", None, "a new skeleton, 100 poses")
    motion = link_motion(mesh, targets[len(targets) // 2])
    per_vertex = 50_000 / len(mesh.mesh.vertices)
    for skinning in _SKINNINGS:

        def animated(skinning: Skinning = skinning) -> None:
            vertex_normals(animate(mesh, motion, skinning), mesh.faces_drawn)

        figure = _fastest_ms(animated) * per_vertex
        yield _row(case, f"animate_ms_50k/{skinning}", figure, "ms", 5.0, f"with normals, scaled from {size}")


def _coding(case: str, recorded: Capture) -> Iterator[Row]:
    """What a candidate pose takes: bytes, of each as sent over a wide link and a thin one, and time."""
    encoded = [encoded_candidate(k, k, recorded.frame(k), own=False) for k in range(0, recorded.length, CODED_EVERY)]
    poses = [decode_candidate_pose(data) for data in encoded if data is not None]
    settings, size = CandidateSettings(), f"{len(poses)} poses of {len(poses[0].views)} views"
    for name, quality in (("pose", settings.quality), ("thin_pose", settings.thin_quality)):
        kilobytes = [len(encode_candidate_pose(pose, quality)) / 1e3 for pose in poses]
        yield _row(case, f"{name}_kb", float(np.median(kilobytes)), "kB", None, f"at most {max(kilobytes):.0f}, {size}")
        ms = _fastest_ms(lambda quality=quality: encode_candidate_pose(poses[0], quality))  # type: ignore[misc]
        yield _row(case, f"{name}_encode_ms", ms, "ms")
    preview = [len(encode_preview(pose)) / 1e3 for pose in poses]
    yield _row(case, "preview_kb", float(np.median(preview)), "kB", None, f"at most {max(preview):.0f}")
    data = encode_candidate_pose(poses[0], settings.quality)
    yield _row(case, "pose_decode_ms", _fastest_ms(lambda: decode_candidate_pose(data)), "ms")
    yield _row(case, "pose_decode_and_mesh_ms", _fastest_ms(lambda: mesh_of(data, 0)), "ms")


def _live(case: str, recorded: Capture, material: _Material) -> Iterator[Row]:
    """By the clock on the wall, and by the threads' own time on a core."""
    frames = [recorded.frame(k) for k in range(recorded.length)]
    coming = enumerate(range(0, recorded.length, 7 * POSE_EVERY), start=LIVE_POSES)
    encoded = [encoded_candidate(pose_id, k, frames[k], own=False) for pose_id, k in coming]
    messages = [message for message in encoded if message is not None]
    clocks: dict[str, Clock] = {"live": MonotonicClock(), "live-core": ThreadClock()}
    for name, clock in clocks.items():
        live = played_live(material.meshes, [frame.true for frame in frames], messages, LIVE_POSES, LIVE_S, clock)
        size = f"30 skeletons a second for {LIVE_S:.0f} s, {live.poses} poses, one more a second"
        yield _row(case, f"{name}/shown_hz", live.shown_hz, "1/s", None, size)
        for stage in ("selection", "animate", "mesh"):
            found = live.stages[stage]
            yield _row(case, f"{name}/{stage}_ms_p50", found.p50_ms, "ms", None, f"{found.count} runs")
            yield _row(case, f"{name}/{stage}_ms_p99", found.p99_ms, "ms")


def _skeleton_update_ms(material: _Material) -> float:
    coverage = CoverageSet()
    for pose_id in range(100):
        mesh = material.meshes[pose_id % len(material.meshes)]
        coverage.add_pose(replace(mesh, pose_id=pose_id))
    times = iter(range(0, 10**15, 10**9))
    return _fastest_ms(lambda: coverage.add_skeleton(next(times), material.targets[0]))


def _searches(material: _Material) -> tuple[dict[int, float], dict[int, float]]:
    """Milliseconds a frame of both searches, by size of the repository: mean over the motion."""
    frames = material.targets[:: max(1, len(material.targets) // FRAMES)]
    repositories = {size: _repository(material.meshes, size) for size in SIZES}

    def times(settings: SelectionSettings) -> dict[int, float]:
        return {size: _search_ms(repository, settings, frames) for size, repository in repositories.items()}

    return times(SelectionSettings()), times(SelectionSettings(search="threshold", hold=True))


def _search_ms(repository: PoseRepository, settings: SelectionSettings, frames: NDArray[np.float32]) -> float:
    selector = PoseSelector(settings)
    for _ in range(3):  # the threshold finds its level
        for target in frames:
            selector.select(repository, target)
    if settings.search == "exhaustive":  # it costs the same in every frame
        return min(_fastest_ms(partial(selector.select, repository, target), 4) for target in frames)
    return float(np.mean([_fastest_ms(partial(selector.select, repository, target), 4) for target in frames]))


def _repository(meshes: list[RiggedMesh], size: int) -> PoseRepository:
    """``size`` poses of those captured, spread over the motion, again and again."""
    repository = PoseRepository(RepositorySettings(max_poses=size, max_bytes=1 << 40, equal_share=0.0))
    order = np.resize(np.random.default_rng(0).permutation(len(meshes)), size)
    for pose_id, index in enumerate(order.tolist()):
        repository.add(replace(meshes[index], pose_id=pose_id), 1, 0.0)
    return repository


def _gaps(material: _Material) -> NDArray[np.float64]:
    """By how much σ of what the threshold search chooses (no hold, threshold known) is above the best σ, by frame."""
    repository = _repository(material.meshes[::2], len(material.meshes[::2]))
    ids = repository.by_use()
    best = np.array([repository.scores(ids, target).min() for target in material.targets])
    threshold = SessionThreshold()
    for sigma in best:
        threshold.follow(float(sigma))
    chosen = [repository.scores(ids, target, threshold.value) for target in material.targets]
    return np.array([float(sigmas.min()) for sigmas in chosen], np.float64) - best


def _draw_searches(file: Path, exhaustive: dict[int, float], threshold: dict[int, float]) -> None:
    """DISPOSE Fig. 7: time of both searches over the number of poses."""
    lines = {
        "exhaustive": (list(exhaustive), list(exhaustive.values())),
        "threshold and hold": (list(threshold), list(threshold.values())),
    }
    file.write_text(line_chart("Searching a repository", "poses", "ms a frame", lines, ("10 ms", 10.0), dots=True))


def _draw_scores(file: Path, material: _Material, recorded: Capture) -> None:
    """DISPOSE Fig. 6: one posture from poses of rising σ."""
    k = recorded.length // 2
    target = material.targets[k]
    weights = default_region_weights()
    sigmas = [float(distortion_scores(mesh.joint_edges, target[None], weights)[0]) for mesh in material.meshes]
    order = np.argsort(sigmas)
    camera = measuring_cameras(recorded.performer.surface(recorded.frame(k).time_s))[0]
    pictures = []
    for rank in np.linspace(0, len(order) - 1, 8).astype(int):
        mesh = material.meshes[order[rank]]
        colour, _ = render(animate(mesh, link_motion(mesh, target)), mesh.faces_drawn, mesh.mesh.surface, camera)
        picture = np.ascontiguousarray(colour[:, 110:-110])
        text = f"{sigmas[order[rank]]:.2f}"
        cv2.putText(picture, text, (8, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (0, 0, 0), 2, cv2.LINE_AA)
        pictures.append(picture)
    cv2.imwrite(str(file), cv2.cvtColor(np.concatenate(pictures, axis=1), cv2.COLOR_RGB2BGR))


def _fastest_ms(action: Callable[[], object], runs: int = RUNS) -> float:
    action()
    best = float("inf")
    for _ in range(runs):
        begun = time.thread_time()
        action()
        best = min(best, time.thread_time() - begun)
    return best * 1e3


def _row(case: str, metric: str, value: float, unit: str, reference: float | None = None, source: str = "") -> Row:
    return Row(case=case, metric=metric, value=value, unit=unit, reference=reference, source=source)
