"""Which link a surface point belongs to: the Voronoi segmentation of DISPOSE §3 on the posed skeleton."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import Skeleton
from common.body.skeleton_pose import bone_segments

FLESH_M = 0.02  # cloth and flesh beyond the cylinder: without it a thick link claims its thin neighbours' surface
CAP_M = 0.05  # a cylinder's reach beyond its ends: with the torso's own radius it would claim neck and jaw
_BLOCK = 1024  # vertices


def nearest_link(
    vertices: NDArray[np.float32], skeleton: Skeleton, T_world_link: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Link (V,) uint8 of each vertex (V, 3) [m, world]: the smallest distance to the bone relative to its thickness.

    ``T_world_link`` (L, 4, 4): the posed links (``forward_kinematics``). The distance is (across / thickness)² +
    (beyond the end / cap)²; thickness is the radius and 2 cm of flesh, so that a thick torso reaches its own surface
    before a thin arm beside it does; the cap is at most 5 cm.
    """
    return _nearest(vertices, *bone_metric(skeleton, T_world_link))


def bone_metric(skeleton: Skeleton, T_world_link: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """What distances to bones are measured by: starts (L, 3) [m, world], axes (L, 3), lengths (L,) [m], and one over
    the squares of thickness and cap (L,), (L,) [m⁻²]."""
    starts, ends = bone_segments(skeleton, T_world_link)
    lengths = np.maximum(np.linalg.norm(ends - starts, axis=1), np.float32(1e-6))
    thickness = skeleton.radii + np.float32(FLESH_M)
    caps = np.minimum(thickness, np.float32(CAP_M))
    return starts, (ends - starts) / lengths[:, None], lengths, thickness**-2, caps**-2


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest(vertices, starts, axes, lengths, per_thickness_squared, per_cap_squared):  # type: ignore[no-untyped-def]
    """Block by block, which the cache holds, and link by link: the innermost loop is one the compiler can vectorise."""
    links = np.zeros(len(vertices), np.uint8)
    points, best = np.empty((3, _BLOCK), np.float32), np.empty(_BLOCK, np.float32)
    for first in range(0, len(vertices), _BLOCK):
        block = links[first : first + _BLOCK]
        for i in range(3):
            points[i, : len(block)] = vertices[first : first + _BLOCK, i]
        best[:] = np.inf
        x, y, z = points[0, : len(block)], points[1, : len(block)], points[2, : len(block)]
        for link in range(len(starts)):
            bone = starts[link], axes[link], lengths[link], per_thickness_squared[link], per_cap_squared[link]
            _take_nearer(x, y, z, np.uint8(link), bone, best[: len(block)], block)
    return links


@njit(nogil=True, cache=True, error_model="numpy")
def _take_nearer(xs, ys, zs, link, bone, best, links):  # type: ignore[no-untyped-def]
    """Enter a link where it is nearer than the best so far, and its distance."""
    start, axis, length, per_thickness_squared, per_cap_squared = bone
    sx, sy, sz, ax, ay, az = start[0], start[1], start[2], axis[0], axis[1], axis[2]
    for v in range(len(links)):
        x, y, z = xs[v] - sx, ys[v] - sy, zs[v] - sz
        along = x * ax + y * ay + z * az
        across_squared = x * x + y * y + z * z - along * along
        beyond = max(-along, along - length, np.float32(0.0))
        distance = across_squared * per_thickness_squared + beyond * beyond * per_cap_squared
        nearer = distance < best[v]
        best[v] = distance if nearer else best[v]
        links[v] = link if nearer else links[v]
