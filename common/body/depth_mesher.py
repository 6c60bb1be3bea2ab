"""Depth view → triangle mesh: neighbouring foreground pixels are joined whatever the distance between them.

DISPOSE §5.2: without a distance test an occlusion shows as triangles that stretch, and the distortion score sees it.
The background is gone before, so a person is never meshed with it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.view import View
from common.geometry.triangle_mesh import TriangleMesh

SMOOTHING_RADIUS_PIXELS = 2
SMOOTHING_RANGE_MM = 50.0  # depths further apart belong to different surfaces; a sensor's steps are smaller
# A pixel is an area: the person goes on beyond the middle of the outermost ones. Measured: 0.3 gives the best
# silhouettes and pictures, 0.5 carries surfaces that turn away too far out.
OUTLINE_PIXELS = 0.3
_BAND_ROWS = 8


def mesh_view(view: View, stride: int = 1) -> TriangleMesh:
    """Mesh one view's foreground: one vertex in every square of ``stride`` pixels; the texture is the view's colour.

    Vertices (V, 3) float32 [m, world], square by square in rows; triangles face the camera. V and F are 0 for an
    empty view. Depth is smoothed within surfaces at full resolution. At the outline the square's outermost
    foreground pixel is taken: a coarser grid keeps the silhouette, and thin parts.

    Raises:
        ValueError: a stride below 1.
    """
    if stride < 1:
        raise ValueError(f"stride {stride} is below 1")
    depth = smooth_depth(view.depth_mm, SMOOTHING_RADIUS_PIXELS, SMOOTHING_RANGE_MM)
    index, grid_depth, pixels, depths_mm = _grid_vertices(depth, stride, np.float32(OUTLINE_PIXELS))
    to_world, ideal = _to_world(view), _undistorted(view, pixels)
    vertices, uv = _placed(pixels, ideal, depths_mm, to_world, *depth.shape)
    return TriangleMesh(vertices, _grid_faces(grid_depth, index), uv, view.colour)


def smooth_depth(depth_mm: NDArray[np.uint16], radius: int, range_mm: float) -> NDArray[np.float32]:
    """Depth (h, w) float32 [mm], 0 stays 0: mean of each pixel and the opposite pairs of neighbours within ``radius``.

    A bilateral filter with box weights: both ends of a pair count if their depths, and their mean, are within
    ``range_mm`` of the pixel's. Pairs leave slopes where they are, also beside an outline, where a one-sided mean
    would pull the surface towards the camera; the mask is not eroded.
    """
    return _smooth(depth_mm, radius, np.float32(range_mm))


def _to_world(view: View) -> NDArray[np.float32]:
    """Rows (3, 4): a pixel (column, row, 1) of the crop, times its depth, and 1 → world [m, for depths in mm]."""
    camera = view.camera
    rays = np.array(
        [
            [1 / camera.fx, 0, (view.u0 - camera.cx) / camera.fx],
            [0, 1 / camera.fy, (view.v0 - camera.cy) / camera.fy],
            [0, 0, 1],
        ]
    )
    T = camera.T_world_camera[:3]
    return np.concatenate([1e-3 * T[:, :3] @ rays, T[:, 3:]], axis=1).astype(np.float32)


def _undistorted(view: View, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Where pixels (V, 2) of the crop would be without the camera's distortion."""
    camera = view.camera
    if not camera.distortion.any() or not len(pixels):
        return pixels
    corner = np.array([view.u0, view.v0], np.float32)
    K = camera.matrix
    straight = cv2.undistortPoints((pixels + corner).reshape(-1, 1, 2), K, camera.distortion, P=K)
    return straight.reshape(-1, 2).astype(np.float32) - corner


@njit(nogil=True, cache=True, error_model="numpy")
def _placed(pixels, ideal, depths_mm, to_world, height, width):  # type: ignore[no-untyped-def]
    """Vertices (V, 3) [m, world] and texture coordinates (V, 2) of pixels (V, 2), without distortion at ``ideal``."""
    vertices, uv = np.empty((len(pixels), 3), np.float32), np.empty_like(pixels)
    right, bottom, half = np.float32(width - 1), np.float32(height - 1), np.float32(0.5)
    for v in range(len(pixels)):
        z = depths_mm[v]
        x, y = ideal[v, 0] * z, ideal[v, 1] * z
        for i in range(3):
            vertices[v, i] = to_world[i, 0] * x + to_world[i, 1] * y + to_world[i, 2] * z + to_world[i, 3]
        uv[v, 0] = (min(max(pixels[v, 0], np.float32(0)), right) + half) / np.float32(width)
        uv[v, 1] = (min(max(pixels[v, 1], np.float32(0)), bottom) + half) / np.float32(height)
    return vertices, uv


@njit(nogil=True, cache=True, error_model="numpy")
def _smooth(depth_mm, radius, range_mm):  # type: ignore[no-untyped-def]
    """Band by band, of its columns in which there is anybody, and pair by pair: the innermost loop, over a band as one
    row, is one the compiler can vectorise. What it adds up in the margins at both sides is of no row and cut off."""
    h, w = depth_mm.shape
    margin, out = radius + 1, np.zeros((h, w), np.float32)
    room = np.empty((_BAND_ROWS + 2 * margin) * (w + 2 * radius), np.float32)
    totals, counts = np.empty(len(room), np.float32), np.empty(len(room), np.float32)
    for top in range(0, h, _BAND_ROWS):
        rows = min(_BAND_ROWS, h - top)
        left, right = _occupied(depth_mm[top : top + rows])
        if left == right:
            continue
        columns = right - left + 2 * radius
        depth = room[: (rows + 2 * margin) * columns]
        _cut_out(depth_mm, top - margin, left - radius, depth.reshape(rows + 2 * margin, columns))
        start, end = margin * columns, (margin + rows) * columns
        centre, total, count = depth[start:end], totals[: end - start], counts[: end - start]
        total[:] = centre
        count[:] = np.float32(1.0)
        for j in range(radius + 1):
            for i in range(-radius if j > 0 else 1, radius + 1):
                off = j * columns + i
                _add_pairs(
                    centre, depth[start - off : end - off], depth[start + off : end + off], range_mm, total, count
                )
        for p in range(end - start):
            total[p] = total[p] / count[p] if centre[p] > 0 else np.float32(0.0)
        out[top : top + rows, left:right] = total.reshape(rows, columns)[:, radius : columns - radius]
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _occupied(depth_mm):  # type: ignore[no-untyped-def]
    """From the first column with a reading to the one after the last; two of the same where there is none."""
    h, w = depth_mm.shape
    left, right = w, 0
    for v in range(h):
        for u in range(left):
            if depth_mm[v, u]:
                left = u
                break
        for u in range(w - 1, right - 1, -1):
            if depth_mm[v, u]:
                right = u + 1
                break
    return min(left, right), right


@njit(nogil=True, cache=True, error_model="numpy")
def _cut_out(depth_mm, top, left, out):  # type: ignore[no-untyped-def]
    """``depth_mm`` from ``top`` and ``left`` on, 0 beyond its edges."""
    h, w = depth_mm.shape
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            y, x = top + v, left + u
            inside = 0 <= y < h and 0 <= x < w
            out[v, u] = np.float32(depth_mm[y, x]) if inside else np.float32(0.0)


@njit(nogil=True, cache=True, error_model="numpy")
def _add_pairs(centre, above, below, range_mm, total, count):  # type: ignore[no-untyped-def]
    """Pairs of one direction, each added to the pixel between if it is near; the background, 0, never is."""
    for p in range(len(centre)):
        z, a, b = centre[p], above[p], below[p]
        near = (abs(a - z) <= range_mm) & (abs(b - z) <= range_mm) & (abs(a + b - np.float32(2.0) * z) <= range_mm)
        total[p] += a + b if near else np.float32(0.0)
        count[p] += np.float32(2.0) if near else np.float32(0.0)


@njit(nogil=True, cache=True, error_model="numpy")
def _grid_vertices(depth, stride, outline):  # type: ignore[no-untyped-def]
    """Per square its vertex number (-1 = none) and depth; per vertex its column and row, moved out by ``outline``, and
    its depth."""
    rows, columns = (depth.shape[0] + stride - 1) // stride, (depth.shape[1] + stride - 1) // stride
    covered = _covered_squares(depth, stride, rows, columns)
    index = np.full((rows, columns), -1, np.int32)
    grid_depth = np.zeros((rows, columns), np.float32)
    pixels, depths = np.empty((rows * columns, 2), np.float32), np.empty(rows * columns, np.float32)
    count = 0
    for r in range(rows):
        for c in range(columns):
            if not covered[r + 1, c + 1]:
                continue
            right = np.int64(covered[r + 1, c]) - np.int64(covered[r + 1, c + 2])  # 1: nothing further right, -1: left
            down = np.int64(covered[r, c + 1]) - np.int64(covered[r + 2, c + 1])
            y, x = _outermost(depth, r * stride, c * stride, stride, down, right)
            pixels[count, 0], pixels[count, 1] = x + outline * right, y + outline * down
            grid_depth[r, c] = depths[count] = depth[y, x]
            index[r, c] = count
            count += 1
    return index, grid_depth, pixels[:count].copy(), depths[:count].copy()


@njit(nogil=True, cache=True, error_model="numpy")
def _covered_squares(depth, stride, rows, columns):  # type: ignore[no-untyped-def]
    """Whether a square holds foreground, with a border of squares that do not."""
    covered = np.zeros((rows + 2, columns + 2), np.bool_)
    deepest = np.empty(columns * stride, np.float32)
    for r in range(rows):
        deepest[:] = 0
        for y in range(r * stride, min((r + 1) * stride, depth.shape[0])):
            for x in range(depth.shape[1]):
                deepest[x] = max(deepest[x], depth[y, x])
        for c in range(columns):
            for x in range(c * stride, (c + 1) * stride):
                covered[r + 1, c + 1] |= deepest[x] > 0
    return covered


@njit(nogil=True, cache=True, error_model="numpy")
def _outermost(depth, top, left, stride, down, right):  # type: ignore[no-untyped-def]
    """Row and column of a covered square's foreground pixel that is furthest ``down`` and ``right`` (1, 0 or -1)."""
    found = top, left
    furthest = -4 * stride
    if down == 0 and right == 0 and depth[top, left] > 0:
        return found
    for y in range(top, min(top + stride, depth.shape[0])):
        for x in range(left, min(left + stride, depth.shape[1])):
            if depth[y, x] > 0 and down * (y - top) + right * (x - left) > furthest:
                furthest = down * (y - top) + right * (x - left)
                found = y, x
    return found


@njit(nogil=True, cache=True, error_model="numpy")
def _grid_faces(depth, index):  # type: ignore[no-untyped-def]
    """Triangles (F, 3) of each 2×2 cell with three or four vertices; four are cut along the flatter diagonal."""
    rows, columns = index.shape
    faces = np.empty((2 * rows * columns, 3), np.int32)
    count = 0
    for r in range(rows - 1):
        for c in range(columns - 1):
            a, b = index[r, c], index[r, c + 1]
            d, e = index[r + 1, c], index[r + 1, c + 1]
            present = int(a >= 0) + int(b >= 0) + int(d >= 0) + int(e >= 0)
            if present < 3:
                continue
            falling = abs(depth[r, c] - depth[r + 1, c + 1])
            rising = abs(depth[r, c + 1] - depth[r + 1, c])
            if b < 0 or d < 0 or (present == 4 and falling <= rising):  # cut a–e: drop b's or d's triangle if absent
                if d >= 0:
                    faces[count, 0], faces[count, 1], faces[count, 2] = a, d, e
                    count += 1
                if b >= 0:
                    faces[count, 0], faces[count, 1], faces[count, 2] = a, e, b
                    count += 1
            else:
                if a >= 0:
                    faces[count, 0], faces[count, 1], faces[count, 2] = a, d, b
                    count += 1
                if e >= 0:
                    faces[count, 0], faces[count, 1], faces[count, 2] = b, d, e
                    count += 1
    return faces[:count].copy()
