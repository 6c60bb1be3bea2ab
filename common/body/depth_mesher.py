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
SMOOTHING_RANGE_MM = 30.0  # depths further apart belong to different surfaces
BORDER_SHIFT_PIXELS = 0.5  # a pixel is an area: the outline runs along its rim, not through its centre


def mesh_view(view: View, stride: int = 1) -> TriangleMesh:
    """Mesh one view's foreground, ``stride`` pixels between neighbouring vertices; colours are the pixels'.

    Vertices (V, 3) float32 [m, world], V = foreground pixels on the stride grid; triangles face the camera. V and F
    are 0 for an empty view. Depth is smoothed within surfaces only; no foreground pixel is lost.

    Raises:
        ValueError: a stride below 1.
    """
    if stride < 1:
        raise ValueError(f"stride {stride} is below 1")
    depth = smooth_depth(view.depth_mm, SMOOTHING_RADIUS_PIXELS, SMOOTHING_RANGE_MM)
    pixels, index = _grid_vertices(depth, stride, BORDER_SHIFT_PIXELS)
    rows, columns = np.nonzero(index >= 0)
    faces = _grid_faces(depth, index, stride)
    rays = _rays(view.camera, pixels + np.array([view.u0, view.v0], np.float32))
    points = rays * (depth[rows * stride, columns * stride, None] * np.float32(1e-3))
    colours = np.ascontiguousarray(view.colour[rows * stride, columns * stride])
    return TriangleMesh(transform_points(view.camera.T_world_camera, points), faces, colours)


def smooth_depth(depth_mm: NDArray[np.uint16], radius: int, range_mm: float) -> NDArray[np.float32]:
    """Mean (h, w) float32 [mm] of the pixels within ``radius`` whose depth is within ``range_mm``; 0 stays 0.

    Lee's sigma filter: the two box weights of a bilateral filter. It averages noise away without joining
    surfaces, and the mask keeps its outline.
    """
    return _smooth(depth_mm, radius, np.float32(range_mm))


def _rays(camera: Camera, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Viewing rays (V, 3) float32, camera frame, z = 1, of pixels (V, 2)."""
    if len(pixels) == 0:
        return np.zeros((0, 3), np.float32)
    xy = cv2.undistortPoints(pixels.reshape(-1, 1, 2), camera.matrix, camera.distortion if camera.distortion.any() else None)
    return np.concatenate([xy.reshape(-1, 2), np.ones((len(pixels), 1), np.float32)], axis=1)


@njit(nogil=True, cache=True, error_model="numpy")
def _smooth(depth_mm, radius, range_mm):  # type: ignore[no-untyped-def]
    h, w = depth_mm.shape
    out = np.zeros((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            centre = np.float32(depth_mm[y, x])
            if centre == 0:
                continue
            total, count = np.float32(0.0), np.float32(0.0)
            for j in range(max(0, y - radius), min(h, y + radius + 1)):
                for i in range(max(0, x - radius), min(w, x + radius + 1)):
                    d = np.float32(depth_mm[j, i])
                    near = np.float32(abs(d - centre) <= range_mm)  # the background, 0, is never near
                    total += near * d
                    count += near
            out[y, x] = total / count
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _grid_vertices(depth, stride, shift):  # type: ignore[no-untyped-def]
    """Pixel positions (V, 2) of the vertices, outline pixels moved outwards, and their grid of indices (-1 = none)."""
    h, w = depth.shape
    rows, columns = (h + stride - 1) // stride, (w + stride - 1) // stride
    index = np.full((rows, columns), -1, np.int32)
    pixels = np.empty((rows * columns, 2), np.float32)
    count = 0
    for r in range(rows):
        for c in range(columns):
            y, x = r * stride, c * stride
            if depth[y, x] == 0:
                continue
            left = x > 0 and depth[y, x - 1] > 0
            right = x + 1 < w and depth[y, x + 1] > 0
            up = y > 0 and depth[y - 1, x] > 0
            down = y + 1 < h and depth[y + 1, x] > 0
            pixels[count, 0] = x + shift * (np.float32(left) - np.float32(right))
            pixels[count, 1] = y + shift * (np.float32(up) - np.float32(down))
            index[r, c] = count
            count += 1
    return pixels[:count].copy(), index


@njit(nogil=True, cache=True, error_model="numpy")
def _grid_faces(depth, index, stride):  # type: ignore[no-untyped-def]
    """Triangles (F, 3) of each 2×2 cell with three or four vertices; four are cut along the flatter diagonal."""
    rows, columns = index.shape
    faces = np.empty((2 * rows * columns, 3), np.int32)
    count = 0
    for r in range(rows - 1):
        for c in range(columns - 1):
            a, b = index[r, c], index[r, c + 1]
            d, e = index[r + 1, c], index[r + 1, c + 1]
            present = (a >= 0) + (b >= 0) + (d >= 0) + (e >= 0)
            if present < 3:
                continue
            y, x = r * stride, c * stride
            falling = abs(depth[y, x] - depth[y + stride, x + stride])
            rising = abs(depth[y, x + stride] - depth[y + stride, x])
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
