"""Several views' meshes into one connected surface: zippering (Turk & Levoy 1994).

Where views overlap, triangles that another view sees better are redundant and go; what is left of each view ends a
square or two before the next. The later view's border then moves onto the earlier one's, and the notches that remain
are closed triangle by triangle, as a zipper closes. Each view keeps its texture: at a seam a place has one vertex for
each view that paints there, and ``weld`` says which are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.surface_border import border_of, snapped, split_by_length, unturned, without
from common.body.surface_normals import normals_and_incidence
from common.body.view import View
from common.body.view_overlap import SURFACE_EDGE_M, overlap
from common.body.view_squares import ViewSquares, pixels_in, view_squares
from common.body.zipper_stitch import stitched
from common.geometry.triangle_mesh import TriangleMesh

_SMOOTHING = 3  # rounds over neighbours: borders should be lines, not noise


@dataclass(frozen=True, slots=True, eq=False)
class Zippered:
    """``mesh``: one surface. ``source`` (V,) int32: the vertex of the views' meshes, one after the other, that each is
    or stands beside. ``weld`` (V,) int32: the vertex that has the same place, for those that share one; else itself.
    ``faces_stitched``: how many triangles were made to close the seams; they are the last."""

    mesh: TriangleMesh
    source: NDArray[np.int32]
    weld: NDArray[np.int32]
    faces_stitched: int


def zippered(merged: TriangleMesh, meshes: Sequence[TriangleMesh], views: Sequence[View], stride: int) -> Zippered:
    """Zipper the views' ``meshes`` (``mesh_view`` with ``stride``), which ``merged`` holds one after the other.

    ``merged``'s texture is the views' colours side by side. Bridges over occlusions stay where all three ends do.
    """
    eyes = np.array([view.camera.T_world_camera[:3, 3] for view in views], np.float32)
    squares = view_squares(merged.vertices, meshes, views, stride)
    surface, bridges = split_by_length(merged.vertices, merged.faces, SURFACE_EDGE_M)
    normals, quality = normals_and_incidence(merged.vertices, surface, eyes, squares.view_of, _SMOOTHING)
    outline = border_of(surface, len(normals))
    redundant, vertices = overlap(merged.vertices, normals, quality, outline, eyes, squares)
    surface, bridges = without(surface, redundant), without(bridges, redundant)
    border = border_of(surface, len(normals))
    leader = snapped(vertices, normals, border, squares)
    placed = vertices.take(leader, axis=0)
    surface = unturned(vertices, placed, surface, leader, border)
    ears = stitched(placed, normals, surface, leader, squares.view_of, border, squares.size_m)
    return _assembled(merged, placed, np.concatenate([surface, bridges, ears[0]]), leader, views, squares, ears)


def _assembled(
    merged: TriangleMesh,
    placed: NDArray[np.float32],
    faces: NDArray[np.int32],
    leader: NDArray[np.int32],
    views: Sequence[View],
    squares: ViewSquares,
    ears: tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]],
) -> Zippered:
    """The mesh of ``faces`` (F, 3) and what they use of the vertices, at the places ``placed`` (V, 3); those that took
    their ``leader``'s are painted with what their view has where it was.

    ``ears``: as ``stitched`` gives them; the last of the faces are theirs.
    """
    ear_faces, twins, twin_views = ears
    source = np.concatenate([np.arange(len(leader), dtype=np.int32), twins])
    weld = np.concatenate([leader, leader[twins]])
    painted_by = np.concatenate([squares.view_of, twin_views])
    uv = merged.uv.take(source, axis=0)
    moved = np.flatnonzero(weld != np.arange(len(weld)))
    left = 0
    for index, view in enumerate(views):
        of = moved[painted_by[moved] == index]
        pixels, _ = pixels_in(view, merged.vertices[weld[of]])
        size = np.array(view.depth_mm.shape[::-1], np.float32)
        pixels = np.clip(pixels, 0, size - 1) + np.array([left + 0.5, 0.5], np.float32)
        uv[of] = pixels / np.array(merged.texture.shape[1::-1], np.float32)
        left += view.depth_mm.shape[1]
    faces, used, number = _renumbered(faces, weld)
    return Zippered(
        TriangleMesh(placed.take(source[used], axis=0), faces, uv.take(used, axis=0), merged.texture),
        source[used],
        number[weld[used]],
        len(ear_faces),
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _renumbered(faces, weld):  # type: ignore[no-untyped-def]
    """The triangles (F, 3) with numbers without gaps, the vertices in use (V',), and the new number (V,) of what each
    vertex is, or of one that stands for it: where nothing holds a leader itself any more, one of its followers does."""
    number = np.full(len(weld), -1, np.int32)
    for f in range(len(faces)):
        number[faces[f, 0]] = number[faces[f, 1]] = number[faces[f, 2]] = 0
    used = np.flatnonzero(number == 0).astype(np.int32)
    for n in range(len(used)):
        number[used[n]] = n
    out = np.empty_like(faces)
    for f in range(len(faces)):
        out[f, 0], out[f, 1], out[f, 2] = number[faces[f, 0]], number[faces[f, 1]], number[faces[f, 2]]
    for v in used:
        if number[weld[v]] < 0:
            number[weld[v]] = number[v]
    return out, used, number
