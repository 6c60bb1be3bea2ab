"""Several views' images as squares of the mesh: which vertex stands in each, and in which each view has any vertex.

So a vertex finds what another view has in its place by a look, not a search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.view import View
from common.geometry.camera_model import project
from common.geometry.rigid_transform import inverse
from common.geometry.triangle_mesh import TriangleMesh

WINDOW = 2  # squares around a vertex's that may be looked at: the images have so many more beyond, twice
_MARGIN = 2 * WINDOW


@dataclass(frozen=True, slots=True, eq=False)
class ViewSquares:
    """``at`` (Q,) int32: the vertex in each square, -1 where there is none, flat, rows of one view after the other;
    each image has a margin, so that of a square in it or beside it those ``WINDOW`` away are there.
    ``columns`` (N,) int32: from a square to that below, by view. ``square`` (N, V) int32: where each view has each
    vertex, -1 = farther beside its image or behind it. ``own`` (V,) int32: the square each vertex was made of.
    ``view_of`` (V,) int32: the view it was made of. ``size_m`` (V,) float32: that square's size there [m]."""

    at: NDArray[np.int32]
    columns: NDArray[np.int32]
    square: NDArray[np.int32]
    own: NDArray[np.int32]
    view_of: NDArray[np.int32]
    size_m: NDArray[np.float32]

    def only(self, mask: NDArray[np.bool_]) -> NDArray[np.int32]:
        """``at`` with no others than the vertices of ``mask`` (V,)."""
        chosen = np.flatnonzero(mask).astype(np.int32)
        at = np.full(len(self.at), -1, np.int32)
        at[self.own[chosen]] = chosen
        return at


def view_squares(
    vertices: NDArray[np.float32], meshes: Sequence[TriangleMesh], views: Sequence[View], stride: int
) -> ViewSquares:
    """Squares of the views whose ``meshes`` (``mesh_view`` with ``stride``) have ``vertices`` (V, 3) [m, world], one
    after the other."""
    counts = [len(mesh.vertices) for mesh in meshes]
    shapes = [tuple(-(-side // stride) + 2 * _MARGIN for side in view.depth_mm.shape) for view in views]
    starts = np.cumsum([0, *(rows * columns for rows, columns in shapes)])
    at = np.full(starts[-1], -1, np.int32)
    square = np.empty((len(views), len(vertices)), np.int32)
    own, size_m = np.empty(len(vertices), np.int32), np.empty(len(vertices), np.float32)
    first = 0
    for index, (view, mesh) in enumerate(zip(views, meshes, strict=True)):
        made = slice(first, first + counts[index])
        (height, width), (rows, columns) = view.depth_mm.shape, shapes[index]
        pixels, depths = pixels_in(view, vertices)
        _enter(pixels, depths, stride, starts[index], rows, columns, square[index])
        _enter_own(mesh.uv, height, width, stride, starts[index], columns, own[made])
        at[own[made]] = np.arange(made.start, made.stop, dtype=np.int32)
        size_m[made] = depths[made] * np.float32(stride / view.camera.fx)
        first = made.stop
    view_of = np.repeat(np.arange(len(views), dtype=np.int32), counts)
    return ViewSquares(at, np.array([columns for _, columns in shapes], np.int32), square, own, view_of, size_m)


def pixels_in(view: View, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixels (V, 2) of the view's crop and depths (V,) [m] of world points (V, 3); depth <= 0: behind the camera."""
    camera = view.camera
    if camera.distortion.any() and len(points):
        pixels, depths = project(camera, points)
        return (pixels - [view.u0, view.v0]).astype(np.float32), depths.astype(np.float32)
    to_image = camera.matrix @ inverse(camera.T_world_camera)[:3]
    to_image[:2] -= np.outer([view.u0, view.v0], to_image[2])
    return _project(points, to_image.astype(np.float32))


@njit(nogil=True, cache=True, error_model="numpy")
def _project(points, to_image):  # type: ignore[no-untyped-def]
    pixels, depths = np.empty((len(points), 2), np.float32), np.empty(len(points), np.float32)
    for v in range(len(points)):
        x, y, z = points[v, 0], points[v, 1], points[v, 2]
        depth = to_image[2, 0] * x + to_image[2, 1] * y + to_image[2, 2] * z + to_image[2, 3]
        near = 1 / max(depth, np.float32(1e-3))
        depths[v] = depth
        pixels[v, 0] = (to_image[0, 0] * x + to_image[0, 1] * y + to_image[0, 2] * z + to_image[0, 3]) * near
        pixels[v, 1] = (to_image[1, 0] * x + to_image[1, 1] * y + to_image[1, 2] * z + to_image[1, 3]) * near
    return pixels, depths


@njit(nogil=True, cache=True, error_model="numpy")
def _enter(pixels, depths, stride, start, rows, columns, square):  # type: ignore[no-untyped-def]
    """Write the square of each pixel (V, 2) of one view's crop; -1: not within ``WINDOW`` of it, or behind."""
    per_stride, half, margin = np.float32(1 / stride), np.float32(0.5), np.float32(_MARGIN)
    for v in range(len(pixels)):
        c = (pixels[v, 0] + half) * per_stride + margin
        r = (pixels[v, 1] + half) * per_stride + margin
        inside = c >= WINDOW and r >= WINDOW and c < columns - WINDOW and r < rows - WINDOW and depths[v] > 0
        square[v] = start + np.int32(r) * columns + np.int32(c) if inside else -1


@njit(nogil=True, cache=True, error_model="numpy")
def _enter_own(uv, height, width, stride, start, columns, square):  # type: ignore[no-untyped-def]
    """Write the square of each texture coordinate (V, 2) of one view."""
    across, down = np.float32(width / stride), np.float32(height / stride)
    for v in range(len(uv)):
        square[v] = start + (np.int32(uv[v, 1] * down) + _MARGIN) * columns + np.int32(uv[v, 0] * across) + _MARGIN
