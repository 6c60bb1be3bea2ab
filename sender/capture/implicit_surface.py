"""Solids as smooth unions of tubes with elliptic cross-sections, and their surface as a quad mesh.

The surface is found by naive surface nets (Gibson 1998: one vertex in every cell the surface crosses, one quad
around every grid edge it crosses), after which the vertices are pulled onto the exact surface along its gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

Floats = NDArray[np.float64]

_PROFILE_SAMPLES = 64
_PROJECTION_STEPS = 2
_GRADIENT_STEP_M = 1e-3


@dataclass(frozen=True, slots=True)
class Tube:
    """A solid around the segment ``start``–``end`` [m]; solids come in mirrored pairs, given for x >= 0.

    ``stations``: (share of the length 0..1, half width to the side, to the front, to the back [m]), along the segment.
    ``front``: which way the front of the cross-sections faces. ``blend_m``: width of the fillet to the tubes of its
    group before it. ``cut``: (normal, offset), only what lies at ``normal · p <= offset`` counts.
    """

    name: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    stations: tuple[tuple[float, float, float, float], ...]
    front: tuple[float, float, float] = (0.0, 0.0, 1.0)
    blend_m: float = 0.02
    cut: tuple[tuple[float, float, float], float] | None = None


class Solid:
    """Smooth union of groups of tubes: (fillet of the group to those before it [m], tubes)."""

    def __init__(self, groups: Sequence[tuple[float, Sequence[Tube]]]) -> None:
        self._groups = [(blend_m, [_PlacedTube(tube) for tube in tubes]) for blend_m, tubes in groups]
        self._names = np.array([tube.name for _, tubes in groups for tube in tubes])

    def distance(self, points: Floats) -> Floats:
        """Signed distance (P,) [m], negative inside, near enough to it close to the surface, at points (P, 3)."""
        mirrored = np.abs(points[:, 0]), points[:, 1], points[:, 2]
        total = np.full(len(points), np.inf)
        for blend_m, tubes in self._groups:
            group = np.full(len(points), np.inf)
            for tube in tubes:
                group = _smooth_union(group, tube.distance(*mirrored), tube.blend_m)
            total = _smooth_union(total, group, blend_m)
        return total

    def owner(self, points: Floats) -> NDArray[np.str_]:
        """Name (P,) of the tube nearest to each of the points (P, 3) [m]."""
        mirrored = np.abs(points[:, 0]), points[:, 1], points[:, 2]
        distances = [tube.distance(*mirrored) for _, tubes in self._groups for tube in tubes]
        return self._names[np.argmin(distances, axis=0)]

    def gradient(self, points: Floats) -> Floats:
        """Gradient (P, 3) of the distance at points (P, 3) [m]: the outward normal, on the surface."""
        here = self.distance(points)
        ahead = [self.distance(points + axis) - here for axis in np.eye(3) * _GRADIENT_STEP_M]
        return np.stack(ahead, axis=1) / _GRADIENT_STEP_M


class _PlacedTube:
    def __init__(self, tube: Tube) -> None:
        self.blend_m = tube.blend_m
        self._start = np.array(tube.start, float)
        axis = np.subtract(tube.end, tube.start)
        self._length = float(np.linalg.norm(axis))
        self._axis = axis / self._length
        front = np.array(tube.front) - (tube.front @ self._axis) * self._axis
        self._front = front / np.linalg.norm(front)
        self._side = np.cross(self._axis, self._front)
        stations = np.array(tube.stations)
        shares = np.linspace(0, 1, _PROFILE_SAMPLES)
        self._profile = PchipInterpolator(stations[:, 0], stations[:, 1:])(shares)
        self._cut = tube.cut

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Signed distance (P,) [m] to the tube: exact along the axis, along rays from the axis across it."""
        along, side, front = (self._coordinate(axis, x, y, z) for axis in (self._axis, self._side, self._front))
        place = np.clip(along * ((_PROFILE_SAMPLES - 1) / self._length), 0, _PROFILE_SAMPLES - 1.001)
        sample = place.astype(np.int64)
        share = place - sample
        column = np.where(front > 0, 1, 2)
        half_side = (1 - share) * self._profile[sample, 0] + share * self._profile[sample + 1, 0]
        half_front = (1 - share) * self._profile[sample, column] + share * self._profile[sample + 1, column]
        ratio = np.maximum(np.sqrt((side / half_side) ** 2 + (front / half_front) ** 2), 1e-3)
        radial = np.maximum(np.sqrt(side**2 + front**2) * (1 - 1 / ratio), -np.minimum(half_side, half_front))
        beyond = np.abs(along - self._length / 2) - self._length / 2
        distance = np.where(beyond > 0, np.hypot(np.maximum(radial, 0), beyond), np.maximum(radial, beyond))
        if self._cut is not None:
            (nx, ny, nz), offset = self._cut
            distance = np.maximum(distance, nx * x + ny * y + nz * z - offset)
        return distance

    def _coordinate(self, axis: Floats, x: Floats, y: Floats, z: Floats) -> Floats:
        return axis[0] * x + axis[1] * y + axis[2] * z - axis @ self._start


def _smooth_union(a: Floats, b: Floats, width: float) -> Floats:
    overlap = np.maximum(width - np.abs(a - b), 0.0)
    return np.minimum(a, b) - overlap * overlap / (4 * width)


def polygonise(solid: Solid, grid: tuple[Floats, Floats, Floats]) -> tuple[Floats, NDArray[np.int32]]:
    """Surface of the solid inside a grid of planes x (X,), y (Y,), z (Z,) [m, ascending; x symmetric about a 0].

    Returns:
        vertices (P, 3) float64 [m] on the surface, and quads (Q, 4) int32, counter-clockwise seen from outside.
    """
    half = (grid[0][len(grid[0]) // 2 :], *grid[1:])
    nodes = np.stack(np.meshgrid(*half, indexing="ij"), axis=-1)
    field = solid.distance(nodes.reshape(-1, 3)).reshape(nodes.shape[:3])
    field = np.concatenate([field[:0:-1], field])
    cells, quads = _surface_cells(field)
    places = _mean_crossings(field, cells)
    vertices, span = np.empty_like(places), np.empty_like(places)
    for axis, planes in enumerate(grid):
        vertices[:, axis] = np.interp(places[:, axis], np.arange(len(planes)), planes)
        span[:, axis] = np.diff(planes)[cells[:, axis]]
    for _ in range(_PROJECTION_STEPS):
        slope = solid.gradient(vertices)
        step = -slope * (solid.distance(vertices) / np.maximum(np.sum(slope**2, axis=1), 0.25))[:, None]
        vertices += np.clip(step, -span / 2, span / 2)  # stay near the cell, or neighbours would change places
    return vertices, quads


def _surface_cells(field: Floats) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Cells (P, 3) the zero surface of ``field`` (X, Y, Z) crosses; quads (Q, 4) of them, one per crossed edge."""
    inside = field < 0
    corners = [
        inside[i : i - 1 or None, j : j - 1 or None, k : k - 1 or None] for i in (0, 1) for j in (0, 1) for k in (0, 1)
    ]
    crossed = np.logical_or.reduce(corners) & ~np.logical_and.reduce(corners)
    index = np.full(crossed.shape, -1, np.int32)
    index[crossed] = np.arange(np.count_nonzero(crossed))
    quads = []
    for axis in range(3):
        b, c = np.roll(np.eye(3, dtype=np.int64), -axis - 1, axis=0)[:2]
        here = np.moveaxis(inside, axis, 0)
        edges = np.argwhere(np.moveaxis(here[:-1] != here[1:], 0, axis))
        around = np.stack([index[tuple((edges - offset).T)] for offset in (0 * b, b, b + c, c)], axis=1)
        leaves = inside[tuple(edges.T)][:, None]  # the edge leads out of the solid: counter-clockwise about it
        quads.append(np.where(leaves, around, around[:, ::-1]))
    return np.argwhere(crossed), np.concatenate(quads)


def _mean_crossings(field: Floats, cells: NDArray[np.int64]) -> Floats:
    """Mean (P, 3) [grid units] of where the edges of each cell (P, 3) cross zero."""
    total, count = np.zeros(cells.shape), np.zeros(len(cells))
    for axis in range(3):
        for corner in range(4):
            offset = np.roll([0, corner & 1, corner >> 1], axis)
            before = field[tuple((cells + offset).T)]
            after = field[tuple((cells + offset + np.eye(3, dtype=np.int64)[axis]).T)]
            crosses = (before < 0) != (after < 0)
            place = np.tile(offset.astype(float), (len(cells), 1))
            place[:, axis] = before / np.where(crosses, before - after, 1)
            total += np.where(crosses[:, None], place, 0)
            count += crosses
    return cells + total / count[:, None]
