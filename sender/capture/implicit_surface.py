"""Solids as smooth unions of tubes with elliptic cross-sections, and their surface as a quad mesh.

The surface is found by naive surface nets (Gibson 1998: one vertex in every cell the surface crosses, one quad
around every grid edge it crosses), after which the vertices are pulled onto the exact surface along its gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

Floats = NDArray[np.float64]

_PROFILE_SAMPLES = 64
_PROJECTION_STEPS = 3
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


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """Tubes in groups, as the arrays the kernels take (N tubes, S profile samples).

    ``frames`` (N, 4, 3): start, axis, side, front. ``lengths`` (N,), ``profiles`` (N, S, 3), ``cuts`` (N, 4),
    ``groups`` (N,), ``blends`` (N,), ``group_blends`` (G,): fillets between a group and those before it [m].
    """

    frames: Floats
    lengths: Floats
    profiles: Floats
    cuts: Floats
    groups: NDArray[np.int64]
    blends: Floats
    group_blends: Floats

    def distance(self, points: Floats) -> Floats:
        """Signed distance (P,) [m], negative inside, near enough to it close to the surface, at points (P, 3)."""
        return self._evaluate(points)[0]

    def owner(self, points: Floats) -> NDArray[np.int64]:
        """Index (P,) of the tube nearest to each of the points (P, 3) [m]."""
        return self._evaluate(points)[1]

    def gradient(self, points: Floats) -> Floats:
        """Gradient (P, 3) of the distance at points (P, 3) [m]: the outward normal, on the surface."""
        axes = np.eye(3) * _GRADIENT_STEP_M
        ahead, behind = ([self.distance(points + sign * axis) for axis in axes] for sign in (1, -1))
        return (np.stack(ahead, 1) - np.stack(behind, 1)) / (2 * _GRADIENT_STEP_M)

    def _evaluate(self, points: Floats) -> tuple[Floats, NDArray[np.int64]]:
        distance, owner = np.empty(len(points)), np.empty(len(points), np.int64)
        arrays = (self.frames, self.lengths, self.profiles, self.cuts, self.groups, self.blends, self.group_blends)
        _distance(np.ascontiguousarray(points), *arrays, distance, owner)
        return distance, owner


def build_solid(groups: Sequence[tuple[float, Sequence[Tube]]]) -> Solid:
    """Solid of groups (fillet to the groups before it [m], tubes)."""
    tubes = [tube for _, group in groups for tube in group]
    frames, profiles = [], []
    shares = np.linspace(0, 1, _PROFILE_SAMPLES)
    for tube in tubes:
        axis = np.subtract(tube.end, tube.start)
        axis /= np.linalg.norm(axis)
        front = np.array(tube.front) - np.dot(tube.front, axis) * axis
        front /= np.linalg.norm(front)
        frames.append([tube.start, axis, np.cross(axis, front), front])
        stations = np.array(tube.stations)
        profiles.append(PchipInterpolator(stations[:, 0], stations[:, 1:])(shares))
    return Solid(
        frames=np.array(frames, float),
        lengths=np.array([np.linalg.norm(np.subtract(tube.end, tube.start)) for tube in tubes]),
        profiles=np.array(profiles),
        cuts=np.array([(*tube.cut[0], tube.cut[1]) if tube.cut else (0, 0, 0, 1) for tube in tubes], float),
        groups=np.array([g for g, (_, group) in enumerate(groups) for _ in group]),
        blends=np.array([tube.blend_m for tube in tubes]),
        group_blends=np.array([blend for blend, _ in groups]),
    )


def polygonise(solid: Solid, grid: tuple[Floats, Floats, Floats]) -> tuple[Floats, NDArray[np.int32]]:
    """Surface of the solid inside a grid of planes x (X,), y (Y,), z (Z,) [m, ascending].

    Returns:
        vertices (P, 3) float64 [m] on the surface, and quads (Q, 4) int32, counter-clockwise seen from outside.
    """
    nodes = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 3)
    field = solid.distance(nodes).reshape([len(planes) for planes in grid])
    cells, quads = _surface_nets(field)
    low = np.floor(cells).astype(np.int64)
    vertices = np.empty_like(cells)
    for axis, planes in enumerate(grid):
        vertices[:, axis] = np.interp(cells[:, axis], np.arange(len(planes)), planes)
    span = np.stack([planes[low[:, axis] + 1] - planes[low[:, axis]] for axis, planes in enumerate(grid)], axis=1)
    for _ in range(_PROJECTION_STEPS):
        slope = solid.gradient(vertices)
        step = -slope * (solid.distance(vertices) / np.maximum(np.sum(slope**2, axis=1), 0.25))[:, None]
        vertices += np.clip(step, -span / 2, span / 2)  # stay near the cell, or neighbours would change places
    return vertices, quads


@njit(nogil=True, cache=True)
def _distance(
    points: Any,
    frames: Any,
    lengths: Any,
    profiles: Any,
    cuts: Any,
    groups: Any,
    blends: Any,
    group_blends: Any,
    distance: Any,
    owner: Any,
) -> None:
    for i in range(points.shape[0]):
        x, y, z = abs(points[i, 0]), points[i, 1], points[i, 2]  # mirrored halves
        total, of_group, nearest = 1e9, 1e9, 1e9
        for n in range(lengths.shape[0]):
            if n > 0 and groups[n] != groups[n - 1]:
                total = _smooth_union(total, of_group, group_blends[groups[n - 1]])
                of_group = 1e9
            d = _tube_distance(x, y, z, frames[n], lengths[n], profiles[n])
            d = max(d, cuts[n, 0] * x + cuts[n, 1] * y + cuts[n, 2] * z - cuts[n, 3])
            if d < nearest:
                nearest, owner[i] = d, n
            of_group = _smooth_union(of_group, d, blends[n])
        distance[i] = _smooth_union(total, of_group, group_blends[groups[-1]])


@njit(nogil=True, cache=True)
def _smooth_union(a: float, b: float, width: float) -> float:
    overlap = max(width - abs(a - b), 0.0)
    return min(a, b) - overlap * overlap / (4 * width)


@njit(nogil=True, cache=True)
def _tube_distance(x: float, y: float, z: float, frame: Any, length: float, profile: Any) -> float:
    x, y, z = x - frame[0, 0], y - frame[0, 1], z - frame[0, 2]
    along = x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2]
    side = x * frame[2, 0] + y * frame[2, 1] + z * frame[2, 2]
    front = x * frame[3, 0] + y * frame[3, 1] + z * frame[3, 2]
    place = min(max(along / length, 0.0), 1.0) * (profile.shape[0] - 1)
    k = min(int(place), profile.shape[0] - 2)
    share = place - k
    half_side = (1 - share) * profile[k, 0] + share * profile[k + 1, 0]
    column = 1 if front > 0 else 2
    half_front = (1 - share) * profile[k, column] + share * profile[k + 1, column]
    radius = np.sqrt(side * side + front * front)
    ratio = np.sqrt((side / half_side) ** 2 + (front / half_front) ** 2)
    radial = radius * (1 - 1 / ratio) if ratio > 0.1 else -min(half_side, half_front)
    beyond = abs(along - length / 2) - length / 2
    if beyond > 0:
        return np.sqrt(max(radial, 0.0) ** 2 + beyond * beyond)
    return max(radial, beyond)


@njit(nogil=True, cache=True)
def _surface_nets(field: Any) -> tuple[Any, Any]:
    """Vertices (P, 3) in units of cells and quads (Q, 4) of the zero surface of ``field`` (X, Y, Z), negative inside."""
    nx, ny, nz = field.shape
    index = np.full((nx, ny, nz), -1, np.int32)
    count = 0
    for x in range(nx - 1):
        for y in range(ny - 1):
            for z in range(nz - 1):
                inside = 0
                for c in range(8):
                    inside += field[x + (c & 1), y + (c >> 1 & 1), z + (c >> 2)] < 0
                if 0 < inside < 8:
                    index[x, y, z] = count
                    count += 1
    vertices = np.zeros((count, 3))
    quads = np.empty((3 * count, 4), np.int32)
    used = 0
    node = np.empty(3, np.int64)
    for x in range(nx - 1):
        for y in range(ny - 1):
            for z in range(nz - 1):
                if index[x, y, z] >= 0:
                    vertices[index[x, y, z]] = _mean_crossing(field, x, y, z)
                for axis in range(3):
                    b, c = (axis + 1) % 3, (axis + 2) % 3
                    node[0], node[1], node[2] = x, y, z
                    if node[b] == 0 or node[c] == 0:
                        continue
                    node[axis] += 1
                    inside_here = field[x, y, z] < 0
                    if inside_here == (field[node[0], node[1], node[2]] < 0):
                        continue
                    node[axis] -= 1
                    for corner in range(4):  # the four cells around the edge, counter-clockwise about +axis
                        node[0], node[1], node[2] = x, y, z
                        node[b] -= corner in (1, 2)
                        node[c] -= corner in (2, 3)
                        quads[used, corner if inside_here else 3 - corner] = index[node[0], node[1], node[2]]
                    used += 1
    return vertices, quads[:used]


@njit(nogil=True, cache=True)
def _mean_crossing(field: Any, x: int, y: int, z: int) -> Any:
    total, crossings = np.zeros(3), 0
    for axis in range(3):
        for c in range(4):
            offset = np.zeros(3, np.int64)
            offset[(axis + 1) % 3], offset[(axis + 2) % 3] = c & 1, c >> 1
            a = field[x + offset[0], y + offset[1], z + offset[2]]
            offset[axis] = 1
            b = field[x + offset[0], y + offset[1], z + offset[2]]
            if (a < 0) != (b < 0):
                place = offset.astype(np.float64)
                place[axis] = a / (a - b)
                total += place
                crossings += 1
    total /= crossings
    total[0] += x
    total[1] += y
    total[2] += z
    return total
