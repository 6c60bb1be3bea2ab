"""Matches points of a cloud with the surface of a posed body, by the links' closest-point grids.

Link after link: what a link needs stays at hand while all points near it are looked up. Links compete for a point by
distance, and by colour: a hand before a chest is told from it by its skin.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

NORMAL_GATE = 0.35  # least cosine between the normals of a point and its match
TINT_M = 0.15  # a match whose tint differs by 1 counts as this far away: skin and cloth (0.1 to 0.2) as 2 to 3 cm
TINT_FLOOR = 40.0  # grey levels added to a colour's brightness: dark points have no tint worth the name


class Surface(NamedTuple):
    """The body's points and grids, all links one after the other (L links, M points, C grid cells).

    ``points, normals`` (M, 3) float32 [m, link frame]; ``first_point`` (L,) int64; ``origin`` (L, 3) float32 [m];
    ``shape`` (L, 3) int64; ``cells_per_m`` (L,) float32; ``first_cell`` (L,) int64; ``nearest`` (C,) int16, see
    ``closest_point_grid``; ``low, high`` (L, 3) float32 [m, link frame]: box around the link's points; low > high when
    it has none; ``spacing2_m2`` (L,) float32 [m²]: mean squared distance of a link's point from its nearest neighbour;
    ``tints`` (M, 2) float32, or (0, 2): colours do not count.
    """

    points: Array
    normals: Array
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
def near_links(points: Array, R: Array, t: Array, surface: Surface, gate: float) -> tuple[Array, Array]:
    """Which points (N, 3) lie in a link's box grown by ``gate`` [m]: ``first`` (L+1,) int64 and ``members`` int32, so
    that ``members[first[l] : first[l + 1]]`` are those of link l. ``R, t``: link frames in the world."""
    first = np.empty(len(R) + 1, np.int64)
    members = np.empty(len(points) * len(R) + 1, np.int32)
    R32, t32, g = R.astype(np.float32), t.astype(np.float32), np.float32(gate)
    half, fill = np.float32(0.5), 0
    for link in range(len(R)):
        first[link] = fill
        if surface.low[link, 0] > surface.high[link, 0]:
            continue
        Q = R32[link]
        centre = half * (surface.low[link] + surface.high[link])
        h = surface.high[link] - centre + g
        x = t32[link, 0] + Q[0, 0] * centre[0] + Q[0, 1] * centre[1] + Q[0, 2] * centre[2]
        y = t32[link, 1] + Q[1, 0] * centre[0] + Q[1, 1] * centre[1] + Q[1, 2] * centre[2]
        z = t32[link, 2] + Q[2, 0] * centre[0] + Q[2, 1] * centre[1] + Q[2, 2] * centre[2]
        for n in range(len(points)):
            dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
            inside = abs(Q[0, 0] * dx + Q[1, 0] * dy + Q[2, 0] * dz) < h[0]
            inside &= abs(Q[0, 1] * dx + Q[1, 1] * dy + Q[2, 1] * dz) < h[1]
            inside &= abs(Q[0, 2] * dx + Q[1, 2] * dy + Q[2, 2] * dz) < h[2]
            members[fill] = n
            fill += inside  # no branch: which of them are inside cannot be predicted
    first[len(R)] = fill
    return first, members[:fill]


@njit(nogil=True, cache=True, error_model="numpy")
def all_near(count: int, links: Array, link_count: int) -> tuple[Array, Array]:
    """As ``near_links``, when all ``count`` points are near ``links`` and no other."""
    first = np.zeros(link_count + 1, np.int64)
    for link in links:
        first[link + 1 :] += count
    members = np.empty(count * len(links), np.int32)
    for n in range(len(members)):
        members[n] = n % count
    return first, members


@njit(nogil=True, cache=True, error_model="numpy")
def match_points(
    points: Array,
    normals: Array,
    tinted: Array,
    first: Array,
    members: Array,
    R: Array,
    t: Array,
    surface: Surface,
    link: Array,
    row: Array,
    d2: Array,
) -> None:
    """Closest compatible model point of every point (N, 3) with its normal (N, 3) and tint (N, 2), all float32: fills
    ``link`` (N,) int64 (-1: none), ``row`` (N,) int64 and the squared distance ``d2`` (N,) [m²], to which a difference
    in tint adds as if it were one in place. ``first, members``: from ``near_links``; ``R, t``: link frames in the
    world, from ``forward``."""
    link[:], d2[:] = -1, np.inf
    R32, t32 = R.astype(np.float32), t.astype(np.float32)
    for c in range(len(R)):
        if first[c] < first[c + 1]:
            near = members[first[c] : first[c + 1]]
            _match_link(points, normals, tinted, near, c, R32[c], t32[c], surface, link, row, d2)


@njit(nogil=True, cache=True, error_model="numpy")
def _match_link(
    points: Array,
    normals: Array,
    tinted: Array,
    near: Array,
    c: int,
    R: Array,
    t: Array,
    surface: Surface,
    link: Array,
    row: Array,
    d2: Array,
) -> None:
    """Gives link c those of the points ``near`` it that it is closer to than any link before."""
    zero, tint2_m2, gate = np.float32(0.0), np.float32(TINT_M * TINT_M), np.float32(NORMAL_GATE)
    low, high, origin, size = surface.low[c], surface.high[c], surface.origin[c], surface.shape[c]
    cells_per_m, first_cell, first_point = surface.cells_per_m[c], surface.first_cell[c], surface.first_point[c]
    for n in near:
        dx, dy, dz = points[n, 0] - t[0], points[n, 1] - t[1], points[n, 2] - t[2]
        qx = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
        qy = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
        qz = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        ux = max(low[0] - qx, qx - high[0], zero)
        uy = max(low[1] - qy, qy - high[1], zero)
        uz = max(low[2] - qz, qz - high[2], zero)
        if ux * ux + uy * uy + uz * uz >= d2[n]:
            continue  # from the box of the link's points: none of them can be closer
        mx = R[0, 0] * normals[n, 0] + R[1, 0] * normals[n, 1] + R[2, 0] * normals[n, 2]
        my = R[0, 1] * normals[n, 0] + R[1, 1] * normals[n, 1] + R[2, 1] * normals[n, 2]
        mz = R[0, 2] * normals[n, 0] + R[1, 2] * normals[n, 1] + R[2, 2] * normals[n, 2]
        side, most = int(mx <= 0), abs(mx)
        if abs(my) > most:
            side, most = 2 + int(my <= 0), abs(my)
        if abs(mz) > most:
            side = 4 + int(mz <= 0)
        x = min(max(int((qx - origin[0]) * cells_per_m), 0), size[0] - 1)
        y = min(max(int((qy - origin[1]) * cells_per_m), 0), size[1] - 1)
        z = min(max(int((qz - origin[2]) * cells_per_m), 0), size[2] - 1)
        k = int(surface.nearest[first_cell + ((side * size[0] + x) * size[1] + y) * size[2] + z])
        if k < 0:
            continue
        k += first_point
        ex, ey, ez = qx - surface.points[k, 0], qy - surface.points[k, 1], qz - surface.points[k, 2]
        d = ex * ex + ey * ey + ez * ez
        if len(surface.tints):
            ex, ey = tinted[n, 0] - surface.tints[k, 0], tinted[n, 1] - surface.tints[k, 1]
            d += tint2_m2 * (ex * ex + ey * ey)
        alike = mx * surface.normals[k, 0] + my * surface.normals[k, 1] + mz * surface.normals[k, 2]
        if d < d2[n] and alike >= gate:
            link[n], row[n], d2[n] = c, k, d
