"""Whether σ means something: how well it ranks candidate poses by the error of the picture they give, beside rivals.

Candidate poses are spread over a motion; frames lie between them, so that a frame's own capture is never a candidate.
For every frame and pose, the mesh is moved to the frame's true skeleton and compared with the truth, in those of the
six measuring views that are within 60° of a capturing camera. Rank correlation (Spearman) of each score with the
squared error: the median over frames of ranking all poses, and over all pairs of frame and pose at once; and what
choosing by the score costs in PSNR against the best choice there was.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from common.body.body_regions import default_region_weights
from common.body.distortion_score import distortion_scores
from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton_pose import forward_kinematics
from common.body.skinning import animate, link_motion
from common.geometry.camera_model import Camera
from receiver.pipeline import mesh_of
from scripts.bench_fidelity import CAPTURED_S, CASES, Case
from scripts.fidelity import Picture, compare, measuring_cameras
from scripts.fidelity_capture import FRAME_RATE_HZ, START_S, Capture, capture, show_progress
from scripts.fidelity_methods import animated_picture, encoded_candidate
from scripts.fidelity_similarity import skeleton_distance_m
from scripts.rival_scores import DihedralScore, holistic_score
from scripts.run_bench import Row

POSES, FRAMES = 12, 12
NEAR_RAD = np.deg2rad(60)  # of a capturing camera, as seen from the middle of the person
WORST = 3  # disagreements shown


def add_options(parser: argparse.ArgumentParser) -> None:
    """This bench's own options."""
    parser.add_argument("--captures", type=Path, help="folder where captured motions are kept for the next time")
    parser.add_argument("--cameras", default="4", help="how many, separated by commas: 1 is a frontal one")
    parser.add_argument("--bodies", default="", help="only these bodies, in every clip of --clips")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the worst disagreements")


def run(
    data: Path | None, seconds: float | None, clips: tuple[str, ...], captures: Path | None = None,
    cameras: str = "4", bodies: str = "", pictures: Path | None = None,
) -> Iterator[Row]:  # fmt: skip
    """Rows for every body, motion and number of cameras."""
    kept = captures or Path(tempfile.gettempdir()) / f"telepose-captures-{os.getuid()}"
    known: list[tuple[str, str | None]] = [("builtin", None), *(CASES if data is not None else ())]
    if bodies:
        known = [(body, None if clip == "routine" else clip) for body in bodies.split(",") for clip in clips]
    for body, motion in known:
        if clips and (motion or "routine") not in clips:
            continue
        for count in map(int, cameras.split(",")):
            case = Case(body, motion, count)
            progress = show_progress(f"capturing {case}")
            recorded = capture(body, motion, data, count, seconds or CAPTURED_S, progress, kept)
            yield from _judged(str(case), recorded, pictures)


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """``error`` (F, P): mean squared error of every frame shown by every pose; ``by_name``: scores of the same."""

    frames: list[int]
    meshes: list[RiggedMesh]
    error: NDArray[np.float64]
    by_name: dict[str, NDArray[np.float64]]


def _judged(case: str, recorded: Capture, pictures: Path | None) -> Iterator[Row]:
    scores = scored(recorded)
    for name, score in scores.by_name.items():
        rank = [float(spearmanr(s, e).statistic) for s, e in zip(score, scores.error, strict=True)]
        pairs = float(spearmanr(score.ravel(), scores.error.ravel()).statistic)
        chosen = scores.error[np.arange(len(score)), score.argmin(axis=1)]
        lost_db = 10 * np.log10(chosen / scores.error.min(axis=1))
        for metric, value, unit in (
            (f"spearman_{name}_error", float(np.nanmedian(rank)), "1"),
            (f"spearman_{name}_error_pairs", pairs, "1"),
            (f"lost_by_{name}_db", float(lost_db.mean()), "dB"),
        ):
            yield Row(case=case, metric=metric, value=value, unit=unit, reference=None, source="")
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        _draw_worst(pictures / f"{case.replace('/', '-')}.png", recorded, scores)


def scored(recorded: Capture) -> Scores:
    """Every frame shown by every pose, judged by the truth and by each score."""
    first, last = int(START_S * FRAME_RATE_HZ) // 2, recorded.length - 1
    spots = np.linspace(first, last, POSES + FRAMES).astype(int).tolist()
    candidates, frames = spots[::2], spots[1::2]
    meshes, names, rows = [], list[str](), []
    for number, k in enumerate(candidates):
        encoded = encoded_candidate(number + 1, k, recorded.frame(k), own=False)
        if encoded is not None:
            meshes.append(mesh_of(encoded, 0).mesh)
    for mesh in meshes:
        judge = _Judge(mesh, meshes)
        column = []
        for k in frames:
            named = judge.scores(recorded, k)
            names = list(named)
            column.append(list(named.values()))
        rows.append(column)
        print(f"\r{len(rows)}/{len(meshes)} poses judged", end="", file=sys.stderr, flush=True)
    table = np.array(rows).transpose(2, 1, 0)  # (score, frame, pose)
    by_name = dict(zip(names, table, strict=True))
    error = by_name.pop("error")
    return Scores(frames, meshes, error, by_name)


class _Judge:
    """All scores of one pose. Two are tries to do better than σ: weighted by the surface that this pose lacks
    (``unseen``: of each link, the share of what others show), and by the distance of the skeletons."""

    def __init__(self, mesh: RiggedMesh, all_meshes: list[RiggedMesh]) -> None:
        self._mesh = mesh
        self._dihedral = DihedralScore(mesh)
        self._T_world_link = forward_kinematics(mesh.skeleton, mesh.pose)
        areas = np.array([drawn_areas(m) for m in all_meshes])
        self._unseen = float(np.maximum(1 - drawn_areas(mesh) / np.maximum(areas.max(axis=0), 1e-6), 0).mean())

    def scores(self, recorded: Capture, k: int) -> dict[str, float]:
        """The error of frame k's picture, and what each score says of it."""
        mesh = self._mesh
        captured = recorded.frame(k)
        T_world_link = forward_kinematics(*captured.true)
        motion = link_motion(mesh, T_world_link)
        rigid = animate(mesh, motion, "rigid")
        surface = recorded.performer.surface(captured.time_s)
        near = _near_views(measuring_cameras(surface), [view.camera for view in captured.views], surface)
        shown = animated_picture(mesh, motion, [camera for camera, _ in near])
        truth = [recorded.truth(k)[view] for _, view in near]
        psnr_db = compare(truth, shown).psnr_db
        sigma = float(distortion_scores(mesh.joint_edges, T_world_link[None], default_region_weights())[0])
        similarity = skeleton_distance_m(self._T_world_link, T_world_link)
        return {
            "error": 255**2 / 10 ** (psnr_db / 10),
            "sigma": sigma,
            "similarity": similarity,
            "holistic": holistic_score(mesh, rigid),
            "dihedral": self._dihedral(rigid),
            "sigma_unseen": sigma * (1 + self._unseen),
            "sigma_similarity": sigma * similarity,
        }


def drawn_areas(mesh: RiggedMesh) -> NDArray[np.float64]:
    """Area (L,) [m²] of each link's drawn triangles, by their first corner."""
    a, b, c = (mesh.mesh.vertices[mesh.faces_drawn[:, n]] for n in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    links = mesh.vertex_link[mesh.faces_drawn[:, 0]]
    return np.asarray(np.bincount(links, weights=areas, minlength=len(mesh.T_link_world)), np.float64)


def _near_views(
    measuring: list[Camera], capturing: list[Camera], surface: NDArray[np.floating]
) -> list[tuple[Camera, int]]:
    """The measuring cameras within 60° of a capturing one around the person, each with its number."""
    middle = (surface.min(axis=0) + surface.max(axis=0))[[0, 2]] / 2

    def angle(camera: Camera) -> float:
        x, z = camera.T_world_camera[[0, 2], 3] - middle
        return float(np.arctan2(x, z))

    near = []
    for view, camera in enumerate(measuring):
        apart = [abs((angle(camera) - angle(other) + np.pi) % (2 * np.pi) - np.pi) for other in capturing]
        if min(apart, default=np.pi) <= NEAR_RAD + 0.02:
            near.append((camera, view))
    return near


def _draw_worst(file: Path, recorded: Capture, scores: Scores) -> None:
    """The frames where choosing by σ loses most: truth, σ's choice, the best choice; two views each."""
    sigma = scores.by_name["sigma"]
    chosen, best = sigma.argmin(axis=1), scores.error.argmin(axis=1)
    lost_db = 10 * np.log10(scores.error[np.arange(len(best)), chosen] / scores.error.min(axis=1))
    rows = []
    for f in np.argsort(-lost_db)[:WORST]:
        captured = recorded.frame(scores.frames[f])
        cameras = measuring_cameras(recorded.performer.surface(captured.time_s))[:2]
        pictures: list[Picture] = recorded.truth(scores.frames[f])[:2]
        for p in (chosen[f], best[f]):
            mesh = scores.meshes[p]
            pictures += animated_picture(mesh, link_motion(mesh, forward_kinematics(*captured.true)), cameras)
        row = np.hstack([colour[:, 90:390] for colour, _ in pictures])
        note = f"frame {scores.frames[f]}: sigma's choice {sigma[f, chosen[f]]:.2f}, best {sigma[f, best[f]]:.2f}"
        cv2.putText(row, f"{note}, {lost_db[f]:.1f} dB lost", (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1)
        rows.append(row)
    cv2.imwrite(str(file), cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))
