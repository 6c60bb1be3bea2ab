"""Closest model points looked up, not searched.

The points of a link never move in the link's own frame, so for every cell of a grid around them the nearest point is
found once. Each cell has six answers, one for each main direction of a normal: a forearm that jumped further than its
own radius still finds its near side and not the far one (the normal clusters of Lien 2009 §5.1.3 in a table).
Links compete for a point by distance, and by colour: a hand before a chest is told from it by its skin.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

NORMAL_BINS = 6
BIN_COSINE = 0.25  # a point is in every bin whose direction is within 75° of its normal
NEAR_LINKS = 12  # candidate links a point may have
SPACING_SAMPLES = 40
NORMAL_GATE = 0.35  # least cosine between the normals of a point and its match
TINT_M = 0.15  # a match whose tint differs by 1 counts as this far away: skin and cloth (0.1 to 0.2) as 2 to 3 cm
TINT_FLOOR = 40.0  # grey levels added to a colour's brightness: dark points have no tint worth the name
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
    """Seeds each bin with its points, then hands the best candidate on to the neighbours, there and back twice
    (Danielsson's vector distance transform; once would leave errors of several cells)."""
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


@njit(nogil=True, cache=True, error_model="numpy")
def _take_from_neighbours(
    points: Array, origin: Array, cell: np.float32, best: Array, distance: Array, x: int, y: int, z: int, step: int
) -> None:
    nx, ny, nz = best.shape
    own = best[x, y, z]
    first = best[x + step, y, z] if 0 <= x + step < nx else own
    second = best[x, y + step, z] if 0 <= y + step < ny else own
    third = best[x, y, z + step] if 0 <= z + step < nz else own
    if first >= 0 and first != own:
        _offer(points, origin, cell, best, distance, first, x, y, z)
    if second >= 0 and second != own and second != first:
        _offer(points, origin, cell, best, distance, second, x, y, z)
    if third >= 0 and third != own and third != first and third != second:
        _offer(points, origin, cell, best, distance, third, x, y, z)


@njit(nogil=True, cache=True, error_model="numpy")
def _offer(
    points: Array, origin: Array, cell: np.float32, best: Array, distance: Array, k: int, x: int, y: int, z: int
) -> None:
    half = np.float32(0.5)
    dx = origin[0] + (np.float32(x) + half) * cell - points[k, 0]
    dy = origin[1] + (np.float32(y) + half) * cell - points[k, 1]
    dz = origin[2] + (np.float32(z) + half) * cell - points[k, 2]
    d = dx * dx + dy * dy + dz * dz
    if d < distance[x, y, z]:
        distance[x, y, z] = d
        best[x, y, z] = k


class Surface(NamedTuple):
    """The body's points and grids, all links one after the other (L links, M points, C grid cells).

    ``points, normals`` (M, 3) float32 [m, link frame]; ``weights`` (M,) float32 0..1: how rigidly it follows;
    ``first_point`` (L,) int64; ``origin`` (L, 3) float32 [m]; ``shape`` (L, 3) int64; ``cells_per_m`` (L,) float32;
    ``first_cell`` (L,) int64; ``nearest`` (C,) int16, see ``closest_point_grid``;
    ``low, high`` (L, 3) float32 [m, link frame]: box around the link's points; low > high when it has none;
    ``spacing2_m2`` (L,) float32 [m²]: mean squared distance of a link's point from its nearest neighbour;
    ``tints`` (M, 2) float32, or (0, 2): colours do not count.
    """

    points: Array
    normals: Array
    weights: Array
    first_point: Array
    origin: Array
    shape: Array
    cells_per_m: Array
    first_cell: Array
    nearest: Array
    low: Array
    high: Array
    spacing2_m2: Array
    tints: Array


@njit(nogil=True, cache=True, error_model="numpy")
def tints(colours: Array) -> Array:
    """Tints (N, 2) float32 of ``colours`` (N, 3) RGB 0..255: shares of red and green. They do not depend on how much
    light falls on a surface nor on the exposure, but for points that are nearly black."""
    out = np.empty((len(colours), 2), np.float32)
    for n in range(len(colours)):
        red, green, blue = float(colours[n, 0]), float(colours[n, 1]), float(colours[n, 2])
        brightness = red + green + blue + TINT_FLOOR
        out[n, 0] = (red + TINT_FLOOR / 3.0) / brightness
        out[n, 1] = (green + TINT_FLOOR / 3.0) / brightness
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def near_links(points: Array, R: Array, t: Array, surface: Surface, gate: float, near: Array) -> None:
    """Fills ``near`` (N, NEAR_LINKS) int8 with the links whose box, grown by the gate, holds the point; -1 ends."""
    near[:, 0] = -1
    fill = np.zeros(len(points), np.int64)
    for link in range(len(R)):
        if surface.low[link, 0] > surface.high[link, 0]:
            continue
        cx = 0.5 * (surface.low[link, 0] + surface.high[link, 0])
        cy = 0.5 * (surface.low[link, 1] + surface.high[link, 1])
        cz = 0.5 * (surface.low[link, 2] + surface.high[link, 2])
        hx = surface.high[link, 0] - cx + gate
        hy = surface.high[link, 1] - cy + gate
        hz = surface.high[link, 2] - cz + gate
        x = t[link, 0] + R[link, 0, 0] * cx + R[link, 0, 1] * cy + R[link, 0, 2] * cz
        y = t[link, 1] + R[link, 1, 0] * cx + R[link, 1, 1] * cy + R[link, 1, 2] * cz
        z = t[link, 2] + R[link, 2, 0] * cx + R[link, 2, 1] * cy + R[link, 2, 2] * cz
        for n in range(len(points)):
            dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
            if (
                abs(R[link, 0, 0] * dx + R[link, 1, 0] * dy + R[link, 2, 0] * dz) < hx
                and abs(R[link, 0, 1] * dx + R[link, 1, 1] * dy + R[link, 2, 1] * dz) < hy
                and abs(R[link, 0, 2] * dx + R[link, 1, 2] * dy + R[link, 2, 2] * dz) < hz
                and fill[n] < NEAR_LINKS
            ):
                near[n, fill[n]] = link
                fill[n] += 1
                if fill[n] < NEAR_LINKS:
                    near[n, fill[n]] = -1


@njit(nogil=True, cache=True, error_model="numpy")
def _closest_point(
    points: Array, normals: Array, tinted: Array, near: Array, n: int, R: Array, t: Array, surface: Surface
) -> tuple[int, int, np.float32]:
    """Of point n: link, row and squared distance [m²] of the closest compatible model point; link -1: there is none."""
    zero, tint2_m2 = (
        np.float32(0.0),
        np.float32(TINT_M * TINT_M),
    )  # single precision throughout: this is where the time goes
    best_link, best_point, best = -1, -1, np.float32(np.inf)
    for c in range(near.shape[1]):
        link = int(near[n, c])
        if link < 0:
            break
        dx, dy, dz = points[n, 0] - t[link, 0], points[n, 1] - t[link, 1], points[n, 2] - t[link, 2]
        qx = R[link, 0, 0] * dx + R[link, 1, 0] * dy + R[link, 2, 0] * dz
        qy = R[link, 0, 1] * dx + R[link, 1, 1] * dy + R[link, 2, 1] * dz
        qz = R[link, 0, 2] * dx + R[link, 1, 2] * dy + R[link, 2, 2] * dz
        ux = max(surface.low[link, 0] - qx, qx - surface.high[link, 0], zero)
        uy = max(surface.low[link, 1] - qy, qy - surface.high[link, 1], zero)
        uz = max(surface.low[link, 2] - qz, qz - surface.high[link, 2], zero)
        d = ux * ux + uy * uy + uz * uz  # from the box of the link's points: none of them can be closer
        if d >= best:
            continue
        mx = R[link, 0, 0] * normals[n, 0] + R[link, 1, 0] * normals[n, 1] + R[link, 2, 0] * normals[n, 2]
        my = R[link, 0, 1] * normals[n, 0] + R[link, 1, 1] * normals[n, 1] + R[link, 2, 1] * normals[n, 2]
        mz = R[link, 0, 2] * normals[n, 0] + R[link, 1, 2] * normals[n, 1] + R[link, 2, 2] * normals[n, 2]
        ax, ay, az = abs(mx), abs(my), abs(mz)
        if ax >= ay and ax >= az:
            side = 0 if mx > 0 else 1
        elif ay >= az:
            side = 2 if my > 0 else 3
        else:
            side = 4 if mz > 0 else 5
        nx, ny, nz = surface.shape[link, 0], surface.shape[link, 1], surface.shape[link, 2]
        cell = surface.cells_per_m[link]
        x = min(max(int((qx - surface.origin[link, 0]) * cell), 0), nx - 1)
        y = min(max(int((qy - surface.origin[link, 1]) * cell), 0), ny - 1)
        z = min(max(int((qz - surface.origin[link, 2]) * cell), 0), nz - 1)
        k = int(surface.nearest[surface.first_cell[link] + ((side * nx + x) * ny + y) * nz + z])
        if k < 0:
            continue
        k += surface.first_point[link]
        ex, ey, ez = qx - surface.points[k, 0], qy - surface.points[k, 1], qz - surface.points[k, 2]
        d = ex * ex + ey * ey + ez * ez
        if len(surface.tints):
            ex, ey = tinted[n, 0] - surface.tints[k, 0], tinted[n, 1] - surface.tints[k, 1]
            d += tint2_m2 * (ex * ex + ey * ey)
        if d >= best:
            continue
        if mx * surface.normals[k, 0] + my * surface.normals[k, 1] + mz * surface.normals[k, 2] < NORMAL_GATE:
            continue
        best_link, best_point, best = link, k, d
    return best_link, best_point, best


@njit(nogil=True, cache=True, error_model="numpy")
def match_points(
    points: Array,
    normals: Array,
    tinted: Array,
    near: Array,
    R: Array,
    t: Array,
    surface: Surface,
    link: Array,
    row: Array,
    d2: Array,
) -> None:
    """Closest compatible model point of every point (N, 3) with its normal (N, 3) and tint (N, 2): fills ``link`` (N,)
    int64 (-1: none), ``row`` (N,) int64 and the squared distance ``d2`` (N,) [m²], to which a difference in tint adds
    as if it were one in place; ``R, t``: link frames in the world, from ``forward``."""
    R32, t32 = R.astype(np.float32), t.astype(np.float32)
    for n in range(len(points)):
        link[n], row[n], d2[n] = _closest_point(points, normals, tinted, near, n, R32, t32, surface)
        for c in range(1, near.shape[1]):  # asked first next time: its short distance rules the other boxes out
            if near[n, c] < 0 or link[n] < 0:
                break
            if near[n, c] == link[n]:
                near[n, 0], near[n, c] = near[n, c], near[n, 0]
                break
