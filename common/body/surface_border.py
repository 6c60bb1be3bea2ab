"""Triangles of a surface taken away, where its border is then, and one view's border moved onto another's."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.view_overlap import SAME_SIDE
from common.body.view_squares import WINDOW, ViewSquares

SNAP_SQUARES = 1.5  # how far a border moves onto another's, in squares of the mesh; at most ``WINDOW``


Faces = NDArray[np.int32]


def split_by_length(vertices: NDArray[np.float32], faces: Faces, longest_m: float) -> tuple[Faces, Faces]:
    """The triangles of ``faces`` (F, 3) without an edge longer than ``longest_m``, and the others.

    ``vertices`` (V, 3) [m]."""
    return _split_by_length(vertices, faces, np.float32(longest_m**2))


def border_of(faces: Faces, count: int) -> NDArray[np.bool_]:
    """Mask (count,) of the vertices whose triangles (F, 3) do not close around them."""
    return _border(faces, count)


def snapped(
    vertices: NDArray[np.float32], normals: NDArray[np.float32], border: NDArray[np.bool_], squares: ViewSquares
) -> NDArray[np.int32]:
    """For each vertex the one whose place it takes (V,) int32: of an earlier view's border, the nearest; or itself.

    ``vertices`` (V, 3) [m, world], ``normals`` (V, 3), ``border`` (V,) of all views."""
    images = squares.view_of, squares.square, squares.only(border), squares.columns
    return _snapped(
        vertices, normals, border, *images, np.float32(SNAP_SQUARES) * squares.size_m, np.float32(SAME_SIDE)
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _split_by_length(vertices, faces, longest_squared):  # type: ignore[no-untyped-def]
    short, long = np.empty_like(faces), np.empty_like(faces)
    short_count = long_count = 0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        longest = np.float32(0.0)
        for p, q in ((a, b), (b, c), (c, a)):
            x, y, z = vertices[p, 0] - vertices[q, 0], vertices[p, 1] - vertices[q, 1], vertices[p, 2] - vertices[q, 2]
            longest = max(longest, x * x + y * y + z * z)
        if longest <= longest_squared:
            short[short_count, 0], short[short_count, 1], short[short_count, 2] = a, b, c
            short_count += 1
        else:
            long[long_count, 0], long[long_count, 1], long[long_count, 2] = a, b, c
            long_count += 1
    return short[:short_count], long[:long_count]


@njit(nogil=True, cache=True, error_model="numpy")
def without(faces, gone):  # type: ignore[no-untyped-def]
    """The triangles of ``faces`` (F, 3) int32 that have no corner in the mask ``gone`` (V,)."""
    out = np.empty_like(faces)
    count = 0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        out[count, 0], out[count, 1], out[count, 2] = a, b, c
        count += not (gone[a] or gone[b] or gone[c])
    return out[:count]


@njit(nogil=True, cache=True, error_model="numpy")
def _border(faces, count):  # type: ignore[no-untyped-def]
    """Around an inner vertex each neighbour comes once before and once after: sums of scattered numbers cancel."""
    sums = np.zeros(count, np.int64)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        p = (np.int64(a) * np.int64(a) + 1) * 2654435761
        q = (np.int64(b) * np.int64(b) + 1) * 2654435761
        r = (np.int64(c) * np.int64(c) + 1) * 2654435761
        sums[a] += q - r
        sums[b] += r - p
        sums[c] += p - q
    return sums != 0


@njit(nogil=True, cache=True, error_model="numpy")
def _snapped(vertices, normals, border, view_of, square, border_at, columns, reach_m, facing):  # type: ignore[no-untyped-def]
    leader = np.arange(len(view_of)).astype(np.int32)
    for v in range(len(view_of)):
        if not border[v]:
            continue
        nearest = reach_m[v] * reach_m[v]
        for j in range(view_of[v]):
            if square[j, v] < 0:
                continue
            for down in range(-WINDOW, WINDOW + 1):
                for right in range(-WINDOW, WINDOW + 1):
                    n = border_at[square[j, v] + down * columns[j] + right]
                    if n < 0 or leader[n] != n:
                        continue
                    x, y = vertices[n, 0] - vertices[v, 0], vertices[n, 1] - vertices[v, 1]
                    z = vertices[n, 2] - vertices[v, 2]
                    squared = x * x + y * y + z * z
                    alike = normals[v, 0] * normals[n, 0] + normals[v, 1] * normals[n, 1]
                    alike += normals[v, 2] * normals[n, 2]
                    if squared < nearest and alike > facing:
                        nearest = squared
                        leader[v] = n
    return leader


@njit(nogil=True, cache=True, error_model="numpy")
def unturned(vertices, placed, faces, leader, border):  # type: ignore[no-untyped-def]
    """The triangles (F', 3) of ``faces`` (F, 3) that still have three corners, and still face as they did, with the
    vertices (V, 3) moved to ``placed`` (V, 3), the place of each one's ``leader`` (V,); around those that do not, the
    leaders become ``border`` (V,)."""
    out = np.empty_like(faces)
    before, after = np.empty(3, np.float32), np.empty(3, np.float32)
    count = 0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        la, lb, lc = leader[a], leader[b], leader[c]
        if la != a or lb != b or lc != c:
            _normal(vertices, a, b, c, before)
            _normal(placed, a, b, c, after)
            facing = before[0] * after[0] + before[1] * after[1] + before[2] * after[2] > 0
            if la == lb or lb == lc or lc == la or not facing:
                border[la] = border[lb] = border[lc] = True
                continue
        out[count, 0], out[count, 1], out[count, 2] = a, b, c
        count += 1
    return out[:count]


@njit(nogil=True, cache=True, error_model="numpy")
def _normal(vertices, a, b, c, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = (vertices[b, j] - vertices[a, j]) * (vertices[c, k] - vertices[a, k])
        out[i] -= (vertices[b, k] - vertices[a, k]) * (vertices[c, j] - vertices[a, j])
