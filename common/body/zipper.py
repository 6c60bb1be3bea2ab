"""Several views' meshes into one connected surface: zippering (Turk & Levoy 1994).

Where views overlap, triangles that another view sees better are redundant and go; what is left of each view ends a
square or two before the next. The later view's border then moves onto the earlier one's, and the notches that remain
are closed triangle by triangle, as a zipper closes. Each view keeps its texture: at a seam a place has one vertex for
each view that paints there, and ``weld`` says which are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.view import View
from common.body.zipper_stitch import stitched
from common.geometry.camera_model import project
from common.geometry.rigid_transform import inverse
from common.geometry.triangle_mesh import TriangleMesh

SURFACE_EDGE_M = 0.06  # longer edges bridge an occlusion: no surface to be seen better or sewn on
SAME_SURFACE_M = 0.015  # surfaces nearer than this, across, are one: twice a sensor's noise, half a finger
SAME_SIDE = 0.3  # cosine between two normals: a hand's back is not its palm
TURNED_AWAY = np.float32(0.25)  # cosine between the normal and a view's ray: there the view has its outline
OUTLINE_WEIGHT = np.float32(2.0)  # in a consensus; a surface seen straight on has 1. 0.5 gives 0.06 dB less
SNAP_SQUARES = 1.5  # how far a border moves onto another's, in squares of the mesh
_SMOOTHING = 3  # rounds over neighbours: borders should be lines, not noise
_SAME = (np.float32(SAME_SURFACE_M), np.float32(SURFACE_EDGE_M), np.float32(SAME_SIDE))


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
    view_of = np.repeat(np.arange(len(views), dtype=np.int32), [len(mesh.vertices) for mesh in meshes])
    images = (*_seen_by_all(merged.vertices, views), *_image_grids(meshes, views, stride), stride)
    eyes = np.array([view.camera.T_world_camera[:3, 3] for view in views], np.float32)
    surface = _short(merged.vertices, merged.faces, np.float32(SURFACE_EDGE_M**2))
    faces = merged.faces[surface]
    normals, quality = _quality(merged.vertices, faces, eyes, view_of, _SMOOTHING)
    outline = _border(faces, len(view_of))
    redundant, vertices = _redundant(merged.vertices, view_of, images, eyes, normals, quality, outline, _SAME)
    faces, bridges = (f[_all_kept(f, redundant)] for f in (faces, merged.faces[~surface]))
    squares = np.array([stride / view.camera.fx for view in views], np.float32)
    border = _border(faces, len(view_of))
    leader = _snapped(vertices, view_of, images, normals, border, squares, np.float32(SNAP_SQUARES), _SAME[2])
    placed = vertices[leader]
    sound = _unturned(vertices, placed, faces, leader)
    border[leader[faces[~sound]]] = True
    size_m = squares[view_of] * images[1][view_of, np.arange(len(view_of))]
    ears = stitched(placed, normals, faces[sound], leader, view_of, border, size_m)
    moved = replace(merged, vertices=vertices, faces=np.concatenate([faces[sound], bridges, ears[0]]))
    return _assembled(moved, views, images[0], leader, view_of, ears)


def _seen_by_all(
    vertices: NDArray[np.float32], views: Sequence[View]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where each view has each vertex: pixels (N, V, 2) of its crop, depths (N, V) [m]."""
    pixels = np.empty((len(views), len(vertices), 2), np.float32)
    depths = np.empty((len(views), len(vertices)), np.float32)
    for index, view in enumerate(views):
        camera = view.camera
        if camera.distortion.any():
            pixels[index], depths[index] = project(camera, vertices)
        else:
            to_image = (camera.matrix @ inverse(camera.T_world_camera)[:3]).astype(np.float32)
            _project(vertices, to_image, pixels[index], depths[index])
        pixels[index] -= np.array([view.u0, view.v0], np.float32)
    return pixels, depths


def _image_grids(
    meshes: Sequence[TriangleMesh], views: Sequence[View], stride: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """All views' images as squares: the vertex in each, -1 where there is none, flat, one view after the other; and
    per view where it starts, its rows and its columns (N, 3)."""
    parts, grids = [], np.empty((len(views), 3), np.int32)
    start = first = 0
    for index, (mesh, view) in enumerate(zip(meshes, views, strict=True)):
        h, w = view.depth_mm.shape
        rows, columns = -(-h // stride), -(-w // stride)
        squares = (mesh.uv * np.array([w, h], np.float32)).astype(np.int32) // stride
        part = np.full(rows * columns, -1, np.int32)
        part[squares[:, 1] * columns + squares[:, 0]] = first + np.arange(len(squares), dtype=np.int32)
        parts.append(part)
        grids[index] = start, rows, columns
        start, first = start + len(part), first + len(squares)
    return np.concatenate(parts), grids


def _assembled(
    merged: TriangleMesh,
    views: Sequence[View],
    pixels: NDArray[np.float32],
    leader: NDArray[np.int32],
    view_of: NDArray[np.int32],
    ears: tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]],
) -> Zippered:
    """The mesh of what is left: vertices in use, moved ones painted with what their view has at the new place.

    ``ears``: as ``stitched`` gives them; the last of ``merged``'s triangles are theirs.
    """
    ear_faces, twins, twin_views = ears
    source = np.concatenate([np.arange(len(leader), dtype=np.int32), twins])
    weld = np.concatenate([leader, leader[twins]])
    painted_by = np.concatenate([view_of, twin_views])
    moved = np.flatnonzero(weld != np.arange(len(weld)))
    uv = np.concatenate([merged.uv, merged.uv[twins]])
    uv[moved] = _texture_place(pixels[painted_by[moved], weld[moved]], painted_by[moved], views, merged.texture)
    used = np.zeros(len(source), np.bool_)
    used[merged.faces] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    stands_for = weld.copy()  # where nothing holds a leader itself any more, one of its followers stands for it
    lone = np.flatnonzero(used & ~used[weld])
    stands_for[weld[lone]] = lone
    return Zippered(
        TriangleMesh(merged.vertices[weld[used]], number[merged.faces], uv[used], merged.texture),
        source[used],
        number[stands_for[weld[used]]],
        len(ear_faces),
    )


def _texture_place(
    pixels: NDArray[np.float32], painted_by: NDArray[np.int32], views: Sequence[View], texture: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Texture coordinates (N, 2) of pixels (N, 2) of the views' crops, within them."""
    sizes = np.array([view.depth_mm.shape[::-1] for view in views], np.float32)
    lefts = np.cumsum(np.concatenate([[0], sizes[:-1, 0]]))
    within = np.clip(pixels, 0, sizes[painted_by] - 1) + np.float32(0.5)
    within[:, 0] += lefts[painted_by]
    return (within / np.array(texture.shape[1::-1], np.float32)).astype(np.float32)


@njit(nogil=True, cache=True, error_model="numpy")
def _project(vertices, to_image, pixels, depths):  # type: ignore[no-untyped-def]
    for v in range(len(vertices)):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        depths[v] = to_image[2, 0] * x + to_image[2, 1] * y + to_image[2, 2] * z + to_image[2, 3]
        near = 1 / max(depths[v], np.float32(1e-3))
        pixels[v, 0] = (to_image[0, 0] * x + to_image[0, 1] * y + to_image[0, 2] * z + to_image[0, 3]) * near
        pixels[v, 1] = (to_image[1, 0] * x + to_image[1, 1] * y + to_image[1, 2] * z + to_image[1, 3]) * near


@njit(nogil=True, cache=True, error_model="numpy")
def _short(vertices, faces, longest_squared):  # type: ignore[no-untyped-def]
    """Mask (F,) of the triangles without a longer edge."""
    out = np.ones(len(faces), np.bool_)
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            x, y = vertices[a, 0] - vertices[b, 0], vertices[a, 1] - vertices[b, 1]
            z = vertices[a, 2] - vertices[b, 2]
            out[f] &= x * x + y * y + z * z <= longest_squared
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _quality(vertices, faces, eyes, view_of, smoothing):  # type: ignore[no-untyped-def]
    """Normals (V, 3), and how well each vertex's own view sees it (V,): the cosine of incidence, 0 without a surface.

    Both are means over the neighbours, ``smoothing`` rounds deep.
    """
    normals = np.zeros((len(vertices), 3), np.float32)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        px, py, pz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        qx, qy, qz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        for k in range(3):
            normals[faces[f, k], 0] += nx
            normals[faces[f, k], 1] += ny
            normals[faces[f, k], 2] += nz
    for _ in range(smoothing):
        _unit(normals)
        total = normals.copy()
        for f in range(len(faces)):
            for k in range(3):
                for i in range(3):
                    total[faces[f, k], i] += normals[faces[f, (k + 1) % 3], i]
        normals = total
    _unit(normals)
    quality = np.empty(len(vertices), np.float32)
    for v in range(len(vertices)):
        along, squared = np.float32(0.0), np.float32(0.0)
        for i in range(3):
            ray = eyes[view_of[v], i] - vertices[v, i]
            along += normals[v, i] * ray
            squared += ray * ray
        quality[v] = along / np.sqrt(squared)
    return normals, quality


@njit(nogil=True, cache=True, error_model="numpy")
def _unit(normals):  # type: ignore[no-untyped-def]
    for v in range(len(normals)):
        squared = normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2
        if squared > 0:
            scale = 1 / np.sqrt(squared)
            for i in range(3):
                normals[v, i] *= scale


@njit(nogil=True, cache=True, error_model="numpy")
def _redundant(vertices, view_of, images, eyes, normals, quality, outline, limits):  # type: ignore[no-untyped-def]
    """Mask (V,) of the vertices of which another view has the same surface, seen better and not at its own outline;
    and the consensus (V, 3) of the views, each vertex moved along its normal.

    Where the surface turns away from another view, that view's outline says best how far out it is.
    Best seen first: what is redundant itself makes nothing else so, and no surface is lost by all of its views.
    """
    pixels, depths, at, grids, stride = images
    same_m, far_m, same_side = limits
    out, kept, consensus = np.zeros(len(view_of), np.bool_), np.zeros(len(view_of), np.bool_), vertices.copy()
    for v in np.argsort(-quality):
        weight = max(quality[v], np.float32(0.0)) ** 2
        total, off = weight + np.float32(1e-6), np.float32(0.0)
        for j in range(len(grids)):
            if j == view_of[v] or depths[j, v] <= 0:
                continue
            n = _vertex_at(at, grids, j, pixels[j, v, 0], pixels[j, v, 1], stride, 0, 0)
            apart = _outline_apart(v, j, vertices, normals, eyes, images, outline, same_m, far_m)
            if apart != 0:
                total += OUTLINE_WEIGHT
                off += OUTLINE_WEIGHT * apart
            if n < 0 or outline[n]:
                continue
            alike, apart, squared = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for i in range(3):
                step = vertices[n, i] - vertices[v, i]
                alike += normals[v, i] * normals[n, i]
                apart += normals[v, i] * step
                squared += step * step
            if alike > same_side and abs(apart) <= same_m and squared <= far_m * far_m:
                out[v] |= kept[n]
                weight = max(quality[n], np.float32(0.0)) ** 2
                total += weight
                off += weight * apart
        kept[v] = not out[v]
        for i in range(3):
            consensus[v, i] += normals[v, i] * off / total
    return out, consensus


@njit(nogil=True, cache=True, error_model="numpy")
def _outline_apart(v, j, vertices, normals, eyes, images, outline, same_m, far_m):  # type: ignore[no-untyped-def]
    """How far view j's outline is from vertex v along its normal [m], where j looks along the surface; 0: not known.

    Along the normal it is across j's rays, and there an outline is true to a fraction of a pixel.
    """
    pixels, _, at, grids, stride = images
    along, squared, apart = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for i in range(3):
        ray = eyes[j, i] - vertices[v, i]
        along += normals[v, i] * ray
        squared += ray * ray
    if along * along > TURNED_AWAY * TURNED_AWAY * squared:
        return apart
    nearest = far_m * far_m
    for down in range(-1, 2):
        for right in range(-1, 2):
            n = _vertex_at(at, grids, j, pixels[j, v, 0], pixels[j, v, 1], stride, down, right)
            if n < 0 or not outline[n]:
                continue
            distance, off = np.float32(0.0), np.float32(0.0)
            for i in range(3):
                step = vertices[n, i] - vertices[v, i]
                distance += step * step
                off += normals[v, i] * step
            if distance < nearest and abs(off) < same_m:
                nearest, apart = distance, off
    return apart


@njit(nogil=True, cache=True, error_model="numpy")
def _vertex_at(at, grids, j, x, y, stride, down, right):  # type: ignore[no-untyped-def]
    """The vertex in the square of view j's pixel (x, y), or so many ``down`` and ``right`` of it; -1 if none."""
    r = np.int64(np.floor((y + np.float32(0.5)) / stride)) + down
    c = np.int64(np.floor((x + np.float32(0.5)) / stride)) + right
    if r < 0 or c < 0 or r >= grids[j, 1] or c >= grids[j, 2]:
        return np.int32(-1)
    return at[grids[j, 0] + r * grids[j, 2] + c]


@njit(nogil=True, cache=True, error_model="numpy")
def _all_kept(faces, redundant):  # type: ignore[no-untyped-def]
    """Mask (F,) of the triangles without a redundant corner."""
    out = np.empty(len(faces), np.bool_)
    for f in range(len(faces)):
        out[f] = not (redundant[faces[f, 0]] or redundant[faces[f, 1]] or redundant[faces[f, 2]])
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _border(faces, count):  # type: ignore[no-untyped-def]
    """Mask (count,) of vertices whose triangles do not close around them.

    Around an inner vertex each neighbour comes once before and once after: sums of scattered numbers cancel.
    """
    sums = np.zeros(count, np.int64)
    for f in range(len(faces)):
        for k in range(3):
            following, previous = np.int64(faces[f, (k + 1) % 3]), np.int64(faces[f, (k + 2) % 3])
            sums[faces[f, k]] += (following * following + 1) * 2654435761 - (previous * previous + 1) * 2654435761
    return sums != 0


@njit(nogil=True, cache=True, error_model="numpy")
def _snapped(vertices, view_of, images, normals, border, squares, reach, same_side):  # type: ignore[no-untyped-def]
    """For each vertex the one whose place it takes (V,) int32: of an earlier view's border, the nearest; or itself."""
    pixels, depths, at, grids, stride = images
    leader = np.arange(len(view_of)).astype(np.int32)
    window = np.int64(np.ceil(reach))
    for v in range(len(view_of)):
        if not border[v]:
            continue
        limit = reach * squares[view_of[v]] * depths[view_of[v], v]
        nearest = limit * limit
        for j in range(view_of[v]):
            if depths[j, v] <= 0:
                continue
            for down in range(-window, window + 1):
                for right in range(-window, window + 1):
                    n = _vertex_at(at, grids, j, pixels[j, v, 0], pixels[j, v, 1], stride, down, right)
                    if n < 0 or not border[n] or leader[n] != n:
                        continue
                    x, y = vertices[n, 0] - vertices[v, 0], vertices[n, 1] - vertices[v, 1]
                    z = vertices[n, 2] - vertices[v, 2]
                    squared = x * x + y * y + z * z
                    alike = normals[v, 0] * normals[n, 0] + normals[v, 1] * normals[n, 1]
                    alike += normals[v, 2] * normals[n, 2]
                    if squared < nearest and alike > same_side:
                        nearest = squared
                        leader[v] = n
    return leader


@njit(nogil=True, cache=True, error_model="numpy")
def _unturned(vertices, placed, faces, leader):  # type: ignore[no-untyped-def]
    """Mask (F,) of triangles that still have three corners, and still face as they did."""
    out = np.ones(len(faces), np.bool_)
    before, after = np.empty(3, np.float32), np.empty(3, np.float32)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        la, lb, lc = leader[a], leader[b], leader[c]
        if la == a and lb == b and lc == c:
            continue
        if la in (lb, lc) or lb == lc:
            out[f] = False
            continue
        _normal(vertices, a, b, c, before)
        _normal(placed, a, b, c, after)
        out[f] = before[0] * after[0] + before[1] * after[1] + before[2] * after[2] > 0
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _normal(vertices, a, b, c, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = (vertices[b, j] - vertices[a, j]) * (vertices[c, k] - vertices[a, k])
        out[i] -= (vertices[b, k] - vertices[a, k]) * (vertices[c, j] - vertices[a, j])
