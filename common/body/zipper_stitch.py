"""Closing a seam (Turk & Levoy 1994): the notches between two borders that touch are filled with triangles.

Where two borders meet they leave like the two sides of a zipper. An ear, the triangle over two border edges in a row,
closes the corner between them; its third edge is border again, and so on along the seam.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

EAR_SQUARES = (1.5, 2.5, 5.0)  # the longest third edge, in squares of the mesh: short ears first
_ROUNDS = 6
_EMPTY = -1


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
    start, end, view, count, table = _open_edges(faces, leader, view_of, border)
    out_first, out_next = _chains(start, count, len(vertices))
    in_first, in_next = _chains(end, count, len(vertices))
    edges = start, end, view, out_first, out_next, in_first, in_next
    corners = np.unique(start[:count])
    ears = np.empty((len(start), 4), np.int32)  # the corners, and the view to paint it
    ear_count = 0
    ear = np.empty(3, np.int64)  # edges in, out and closing
    for limit in limits:
        for _ in range(_ROUNDS):
            before = ear_count
            for p in corners:
                while _best_ear(p, limit, vertices, normals, size_m, edges, table, ear):
                    if count + 1 >= len(start):
                        break
                    u, w = start[ear[0]], end[ear[1]]
                    paint = max(view[ear[0]], view[ear[1]])
                    ears[ear_count, 0], ears[ear_count, 1], ears[ear_count, 2] = u, w, p
                    ears[ear_count, 3] = paint if paint >= 0 else view_of[p]
                    ear_count += 1
                    _remember(table, w, p)
                    _remember(table, p, u)
                    start[ear[0]] = start[ear[1]] = _EMPTY
                    if ear[2] >= 0:
                        start[ear[2]] = _EMPTY
                        _remember(table, u, w)
                    else:
                        start[count], end[count], view[count] = u, w, _EMPTY
                        out_next[count], in_next[count] = out_first[u], in_first[w]
                        out_first[u] = in_first[w] = count
                        count += 1
                        _remember(table, u, w)
            if ear_count == before:
                break
    return _painted(ears[:ear_count], leader, view_of, views)


@njit(nogil=True, cache=True, error_model="numpy")
def _open_edges(faces, leader, view_of, border):  # type: ignore[no-untyped-def]
    """Edges of one triangle only, as it goes along them: start, end, its view (with room for new ones), their number;
    and the table of all edges between border vertices."""
    total = 0
    for f in range(len(faces)):
        for k in range(3):
            total += border[leader[faces[f, k]]] and border[leader[faces[f, (k + 1) % 3]]]
    size = 1
    while size < 8 * total + 64:
        size *= 2
    table = np.full((size, 2), _EMPTY, np.int32)
    for f in range(len(faces)):
        for k in range(3):
            a, b = leader[faces[f, k]], leader[faces[f, (k + 1) % 3]]
            if border[a] and border[b]:
                _remember(table, a, b)
    start, end = np.empty(2 * total + 8, np.int32), np.empty(2 * total + 8, np.int32)
    view = np.empty(2 * total + 8, np.int32)
    count = 0
    for f in range(len(faces)):
        for k in range(3):
            a, b = leader[faces[f, k]], leader[faces[f, (k + 1) % 3]]
            if border[a] and border[b] and not _known(table, b, a):
                start[count], end[count], view[count] = a, b, view_of[faces[f, 0]]
                count += 1
    return start, end, view, count, table


@njit(nogil=True, cache=True, error_model="numpy")
def _chains(vertex, count, vertices):  # type: ignore[no-untyped-def]
    """The edges at each vertex as chains: the first of each vertex, and the one after each edge."""
    first, following = np.full(vertices, _EMPTY, np.int32), np.full(len(vertex), _EMPTY, np.int32)
    for e in range(count):
        following[e] = first[vertex[e]]
        first[vertex[e]] = e
    return first, following


@njit(nogil=True, cache=True, error_model="numpy")
def _best_ear(p, limit, vertices, normals, size_m, edges, table, ear):  # type: ignore[no-untyped-def]
    """Whether there is an ear at corner p, and into ``ear`` the one with the shortest third edge."""
    start, end, view, out_first, out_next, in_first, in_next = edges
    shortest = (limit * size_m[p]) ** 2
    found = False
    e = in_first[p]
    while e >= 0:
        o = out_first[p] if start[e] >= 0 else _EMPTY
        while o >= 0:
            if start[o] >= 0:
                u, w = start[e], end[o]
                closing = _open_between(w, u, start, end, out_first, out_next)
                joins = view[e] != view[o] or view[e] < 0 or closing >= 0
                squared = _squared(vertices, u, w)
                new = not (_known(table, w, p) or _known(table, p, u) or (closing < 0 and _known(table, u, w)))
                if (
                    joins
                    and new
                    and u != w
                    and squared < shortest
                    and (closing >= 0 or _faces_out(vertices, normals, u, w, p))
                ):
                    shortest = squared
                    ear[0], ear[1], ear[2] = e, o, closing
                    found = True
            o = out_next[o]
        e = in_next[e]
    return found


@njit(nogil=True, cache=True, error_model="numpy")
def _open_between(a, b, start, end, out_first, out_next):  # type: ignore[no-untyped-def]
    """The open edge from a to b, -1 if none."""
    e = out_first[a]
    while e >= 0:
        if start[e] >= 0 and end[e] == b:
            return e
        e = out_next[e]
    return np.int32(_EMPTY)


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
def _remember(table, a, b):  # type: ignore[no-untyped-def]
    """Enter the edge a → b into the open-addressed table."""
    mask = len(table) - 1
    place = (np.int64(a) * 73856093 + np.int64(b) * 19349663) & mask
    while table[place, 0] != _EMPTY:
        if table[place, 0] == a and table[place, 1] == b:
            return
        place = (place + 1) & mask
    table[place, 0], table[place, 1] = a, b


@njit(nogil=True, cache=True, error_model="numpy")
def _known(table, a, b):  # type: ignore[no-untyped-def]
    """Whether the edge a → b is in the table."""
    mask = len(table) - 1
    place = (np.int64(a) * 73856093 + np.int64(b) * 19349663) & mask
    while table[place, 0] != _EMPTY:
        if table[place, 0] == a and table[place, 1] == b:
            return True
        place = (place + 1) & mask
    return False


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
