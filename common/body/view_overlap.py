"""What several views have of one surface: who sees a place best, and where all together say it is.

A vertex of one view has its partner in another where that view's image shows the same surface (Turk & Levoy 1994 take
the nearest triangle; a depth image gives it by a look).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.view_squares import ViewSquares

SURFACE_EDGE_M = 0.06  # longer edges bridge an occlusion: no surface to be seen better or sewn on
SAME_SURFACE_M = 0.015  # surfaces nearer than this, across, are one: twice a sensor's noise, half a finger
SAME_SIDE = 0.3  # cosine between two normals: a hand's back is not its palm
TURNED_AWAY = np.float32(0.25)  # cosine between the normal and a view's ray: there the view has its outline
OUTLINE_WEIGHT = np.float32(2.0)  # in a consensus; a surface seen straight on has 1. 0.5 gives 0.06 dB less
_CLASSES = 4096  # of quality: finer than its noise, and putting vertices in order takes one pass
_LIMITS = (np.float32(SAME_SURFACE_M), np.float32(SURFACE_EDGE_M**2), np.float32(SAME_SIDE))


def overlap(
    vertices: NDArray[np.float32],
    normals: NDArray[np.float32],
    quality: NDArray[np.float32],
    outline: NDArray[np.bool_],
    eyes: NDArray[np.float32],
    squares: ViewSquares,
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Mask (V,) of the vertices of which another view has the same surface, seen better and not at its own outline;
    and the views' consensus (V, 3) [m, world], each vertex moved along its normal.

    ``vertices``, ``normals`` (V, 3); ``quality`` (V,): how well its view sees each; ``outline`` (V,): whether its
    surface ends there; ``eyes`` (N, 3) [m, world]: where the views look from.
    Best seen first: what is redundant itself makes nothing else so, and no surface is lost by all of its views.
    Where the surface turns away from another view, that view's outline says best how far out it is.
    """
    images = squares.view_of, squares.square, squares.at, squares.only(outline), squares.columns
    partners, consensus = _partners(vertices, normals, quality, outline, eyes, *images, *_LIMITS)
    return _redundant(partners, quality), consensus


@njit(nogil=True, cache=True, error_model="numpy")
def _partners(  # type: ignore[no-untyped-def]
    vertices, normals, quality, outline, eyes, view_of, square, at, outline_at, columns, same_m, far_squared, same_side
):
    """The vertex (V, N) of each view that shows the same surface inside its outline, -1 = none; the consensus."""
    partners, consensus = np.full((len(view_of), len(eyes)), -1, np.int32), np.empty_like(vertices)
    for v in range(len(view_of)):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        nx, ny, nz = normals[v, 0], normals[v, 1], normals[v, 2]
        total, off = max(quality[v], np.float32(0.0)) ** 2 + np.float32(1e-6), np.float32(0.0)
        for j in range(len(eyes)):
            s = square[j, v]
            if s < 0 or j == view_of[v]:
                continue
            rx, ry, rz = eyes[j, 0] - x, eyes[j, 1] - y, eyes[j, 2] - z
            along = nx * rx + ny * ry + nz * rz
            if along * along <= TURNED_AWAY * TURNED_AWAY * (rx * rx + ry * ry + rz * rz):
                apart = _outline_apart(s, columns[j], outline_at, vertices, x, y, z, nx, ny, nz, same_m, far_squared)
                if apart != 0:
                    total += OUTLINE_WEIGHT
                    off += OUTLINE_WEIGHT * apart
            n = at[s]
            if n < 0 or outline[n]:
                continue
            sx, sy, sz = vertices[n, 0] - x, vertices[n, 1] - y, vertices[n, 2] - z
            apart = nx * sx + ny * sy + nz * sz
            alike = nx * normals[n, 0] + ny * normals[n, 1] + nz * normals[n, 2]
            if alike > same_side and abs(apart) <= same_m and sx * sx + sy * sy + sz * sz <= far_squared:
                partners[v, j] = n
                weight = max(quality[n], np.float32(0.0)) ** 2
                total += weight
                off += weight * apart
        off /= total
        consensus[v, 0], consensus[v, 1], consensus[v, 2] = x + nx * off, y + ny * off, z + nz * off
    return partners, consensus


@njit(nogil=True, cache=True, error_model="numpy")
def _outline_apart(s, columns, outline_at, vertices, x, y, z, nx, ny, nz, same_m, far_squared):  # type: ignore[no-untyped-def]
    """How far a view's outline about its square ``s`` is from a vertex along its normal [m]; 0: not known.

    Along the normal it is across the view's rays, and there an outline is true to a fraction of a pixel.
    """
    nearest, apart = far_squared, np.float32(0.0)
    for down in range(-1, 2):
        for right in range(-1, 2):
            n = outline_at[s + down * columns + right]
            if n < 0:
                continue
            sx, sy, sz = vertices[n, 0] - x, vertices[n, 1] - y, vertices[n, 2] - z
            squared, off = sx * sx + sy * sy + sz * sz, nx * sx + ny * sy + nz * sz
            if squared < nearest and abs(off) < same_m:
                nearest, apart = squared, off
    return apart


@njit(nogil=True, cache=True, error_model="numpy")
def _redundant(partners, quality):  # type: ignore[no-untyped-def]
    """Mask (V,) of the vertices with a partner seen better that is kept itself."""
    redundant, kept = np.zeros(len(quality), np.bool_), np.zeros(len(quality), np.bool_)
    for v in _best_first(quality):
        for j in range(partners.shape[1]):
            n = partners[v, j]
            redundant[v] |= n >= 0 and kept[n]
        kept[v] = not redundant[v]
    return redundant


@njit(nogil=True, cache=True, error_model="numpy")
def _best_first(quality):  # type: ignore[no-untyped-def]
    """The vertices (V,) by falling class of quality: a counting sort."""
    worst = np.empty(len(quality), np.int32)
    first = np.zeros(_CLASSES + 1, np.int32)
    for v in range(len(quality)):
        share = min(max(quality[v], np.float32(0.0)), np.float32(1.0))
        worst[v] = np.int32((1 - share) * np.float32(_CLASSES - 1))
        first[worst[v] + 1] += 1
    for c in range(_CLASSES):
        first[c + 1] += first[c]
    order = np.empty(len(quality), np.int32)
    for v in range(len(quality)):
        order[first[worst[v]]] = v
        first[worst[v]] += 1
    return order
