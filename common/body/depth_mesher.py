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
from common.geometry.camera_model import Camera
from common.geometry.rigid_transform import transform_points
from common.geometry.triangle_mesh import TriangleMesh

SMOOTHING_RADIUS_PIXELS = 2
SMOOTHING_RANGE_MM = 50.0  # depths further apart belong to different surfaces; a sensor's steps are smaller
# A pixel is an area: the person goes on beyond the middle of the outermost ones. Measured: 0.3 gives the best
# silhouettes and pictures, 0.5 carries surfaces that turn away too far out.
OUTLINE_PIXELS = 0.3


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
    index, grid_depth, pixels = _grid_vertices(depth, stride, np.float32(OUTLINE_PIXELS))
    rays = _rays(view.camera, pixels + np.array([view.u0, view.v0], np.float32))
    depths_m = grid_depth[index >= 0] * np.float32(1e-3)
    vertices = transform_points(view.camera.T_world_camera, rays * depths_m[:, None])
    size = np.array(depth.shape[::-1], np.float32)
    uv = (np.clip(pixels, 0, size - 1) + np.float32(0.5)) / size
    return TriangleMesh(vertices, _grid_faces(grid_depth, index), uv, view.colour)


def smooth_depth(depth_mm: NDArray[np.uint16], radius: int, range_mm: float) -> NDArray[np.float32]:
    """Depth (h, w) float32 [mm], 0 stays 0: mean of each pixel and the opposite pairs of neighbours within ``radius``.

    A bilateral filter with box weights: both ends of a pair count if their depths, and their mean, are within
    ``range_mm`` of the pixel's. Pairs leave slopes where they are, also beside an outline, where a one-sided mean
    would pull the surface towards the camera; the mask is not eroded.
    """
    return _smooth(depth_mm, radius, np.float32(range_mm))


def _rays(camera: Camera, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Viewing rays (V, 3) float32, camera frame, z = 1, of pixels (V, 2)."""
    rays = np.ones((len(pixels), 3), np.float32)
    if camera.distortion.any() and len(pixels):
        undistorted = cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.matrix, camera.distortion)
        rays[:, :2] = undistorted.reshape(-1, 2)
    else:
        centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
        rays[:, :2] = (pixels - centre) / focal
    return rays


@njit(nogil=True, cache=True, error_model="numpy")
def _smooth(depth_mm, radius, range_mm):  # type: ignore[no-untyped-def]
    """Row by row and pair by pair: the innermost loop, over the columns, is one the compiler can vectorise."""
    h, w = depth_mm.shape
    depth = depth_mm.astype(np.float32)
    out = np.zeros((h, w), np.float32)
    count = np.empty(w, np.float32)
    for y in range(h):
        centre, total = depth[y], out[y]
        total[:] = centre
        count[:] = np.float32(1.0)
        for j in range(min(radius, y, h - 1 - y) + 1):
            above, below = depth[y - j], depth[y + j]
            for i in range(-radius if j > 0 else 1, radius + 1):
                m = abs(i)
                _add_pairs(
                    centre[m : w - m], above[m - i : w - m - i], below[m + i : w - m + i], range_mm,
                    total[m : w - m], count[m : w - m],
                )  # fmt: skip
        for x in range(w):
            total[x] = total[x] / count[x] if centre[x] > 0 else np.float32(0.0)
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _add_pairs(centre, above, below, range_mm, total, count):  # type: ignore[no-untyped-def]
    """A row's pairs of one direction, each added to the pixel between if it is near; the background, 0, never is."""
    for x in range(len(centre)):
        z, a, b = centre[x], above[x], below[x]
        near = (abs(a - z) <= range_mm) & (abs(b - z) <= range_mm) & (abs(a + b - 2 * z) <= range_mm)
        total[x] += a + b if near else np.float32(0.0)
        count[x] += np.float32(2.0) if near else np.float32(0.0)


@njit(nogil=True, cache=True, error_model="numpy")
def _grid_vertices(depth, stride, outline):  # type: ignore[no-untyped-def]
    """Per square its vertex number (-1 = none) and depth; per vertex its column and row, moved out by ``outline``."""
    rows, columns = (depth.shape[0] + stride - 1) // stride, (depth.shape[1] + stride - 1) // stride
    covered = _covered_squares(depth, stride, rows, columns)
    index = np.full((rows, columns), -1, np.int32)
    grid_depth = np.zeros((rows, columns), np.float32)
    pixels = np.empty((rows * columns, 2), np.float32)
    count = 0
    for r in range(rows):
        for c in range(columns):
            if not covered[r + 1, c + 1]:
                continue
            right = np.int64(covered[r + 1, c]) - np.int64(covered[r + 1, c + 2])  # 1: nothing further right, -1: left
            down = np.int64(covered[r, c + 1]) - np.int64(covered[r + 2, c + 1])
            y, x = _outermost(depth, r * stride, c * stride, stride, down, right)
            pixels[count, 0], pixels[count, 1] = x + outline * right, y + outline * down
            grid_depth[r, c] = depth[y, x]
            index[r, c] = count
            count += 1
    return index, grid_depth, pixels[:count].copy()


@njit(nogil=True, cache=True, error_model="numpy")
def _covered_squares(depth, stride, rows, columns):  # type: ignore[no-untyped-def]
    """Whether a square holds foreground, with a border of squares that do not."""
    covered = np.zeros((rows + 2, columns + 2), np.bool_)
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            if depth[y, x] > 0:
                covered[y // stride + 1, x // stride + 1] = True
    return covered


@njit(nogil=True, cache=True, error_model="numpy")
def _outermost(depth, top, left, stride, down, right):  # type: ignore[no-untyped-def]
    """Row and column of a covered square's foreground pixel that is furthest ``down`` and ``right`` (1, 0 or -1)."""
    found = top, left
    furthest = -4 * stride
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
