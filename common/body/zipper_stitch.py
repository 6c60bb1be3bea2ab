"""Closing a seam (Turk & Levoy 1994): the notches between two borders that touch are filled with triangles.

Where two borders meet they leave like the two sides of a zipper. An ear, the triangle over two border edges in a row,
closes the corner between them; its third edge is border again, and so on along the seam.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.edge_table import edge_table, known, remember

EAR_SQUARES = (1.5, 2.5, 5.0)  # the longest third edge, in squares of the mesh: short ears first
_ROUNDS = 6
_EMPTY = -1
# Rows of the open edges (5, E) int32: from vertex to vertex (from none: closed), the view it is of (none: an ear's),
# and as chains the next edge from the same vertex, and to the same vertex.
_FROM, _TO, _VIEW, _NEXT_FROM, _NEXT_TO = range(5)


def stitched(
    vertices: NDArray[np.float32],
    normals: NDArray[np.float32],
    faces: NDArray[np.int32],
    leader: NDArray[np.int32],
    view_of: NDArray[np.int32],
    border: NDArray[np.bool_],
    size_m: NDArray[np.float32],
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """New triangles (F', 3) int32 that close the seams of ``faces`` (F, 3), and the vertices they need besides.

    ``vertices`` (V, 3) [m, world] in their final places; ``leader`` (V,): which of those in one place stands for all;
    ``view_of`` (V,): the view that paints it; ``border`` (V,): whether it may be on a border; ``size_m`` (V,): a
    square's size there. New vertex V + n is a twin of the n-th of the second result, painted by that view of the third.
    An ear joins two views, or two that were joined, and faces as its corners do; or it closes a hole of three edges.
    """
    limits = np.array(EAR_SQUARES, np.float32)
    views = int(view_of.max()) + 1 if len(view_of) else 0
    found = _stitch(vertices, normals, faces, leader, view_of, border, size_m, limits, views)
    return found[0], found[1], found[2]


@njit(nogil=True, cache=True, error_model="numpy")
def _stitch(vertices, normals, faces, leader, view_of, border, size_m, limits, views):  # type: ignore[no-untyped-def]
    edges, first, count, table = _open_edges(faces, leader, view_of, border)
    corners = np.unique(edges[_FROM, :count])
    ears = np.empty((edges.shape[1], 4), np.int32)  # the corners, and the view to paint it
    ear_count = 0
    ear = np.empty(3, np.int64)  # edges in, out and closing
    untried = np.empty(len(vertices), np.bool_)  # corners at which something changed since no ear was found there
    for limit in limits:
        untried[:] = True
        for _ in range(_ROUNDS):
            before = ear_count
            for p in corners:
                while untried[p]:
                    untried[p] = _best_ear(p, limit, vertices, normals, size_m, edges, first, table, ear)
                    if not untried[p] or count + 1 >= edges.shape[1]:
                        break
                    paint = max(edges[_VIEW, ear[0]], edges[_VIEW, ear[1]])
                    ears[ear_count, 0], ears[ear_count, 1] = edges[_FROM, ear[0]], edges[_TO, ear[1]]
                    ears[ear_count, 2], ears[ear_count, 3] = p, paint if paint >= 0 else view_of[p]
                    ear_count += 1
                    count = _close(p, ear, edges, first, count, table, untried)
            if ear_count == before:
                break
    return _painted(ears[:ear_count], leader, view_of, views)


@njit(nogil=True, cache=True, error_model="numpy")
def _open_edges(faces, leader, view_of, border):  # type: ignore[no-untyped-def]
    """Edges of one triangle only, as it goes along them (with room for new ones), the first of those from and to each
    vertex (2, V), their number; and the table of all edges between border vertices."""
    at_border = border[leader]
    total = 0
    for f in range(len(faces)):
        total += int(at_border[faces[f, 0]]) + int(at_border[faces[f, 1]]) + int(at_border[faces[f, 2]]) >= 2
    found, table = np.empty((3, 3 * total), np.int32), edge_table(4 * total)
    n = 0
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            if at_border[a] and at_border[b]:
                found[0, n], found[1, n], found[2, n] = leader[a], leader[b], view_of[faces[f, 0]]
                remember(table, leader[a], leader[b])
                n += 1
    edges, first = np.empty((5, 2 * n + 8), np.int32), np.full((2, len(leader)), _EMPTY, np.int32)
    count = 0
    for e in range(n):
        if not known(table, found[1, e], found[0, e]):
            count = _add(found[0, e], found[1, e], found[2, e], edges, first, count)
    return edges, first, count, table


@njit(nogil=True, cache=True, error_model="numpy")
def _add(a, b, view, edges, first, count):  # type: ignore[no-untyped-def]
    """One more open edge, a → b; returns how many there are."""
    edges[_FROM, count], edges[_TO, count], edges[_VIEW, count] = a, b, view
    edges[_NEXT_FROM, count], edges[_NEXT_TO, count] = first[0, a], first[1, b]
    first[0, a] = first[1, b] = count
    return count + 1


@njit(nogil=True, cache=True, error_model="numpy")
def _close(p, ear, edges, first, count, table, untried):  # type: ignore[no-untyped-def]
    """The ear at corner p closes its two edges, and the third or opens it; returns how many edges there are."""
    u, w = edges[_FROM, ear[0]], edges[_TO, ear[1]]
    remember(table, w, p)
    remember(table, p, u)
    remember(table, u, w)
    edges[_FROM, ear[0]] = edges[_FROM, ear[1]] = _EMPTY
    if ear[2] >= 0:
        edges[_FROM, ear[2]] = _EMPTY
        return count
    untried[u] = untried[w] = True
    e = first[0, w]
    while e >= 0:  # a hole of three edges may be left, u → w → here
        untried[edges[_TO, e]] = True
        e = edges[_NEXT_FROM, e]
    return _add(u, w, _EMPTY, edges, first, count)


@njit(nogil=True, cache=True, error_model="numpy")
def _best_ear(p, limit, vertices, normals, size_m, edges, first, table, ear):  # type: ignore[no-untyped-def]
    """Whether there is an ear at corner p, and into ``ear`` the one with the shortest third edge."""
    shortest = (limit * size_m[p]) ** 2
    found = False
    e = first[1, p]
    while e >= 0:
        u = edges[_FROM, e]
        o = first[0, p] if u >= 0 else _EMPTY
        while o >= 0:
            w = edges[_TO, o]
            if edges[_FROM, o] >= 0 and u != w and _squared(vertices, u, w) < shortest:
                closing = _open_between(w, u, edges, first)
                joins = edges[_VIEW, e] != edges[_VIEW, o] or edges[_VIEW, e] < 0
                fits = closing >= 0 or (joins and not known(table, u, w) and _faces_out(vertices, normals, u, w, p))
                if fits and not known(table, w, p) and not known(table, p, u):
                    shortest = _squared(vertices, u, w)
                    ear[0], ear[1], ear[2] = e, o, closing
                    found = True
            o = edges[_NEXT_FROM, o]
        e = edges[_NEXT_TO, e]
    return found


@njit(nogil=True, cache=True, error_model="numpy")
def _open_between(a, b, edges, first):  # type: ignore[no-untyped-def]
    """The open edge from a to b, -1 if none."""
    e = first[0, a]
    while e >= 0 and (edges[_FROM, e] < 0 or edges[_TO, e] != b):
        e = edges[_NEXT_FROM, e]
    return e


@njit(nogil=True, cache=True, error_model="numpy")
def _squared(vertices, a, b):  # type: ignore[no-untyped-def]
    x, y, z = vertices[a, 0] - vertices[b, 0], vertices[a, 1] - vertices[b, 1], vertices[a, 2] - vertices[b, 2]
    return x * x + y * y + z * z


@njit(nogil=True, cache=True, error_model="numpy")
def _faces_out(vertices, normals, a, b, c):  # type: ignore[no-untyped-def]
    """Whether triangle a b c faces as its corners' normals do."""
    total = np.float32(0.0)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        n = (vertices[b, j] - vertices[a, j]) * (vertices[c, k] - vertices[a, k])
        n -= (vertices[b, k] - vertices[a, k]) * (vertices[c, j] - vertices[a, j])
        total += n * (normals[a, i] + normals[b, i] + normals[c, i])
    return total > 0


@njit(nogil=True, cache=True, error_model="numpy")
def _painted(ears, leader, view_of, views):  # type: ignore[no-untyped-def]
    """Ears with corners of the view that paints them: that view's vertex in the place, or a new twin."""
    twins = np.full((len(leader), views), _EMPTY, np.int32)
    for v in range(len(leader)):
        if leader[v] == v or twins[leader[v], view_of[v]] < 0:
            twins[leader[v], view_of[v]] = v
    sources, painters = np.empty(3 * len(ears), np.int32), np.empty(3 * len(ears), np.int32)
    out = np.empty((len(ears), 3), np.int32)
    count = 0
    for f in range(len(ears)):
        for k in range(3):
            v, view = ears[f, k], ears[f, 3]
            if twins[v, view] < 0:
                twins[v, view] = len(leader) + count
                sources[count], painters[count] = v, view
                count += 1
            out[f, k] = twins[v, view]
    return out, sources[:count].copy(), painters[:count].copy()
