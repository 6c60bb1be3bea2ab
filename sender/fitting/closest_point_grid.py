"""Closest model points looked up, not searched (algorithms.md §8).

The points of a link never move in the link's own frame, so for every cell of a grid around them the nearest point is
found once. Each cell has six answers, one for each main direction of a normal: a forearm that jumped further than its
own radius still finds its near side and not the far one (the normal clusters of Lien 2009 §5.1.3 in a table).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

NORMAL_BINS = 6
BIN_COSINE = 0.25  # a point is in every bin whose direction is within 75° of its normal
MAX_CELLS = 12_000  # of each main direction: large links get coarser cells, which their flat surfaces allow


class LinkGrid(NamedTuple):
    """``points, normals`` (M, 3) float32 in the link's frame [m]; ``origin`` (3,) float32 [m]: corner of cell (0, 0, 0);
    ``cell_m``: edge; ``nearest`` (6, nx, ny, nz) int16: row of the closest point for a normal of that main direction
    (+x, -x, +y, -y, +z, -z), -1 where the link has none."""

    points: Array
    normals: Array
    origin: Array
    cell_m: float
    nearest: Array


def build_link_grid(points: Array, normals: Array, cell_m: float, margin_m: float) -> LinkGrid:
    """Grid over the box of ``points`` (M, 3) [m, link frame] and ``margin_m`` around it; ``normals`` (M, 3) unit.

    Queries outside the box are meant to be clamped into it. Raises ValueError for more than 32 767 points.
    """
    if len(points) > np.iinfo(np.int16).max:
        raise ValueError(f"closest-point grid: {len(points)} points, at most 32767")
    points, normals = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(normals, np.float32)
    if len(points) == 0:
        return LinkGrid(points, normals, np.zeros(3, np.float32), cell_m, np.full((NORMAL_BINS, 1, 1, 1), -1, np.int16))
    origin = (points.min(0) - margin_m).astype(np.float32)
    extent = points.max(0) + margin_m - origin
    cell_m = max(cell_m, float(np.prod(extent) / MAX_CELLS) ** (1 / 3))
    shape = np.maximum(np.ceil(extent / cell_m).astype(np.int64), 1)
    nearest = np.full((NORMAL_BINS, *shape), -1, np.int16)
    _fill_nearest(points, normals, origin, np.float32(cell_m), nearest)
    return LinkGrid(points, normals, origin, cell_m, nearest)


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _fill_nearest(points: Array, normals: Array, origin: Array, cell: float, nearest: Array) -> None:
    """Seeds each bin with its points, then hands the best candidate on to the neighbours, there and back twice
    (Danielsson's vector distance transform)."""
    bins, nx, ny, nz = nearest.shape
    distance = np.empty((nx, ny, nz), np.float32)
    for b in range(bins):
        sign = 1.0 if b % 2 == 0 else -1.0
        distance[:] = np.inf
        best = nearest[b]
        for k in range(len(points)):
            if sign * normals[k, b // 2] > BIN_COSINE:
                x = int((points[k, 0] - origin[0]) / cell)
                y = int((points[k, 1] - origin[1]) / cell)
                z = int((points[k, 2] - origin[2]) / cell)
                _offer(points, origin, cell, best, distance, k, x, y, z)
        for _ in range(2):
            for x in range(nx):
                for y in range(ny):
                    for z in range(nz):
                        _take_from_neighbours(points, origin, cell, best, distance, x, y, z, -1)
            for x in range(nx - 1, -1, -1):
                for y in range(ny - 1, -1, -1):
                    for z in range(nz - 1, -1, -1):
                        _take_from_neighbours(points, origin, cell, best, distance, x, y, z, 1)


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _take_from_neighbours(
    points: Array, origin: Array, cell: float, best: Array, distance: Array, x: int, y: int, z: int, step: int
) -> None:
    nx, ny, nz = best.shape
    if 0 <= x + step < nx and best[x + step, y, z] >= 0:
        _offer(points, origin, cell, best, distance, best[x + step, y, z], x, y, z)
    if 0 <= y + step < ny and best[x, y + step, z] >= 0:
        _offer(points, origin, cell, best, distance, best[x, y + step, z], x, y, z)
    if 0 <= z + step < nz and best[x, y, z + step] >= 0:
        _offer(points, origin, cell, best, distance, best[x, y, z + step], x, y, z)


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _offer(
    points: Array, origin: Array, cell: float, best: Array, distance: Array, k: int, x: int, y: int, z: int
) -> None:
    dx = origin[0] + (x + 0.5) * cell - points[k, 0]
    dy = origin[1] + (y + 0.5) * cell - points[k, 1]
    dz = origin[2] + (z + 0.5) * cell - points[k, 2]
    d = dx * dx + dy * dy + dz * dz
    if d < distance[x, y, z]:
        distance[x, y, z] = d
        best[x, y, z] = k
