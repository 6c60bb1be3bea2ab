"""Points of a visual hull: inside it, for the particle filter, or on its surface, for trackers that fit a surface."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.geometry.point_cloud import PointCloud
from sender.reconstruction.visual_hull import NOBODY, HullLines, VisualHull

Floats = NDArray[np.float64]

POINTS_PER_LINE = 4  # in the volume: lines then lie about as far apart as the points on them
LINES_PER_POINT = 0.7  # on the surface: a line gives two points, or more, but some of its ends are nobody's
_WINDOW_PX = 3  # half the width over which an outline's direction is taken
_GREY = 128  # silhouettes tell no colour


def volume_points(hull: VisualHull, count: int) -> PointCloud:
    """``count`` points inside the hull, as many on each line of sight as it is long there (Rao §7, step 2d).

    The lines are those of the silhouette with most pixels, so the order of the cameras does not matter. Normals are
    zero: points inside a body have none; colours are grey. Empty when the hull is.
    """
    positions = _along(hull.lines(hull.largest, count // POINTS_PER_LINE), count)
    return _cloud(positions, np.zeros_like(positions))


def surface_points(hull: VisualHull, count: int) -> PointCloud:
    """At most ``count`` points on the hull's surface, where lines of sight of all cameras enter and leave it.

    Normals are the hull's own, unit and outwards: a silhouette's outline and its camera span the tangent plane.
    Colours are grey. Empty when the hull is.
    """
    found, makers = [np.zeros((0, 3))], [np.zeros(0, np.int8)]
    lines_each = max(round(LINES_PER_POINT * count / len(hull.cameras)), 1)
    for reference in sorted(range(len(hull.cameras)), key=lambda index: hull.cameras[index].name):
        lines = hull.lines(reference, lines_each)
        interval, end = np.nonzero(lines.made_by != NOBODY)
        depths = lines.depths[interval, end]
        found.append(lines.origin + lines.directions[lines.line[interval]] * depths[:, None])
        makers.append(lines.made_by[interval, end])
    positions, made_by = np.concatenate(found), np.concatenate(makers)
    if len(positions) > count:
        chosen = np.arange(count) * len(positions) // count
        positions, made_by = positions[chosen], made_by[chosen]
    normals = _tangent_normals(positions, made_by, hull.T_camera_world, hull.lenses, hull.masks, hull.sizes, _WINDOW_PX)
    real = np.abs(normals).sum(axis=1) > 0
    return _cloud(positions[real], normals[real])


def _along(lines: HullLines, count: int) -> Floats:
    """``count`` points (N, 3) at equal distances along all intervals, as if they were one line."""
    lengths = lines.lengths_m()
    if len(lengths) == 0 or not lengths.sum() > 0:
        return np.zeros((0, 3))
    ends = np.cumsum(lengths)
    places = (np.arange(count) + 0.5) * (ends[-1] / count)
    interval = np.minimum(np.searchsorted(ends, places), len(ends) - 1)
    share = 1 - (ends[interval] - places) / np.maximum(lengths[interval], 1e-12)
    start, end = lines.depths[interval].T
    depths = start + (end - start) * np.clip(share, 0.0, 1.0)
    return np.asarray(lines.origin + lines.directions[lines.line[interval]] * depths[:, None], np.float64)


@njit(nogil=True, cache=True, error_model="numpy")
def _tangent_normals(points, made_by, T_camera_world, lenses, masks, sizes, reach):  # type: ignore[no-untyped-def]
    """Unit normals (N, 3) [world], outwards, of the planes through the camera that made each point and its outline
    there; zero where no outline is near.

    With the outline's outward direction g in the image, from p: the plane g·(project(X) − p) = 0, multiplied by X_z.
    """
    out = np.zeros((len(points), 3))
    for row in range(len(points)):
        camera = made_by[row]
        T = T_camera_world[camera]
        x = T[0, 0] * points[row, 0] + T[0, 1] * points[row, 1] + T[0, 2] * points[row, 2] + T[0, 3]
        y = T[1, 0] * points[row, 0] + T[1, 1] * points[row, 1] + T[1, 2] * points[row, 2] + T[1, 3]
        z = T[2, 0] * points[row, 0] + T[2, 1] * points[row, 1] + T[2, 2] * points[row, 2] + T[2, 3]
        fx, fy, cx, cy = lenses[camera]
        u, v = fx * x / z + cx, fy * y / z + cy
        column, line = int(u + 0.5), int(v + 0.5)
        gx, gy = 0.0, 0.0
        for i in range(max(line - reach, 0), min(line + reach + 1, sizes[camera, 1])):
            for j in range(max(column - reach, 0), min(column + reach + 1, sizes[camera, 0])):
                if masks[camera, i, j] == 0:
                    gx += j - column
                    gy += i - line
        nx, ny, nz = fx * gx, fy * gy, gx * (cx - u) + gy * (cy - v)
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length > 0.0:
            for axis in range(3):
                out[row, axis] = (T[0, axis] * nx + T[1, axis] * ny + T[2, axis] * nz) / length
    return out


def _cloud(positions: Floats, normals: Floats) -> PointCloud:
    colours = np.full((len(positions), 3), _GREY, np.uint8)
    return PointCloud(np.ascontiguousarray(positions, np.float32), np.ascontiguousarray(normals, np.float32), colours)
