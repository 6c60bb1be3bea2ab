"""Captured performances on disk, as plain arrays: benches that run many times need not render and track each time.

Nothing tells when the capture itself has changed: then delete the folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.body.view import View
from common.geometry.camera_model import Camera


@dataclass(frozen=True, slots=True, eq=False)
class CapturedFrame:
    """One instant. ``time_s`` of the performance; ``views`` of the cameras that see the person; skeleton, pose and
    confidence from the truth and from our tracker (``own`` is None before its start)."""

    time_s: float
    views: tuple[View, ...]
    true: tuple[Skeleton, SkeletonPose]
    own: tuple[Skeleton, SkeletonPose, float] | None


Posed = tuple[Skeleton, SkeletonPose, float] | None
_ROW = 7  # frame, camera, corner, size, whether complete
_PARTS = ("offsets", "tips", "radii", "root_position", "rotations", "confidence")


def save_frames(folder: Path, frames: Sequence[CapturedFrame], cameras: Sequence[Camera]) -> None:
    """Write ``frames`` into ``folder``; ``cameras``: those the views name."""
    folder.mkdir(parents=True, exist_ok=True)
    index = {camera.name: number for number, camera in enumerate(cameras)}
    views = [(k, view) for k, frame in enumerate(frames) for view in frame.views]
    rows = [(k, index[view.camera.name], view.u0, view.v0, *view.depth_mm.shape, view.complete) for k, view in views]
    arrays = {
        "view_rows": np.array(rows, np.int64).reshape(-1, _ROW),
        "depth_mm": np.concatenate([view.depth_mm.ravel() for _, view in views]),
        "colour": np.concatenate([view.colour.reshape(-1, 3) for _, view in views]),
        **_pose_arrays("true", [(*frame.true, 1.0) for frame in frames]),
        **_pose_arrays("own", [frame.own for frame in frames]),
    }
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    np.save(folder / "time_s.npy", np.array([frame.time_s for frame in frames]))  # last: the folder is whole


def load_frames(folder: Path, cameras: Sequence[Camera]) -> list[CapturedFrame] | None:
    """The frames ``save_frames`` wrote, their pixels mapped, not read; None where there are none."""
    if not (folder / "time_s.npy").is_file():
        return None
    rows = np.load(folder / "view_rows.npy")
    if rows.shape[1] != _ROW:  # of an earlier version
        return None
    time_s = np.load(folder / "time_s.npy")
    depth, colour = (np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("depth_mm", "colour"))
    views: list[list[View]] = [[] for _ in time_s]
    first = 0
    for k, camera, u0, v0, height, width, complete in rows.tolist():
        pixels = slice(first, first := first + height * width)
        shape = height, width
        images = depth[pixels].reshape(shape), colour[pixels].reshape(*shape, 3)
        views[k].append(View(cameras[camera], u0, v0, *images, complete=bool(complete)))
    true, own = _poses(folder, "true"), _poses(folder, "own")
    frames = []
    for second, seen, posed, found in zip(time_s.tolist(), views, true, own, strict=True):
        assert posed is not None
        frames.append(CapturedFrame(second, tuple(seen), posed[:2], found))
    return frames


def _pose_arrays(prefix: str, posed: Sequence[Posed]) -> dict[str, NDArray[np.float64]]:
    """One array of each part, and of the fit's confidence: nan where there is no pose."""
    known = [p for p in posed if p is not None]
    parts = {
        name: np.array([getattr(p[0] if name in _PARTS[:3] else p[1], name) for p in known], np.float32)
        for name in _PARTS
    }
    fit = np.array([np.nan if p is None else p[2] for p in posed])
    return {f"{prefix}_{name}": array for name, array in {**parts, "fit": fit}.items()}


def _poses(folder: Path, prefix: str) -> list[Posed]:
    parts = [np.load(folder / f"{prefix}_{name}.npy") for name in _PARTS]
    known = [(Skeleton(*row[:3]), SkeletonPose(*row[3:])) for row in zip(*parts, strict=True)]
    left = iter(known)
    confidences = np.load(folder / f"{prefix}_fit.npy").tolist()
    return [None if np.isnan(confidence) else (*next(left), confidence) for confidence in confidences]
