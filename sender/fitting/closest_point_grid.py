"""Closest model points looked up, not searched.

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
SPACING_SAMPLES = 40
MAX_CELLS = 3_500  # of each main direction: large links get coarser cells, which their flat surfaces allow


class LinkGrid(NamedTuple):
    """``points, normals`` (M, 3) float32 [m, link frame]; ``origin`` (3,) float32 [m]: corner of cell (0, 0, 0);
    ``cell_m``: edge; ``nearest`` (6, nx, ny, nz) int16: row of the closest point for a normal of that main direction
    (+x, -x, +y, -y, +z, -z), -1 where the link has none; ``low, high`` (3,) float32: box of the points;
    ``spacing2_m2``: mean squared distance of a point from its nearest neighbour [m²]."""

    points: Array
    normals: Array
    origin: Array
    cell_m: float
    nearest: Array
    low: Array
    high: Array
    spacing2_m2: float


def build_link_grid(points: Array, normals: Array, cell_m: float, margin_m: float) -> LinkGrid:
    """Grid over the box of ``points`` (M, 3) [m, link frame] and ``margin_m`` around it; ``normals`` (M, 3) unit.

    Queries outside the box are meant to be clamped into it. Raises ValueError for more than 32 767 points.
    """
    if len(points) > np.iinfo(np.int16).max:
        raise ValueError(f"closest-point grid: {len(points)} points, at most 32767")
    points, normals = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(normals, np.float32)
    if len(points) == 0:
        nothing, zero = np.full((NORMAL_BINS, 1, 1, 1), -1, np.int16), np.zeros(3, np.float32)
        return LinkGrid(points, normals, zero, cell_m, nothing, zero, zero, 0.0)
    low, high = points.min(0), points.max(0)
    origin = (low - margin_m).astype(np.float32)
    extent = high + margin_m - origin
    cell_m = max(cell_m, float(np.prod(extent) / MAX_CELLS) ** (1 / 3))
    shape = np.maximum(np.ceil(extent / cell_m).astype(np.int64), 1)
    nearest = np.full((NORMAL_BINS, *shape), -1, np.int16)
    _fill_nearest(points, normals, origin, np.float32(cell_m), nearest)
    return LinkGrid(points, normals, origin, cell_m, nearest, low, high, _spacing2(points))


@njit(nogil=True, cache=True, error_model="numpy")
def _spacing2(points: Array) -> float:
    """Mean squared distance to the nearest neighbour [m²], of about ``SPACING_SAMPLES`` of the points (M, 3)."""
    step = max(len(points) // SPACING_SAMPLES, 1)
    total, count = 0.0, 0
    for n in range(0, len(points), step):
        nearest = np.inf
        for k in range(len(points)):
            if k != n:
                dx, dy, dz = (
                    points[n, 0] - points[k, 0],
                    points[n, 1] - points[k, 1],
                    points[n, 2] - points[k, 2],
                )
                nearest = min(nearest, dx * dx + dy * dy + dz * dz)
        if nearest < np.inf:
            total += nearest
            count += 1
    return total / max(count, 1)


def shifted(grid: LinkGrid, by: Array) -> LinkGrid:
    """The grid with all its points moved ``by`` (3,) [m]."""
    step = by.astype(np.float32)
    return grid._replace(
        points=grid.points + step, origin=grid.origin + step, low=grid.low + step, high=grid.high + step
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _fill_nearest(points: Array, normals: Array, origin: Array, cell: np.float32, nearest: Array) -> None:
    """Every cell's closest point of each bin: all points against one row of cells after another, whose inner loop runs
    over the row without a branch, so that it is done eight cells at a time."""
    bins, nx, ny, nz = nearest.shape
    half = np.float32(0.5)
    z = origin[2] + (np.arange(nz).astype(np.float32) + half) * cell
    least, best = np.empty(nz, np.float32), np.empty(nz, np.int32)
    for b in range(bins):
        sign = np.float32(1.0 if b % 2 == 0 else -1.0)
        rows = np.flatnonzero(sign * normals[:, b // 2] > np.float32(BIN_COSINE)).astype(np.int32)
        members = points[rows]
        for x in range(nx):
            cx = origin[0] + (np.float32(x) + half) * cell
            for y in range(ny):
                cy = origin[1] + (np.float32(y) + half) * cell
                least[:], best[:] = np.float32(np.inf), -1
                for m in range(len(rows)):
                    dx, dy, pz, k = cx - members[m, 0], cy - members[m, 1], members[m, 2], rows[m]
                    aside = dx * dx + dy * dy
                    for i in range(nz):
                        dz = z[i] - pz
                        d = aside + dz * dz
                        closer = d < least[i]
                        least[i] = d if closer else least[i]
                        best[i] = k if closer else best[i]
                for i in range(nz):
                    nearest[b, x, y, i] = best[i]
