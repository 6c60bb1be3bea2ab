"""Which link a pixel belongs to: seeded region growing on the depth image (Adams & Bischof 1994; DISPOSE §3).

Seeds are the projected links. Regions grow from pixel to pixel, always to the one that fits its region best, so each
region stays connected to its seeds, and surfaces that only hide one another are entered last. What Voronoi cells do
not know: a hand before the thigh takes no part of it.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.link_segmentation import bone_metric, nearest_link
from common.body.skeleton import Skeleton
from common.body.skeleton_pose import bone_segments
from common.body.view import View
from common.geometry.camera_model import project
from common.geometry.triangle_mesh import TriangleMesh

SEED_STEP_M = 0.01  # along a bone
SEEDS_BESIDE = (0.0, -0.7, 0.7)  # and beside it, in the link's radii: an arm hides the middle of the trunk behind it
DEPTH_STEP_M = 0.03  # a step in depth to the neighbour counts like leaving the bone by the link's thickness
_BUCKETS = 256
_BUCKETS_PER_THICKNESS = 48.0
_NOT_REACHED = 255


def grown_regions(
    view: View, mesh: TriangleMesh, stride: int, skeleton: Skeleton, T_world_link: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Link (V,) uint8 of each vertex of one view's mesh (``mesh_view`` with this ``stride``: one in a square).

    A pixel's δ to a region is its distance to the link's bone in thicknesses (``bone_metric``) together with the step
    in depth to the neighbour it is reached from; the paper's region mean would not do, for a limb has no one depth.
    Surfaces that no seed is connected to go to the nearest link. ``T_world_link`` (L, 4, 4): the posed links.
    """
    links = np.full(len(mesh.vertices), _NOT_REACHED, np.uint8)
    if len(links):
        at, cells = _image_grid(view, mesh, stride)
        forward = view.camera.T_world_camera[:3, 2].astype(np.float32)
        depth = mesh.vertices @ forward
        metric = bone_metric(skeleton, T_world_link)
        _plant(links, at, view, mesh, stride, skeleton, T_world_link)
        _grow(links, at, cells, mesh.vertices, depth, np.float32(DEPTH_STEP_M**-2), metric)
        lost = links == _NOT_REACHED
        links[lost] = nearest_link(mesh.vertices[lost], skeleton, T_world_link)
    return links


def _image_grid(view: View, mesh: TriangleMesh, stride: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The vertex in each square of the image, -1 where there is none, and each vertex's square (V, 2): row, column."""
    h, w = view.depth_mm.shape
    pixels = (mesh.uv * np.array([w, h], np.float32)).astype(np.int32)
    cells = np.ascontiguousarray(pixels[:, ::-1] // stride)
    at = np.full((-(-h // stride), -(-w // stride)), -1, np.int32)
    at[cells[:, 0], cells[:, 1]] = np.arange(len(cells))
    return at, cells


def _plant(
    links: NDArray[np.uint8],
    at: NDArray[np.int32],
    view: View,
    mesh: TriangleMesh,
    stride: int,
    skeleton: Skeleton,
    T_world_link: NDArray[np.float32],
) -> None:
    """Seeds: the pixels that a link projects to, where what is seen there is that link's own surface."""
    starts, ends = bone_segments(skeleton, T_world_link)
    bones = ends - starts
    across = np.cross(bones, (starts - view.camera.T_world_camera[:3, 3]).astype(np.float32))
    across *= (skeleton.radii / np.maximum(np.linalg.norm(across, axis=1), 1e-9))[:, None]
    counts = 2 + (np.linalg.norm(bones, axis=1) / SEED_STEP_M).astype(int)
    of = np.repeat(np.arange(len(starts)), counts)
    share = ((np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)) / (counts - 1)[of])[:, None]
    middle, aside = starts[of] + share * bones[of], across[of]
    pixels, depth = project(view.camera, np.concatenate([middle + beside * aside for beside in SEEDS_BESIDE]))
    of = np.tile(of, len(SEEDS_BESIDE))
    row, column = ((np.rint(pixels[:, k]) - (view.v0, view.u0)[1 - k]) // stride for k in (1, 0))
    inside = (depth > 0) & (row >= 0) & (row < at.shape[0]) & (column >= 0) & (column < at.shape[1])
    of, vertex = of[inside], at[row[inside].astype(int), column[inside].astype(int)]
    of, vertex = of[vertex >= 0], vertex[vertex >= 0]
    own = nearest_link(mesh.vertices[vertex], skeleton, T_world_link) == of
    links[vertex[own]] = of[own]


@njit(nogil=True, cache=True, error_model="numpy")
def _grow(links, at, cells, vertices, depth, per_step_squared, metric):  # type: ignore[no-untyped-def]
    """Adams & Bischof's sequentially sorted list as buckets of δ, each a chain of entries (vertex, region)."""
    first = np.full(_BUCKETS, -1, np.int32)
    following, entry_vertex = np.empty(5 * len(links), np.int32), np.empty(5 * len(links), np.int32)
    entry_link = np.empty(5 * len(links), np.uint8)
    count = 0
    for v in range(len(links)):
        if links[v] != _NOT_REACHED:  # seeds come first of all
            following[count], entry_vertex[count], entry_link[count] = first[0], v, links[v]
            first[0] = count
            count += 1
            links[v] = _NOT_REACHED
    bucket = 0
    while bucket < _BUCKETS:
        entry = first[bucket]
        if entry < 0:
            bucket += 1
            continue
        first[bucket] = following[entry]
        v, link = entry_vertex[entry], entry_link[entry]
        if links[v] != _NOT_REACHED:
            continue
        links[v] = link
        for k in range(4):
            r, c = cells[v, 0] + (k == 0) - (k == 1), cells[v, 1] + (k == 2) - (k == 3)
            if r < 0 or c < 0 or r >= at.shape[0] or c >= at.shape[1]:
                continue
            n = at[r, c]
            if n < 0 or links[n] != _NOT_REACHED:
                continue
            step = depth[n] - depth[v]
            delta = np.sqrt(_distance_squared(vertices[n], link, metric) + step * step * per_step_squared)
            place = min(int(delta * np.float32(_BUCKETS_PER_THICKNESS)), _BUCKETS - 1)
            following[count], entry_vertex[count], entry_link[count] = first[place], n, link
            first[place] = count
            count += 1
            bucket = min(bucket, place)


@njit(nogil=True, cache=True, error_model="numpy")
def _distance_squared(point, link, metric):  # type: ignore[no-untyped-def]
    """To the link's bone, in its thicknesses, as ``nearest_link`` measures it."""
    starts, axes, lengths, per_thickness_squared, per_cap_squared = metric
    x, y, z = point[0] - starts[link, 0], point[1] - starts[link, 1], point[2] - starts[link, 2]
    along = x * axes[link, 0] + y * axes[link, 1] + z * axes[link, 2]
    across_squared = max(x * x + y * y + z * z - along * along, np.float32(0.0))
    beyond = max(-along, along - lengths[link], np.float32(0.0))
    return across_squared * per_thickness_squared[link] + beyond * beyond * per_cap_squared[link]
