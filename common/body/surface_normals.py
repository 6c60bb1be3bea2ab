"""A surface's normals, and how straight the view that captured it looks at each place."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def vertex_normals(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """Unit normals (V, 3) float32 of vertices (V, 3): the sum of those of the triangles (F, 3) around each, larger ones
    counting for more; 0 without any."""
    normals = np.zeros_like(vertices)
    _add_face_normals(vertices, faces, normals)
    _unit(normals)
    return normals


def normals_and_incidence(
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    eyes: NDArray[np.float32],
    view_of: NDArray[np.int32],
    smoothing: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Normals (V, 3) float32 of vertices (V, 3) [m, world], and the cosine of incidence (V,) of the ray from the eye
    (N, 3) [m, world] of the view ``view_of`` (V,) each is of: 0 without a triangle.

    Both are means over the neighbours in ``faces`` (F, 3), ``smoothing`` rounds deep.
    """
    return _normals_and_incidence(vertices, faces, eyes, view_of, smoothing)


@njit(nogil=True, cache=True, error_model="numpy")
def _normals_and_incidence(vertices, faces, eyes, view_of, smoothing):  # type: ignore[no-untyped-def]
    normals = np.zeros((len(vertices), 3), np.float32)
    _add_face_normals(vertices, faces, normals)
    total = np.empty_like(normals)
    for _ in range(smoothing):
        _unit(normals)
        total[:] = normals
        _add_neighbours(faces, normals, total)
        normals, total = total, normals
    _unit(normals)
    incidence = np.empty(len(vertices), np.float32)
    for v in range(len(vertices)):
        view = view_of[v]
        x, y, z = eyes[view, 0] - vertices[v, 0], eyes[view, 1] - vertices[v, 1], eyes[view, 2] - vertices[v, 2]
        along = normals[v, 0] * x + normals[v, 1] * y + normals[v, 2] * z
        incidence[v] = along / np.sqrt(x * x + y * y + z * z)
    return normals, incidence


@njit(nogil=True, cache=True, error_model="numpy")
def _add_face_normals(vertices, faces, normals):  # type: ignore[no-untyped-def]
    """Each triangle's normal, as long as twice its area, to its corners'."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x, y, z = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        px, py, pz = vertices[b, 0] - x, vertices[b, 1] - y, vertices[b, 2] - z
        qx, qy, qz = vertices[c, 0] - x, vertices[c, 1] - y, vertices[c, 2] - z
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        _add(normals, a, nx, ny, nz)
        _add(normals, b, nx, ny, nz)
        _add(normals, c, nx, ny, nz)


@njit(nogil=True, cache=True, error_model="numpy")
def _add_neighbours(faces, normals, total):  # type: ignore[no-untyped-def]
    """To each corner's total what the next corner has: so every neighbour of an inner vertex counts once."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        _add(total, a, normals[b, 0], normals[b, 1], normals[b, 2])
        _add(total, b, normals[c, 0], normals[c, 1], normals[c, 2])
        _add(total, c, normals[a, 0], normals[a, 1], normals[a, 2])


@njit(nogil=True, cache=True, error_model="numpy")
def _add(vectors, v, x, y, z):  # type: ignore[no-untyped-def]
    vectors[v, 0] += x
    vectors[v, 1] += y
    vectors[v, 2] += z


@njit(nogil=True, cache=True, error_model="numpy")
def _unit(normals):  # type: ignore[no-untyped-def]
    for v in range(len(normals)):
        x, y, z = normals[v, 0], normals[v, 1], normals[v, 2]
        squared = x * x + y * y + z * z
        scale = np.float32(1.0) / np.sqrt(squared) if squared > 0 else np.float32(0.0)
        normals[v, 0], normals[v, 1], normals[v, 2] = x * scale, y * scale, z * scale
