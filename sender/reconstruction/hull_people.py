"""Which part of a visual hull is the person: hulls of several people have one connected volume for each, and ghosts.

A ghost is a volume that every camera sees as a person only because somebody else stands in the line of sight. So it is
told by its silhouettes: a real person has pixels, in some camera, that no other volume explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from common.geometry.point_cloud import PointCloud
from common.geometry.rigid_transform import inverse, transform_points

Floats = NDArray[np.floating]

CELL_M = 0.06  # points nearer than this are connected
BLOCKS_ACROSS = 64  # of an image, in which volumes are told apart
LEAST_SHARE = 0.02  # smaller volumes are splinters where outlines graze each other
LEAST_HEIGHT_M, MOST_WIDTH_M = 0.8, 1.3  # of a person, arms not spread; who spreads them is there alone
OWN_PIXELS = 0.4  # share of its image, in some camera, that makes a volume real beyond doubt
REACH_M, SPEED_MPS = 0.28, 1.5  # a body's surface from its joints; how fast they go
LEAP_M = 0.7  # from where somebody was that had no pose yet


@dataclass(frozen=True, slots=True, eq=False)
class HullPerson:
    """The points (N,) bool of one person among a hull's, and how sure it is (0..1) that they are one's and all
    theirs. ``volumes``: how many there were, ghosts among them."""

    chosen: NDArray[np.bool_]
    certainty: float
    volumes: int


class PersonFollower:
    """Keeps to one person from hull to hull."""

    def __init__(self) -> None:
        self._middle: Floats | None = None  # of the person's points last time

    def find(
        self, cloud: PointCloud, cameras: Sequence[Camera], last_joints: Floats | None, since_s: float
    ) -> HullPerson:
        """The person among the hull's points. ``last_joints`` (J, 3) [m, world]: where the pose was ``since_s`` ago, if
        known: then the volume there, cut to what is in reach of it; else the one found last time; else the most real
        one."""
        volumes = connected_volumes(cloud.positions)
        count = int(volumes.max(initial=-1)) + 1
        if count == 0:
            return HullPerson(np.zeros(len(cloud), np.bool_), 0.0, 0)
        real = realness(cloud.positions, volumes, cameras)
        away = np.zeros(len(cloud)) if last_joints is None else _distances(cloud.positions, last_joints)
        reach_m = REACH_M + SPEED_MPS * since_s
        place_m = REACH_M if (away < REACH_M).any() else reach_m  # who stands where the pose was, not who comes near
        chosen = self._choose(cloud.positions, volumes, real, away < place_m, last_joints is not None)
        mine = (volumes == chosen) & (away < reach_m)
        if not mine.any():
            return HullPerson(mine, 0.0, count)
        self._middle = cloud.positions[mine].mean(axis=0)
        alone = float(mine.sum() / (volumes == chosen).sum())
        return HullPerson(mine, float(np.clip(real[chosen] / OWN_PIXELS, 0.0, 1.0)) * alone, count)

    def _choose(
        self, positions: Floats, volumes: NDArray[np.int32], real: Floats, near: NDArray[np.bool_], known: bool
    ) -> int:
        size = np.bincount(volumes[volumes >= 0], minlength=len(real))
        if known and near.any():
            return int(np.argmax(np.bincount(volumes[(volumes >= 0) & near], minlength=len(real))))
        extents = np.array([np.ptp(positions[volumes == index], axis=0) for index in range(len(real))])
        one = (extents[:, 1] > LEAST_HEIGHT_M) & (extents[:, [0, 2]].max(axis=1) < MOST_WIDTH_M)
        worth = real * size * np.where(one, 1.0, 0.01)
        if self._middle is not None:
            middles = np.array([positions[volumes == index].mean(axis=0) for index in range(len(real))])
            worth *= 0.001 + (np.linalg.norm(middles - self._middle, axis=1) < LEAP_M)
        return int(np.argmax(worth))


def connected_volumes(positions: Floats) -> NDArray[np.int32]:
    """Volume (N,) int32 of each point (N, 3) [m]: 0, 1, … by size, −1 for splinters. Points are connected through
    cells of ``CELL_M`` that touch."""
    import scipy.ndimage  # takes a while: nobody waits for it who has depth cameras

    if len(positions) == 0:
        return np.zeros(0, np.int32)
    cells = ((positions - positions.min(axis=0)) / CELL_M).astype(np.int64)
    room = np.zeros(cells.max(axis=0) + 1, np.bool_)
    room[tuple(cells.T)] = True
    labels, _ = scipy.ndimage.label(room, np.ones((3, 3, 3)))
    found = labels[tuple(cells.T)]
    sizes = np.bincount(found)
    order = np.argsort(-sizes, kind="stable")
    name = np.full(len(sizes), -1, np.int32)
    large = order[sizes[order] >= max(LEAST_SHARE * len(positions), 1)]
    name[large] = np.arange(len(large))
    return name[found]


def realness(positions: Floats, volumes: NDArray[np.int32], cameras: Sequence[Camera]) -> Floats:
    """Of each volume (V,), 0..1: the largest share of its image, in any of the pinhole ``cameras``, that no other
    volume covers too."""
    count = int(volumes.max(initial=-1)) + 1
    if count == 1:
        return np.ones(1)
    best = np.zeros(count)
    kept = volumes >= 0
    for camera in cameras:
        local = transform_points(inverse(camera.T_world_camera), positions[kept])
        depths = np.maximum(local[:, 2:], 1e-3)
        pixels = local[:, :2] / depths * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        there = (local[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
        column, row = (pixels[there] * (BLOCKS_ACROSS / camera.width)).astype(np.int64).T
        covered = np.zeros((count, int(row.max(initial=0)) + 1, BLOCKS_ACROSS), np.bool_)
        column = np.minimum(column, BLOCKS_ACROSS - 1)  # rounding
        covered[volumes[kept][there], row, column] = True
        own = covered & (covered.sum(axis=0) == 1)
        area = covered.sum(axis=(1, 2))
        best = np.maximum(best, own.sum(axis=(1, 2)) / np.maximum(area, 1))
    return best


def _distances(positions: Floats, joints: Floats) -> Floats:
    """From each point to the nearest joint (N,) [m]."""
    away = positions[:, None, :] - np.asarray(joints, positions.dtype)[None]
    return np.sqrt(np.einsum("pjk,pjk->pj", away, away).min(axis=1))
