"""Which link a surface point belongs to: the Voronoi segmentation of DISPOSE §3 on the posed skeleton."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import Skeleton
from common.body.skeleton_pose import bone_segments

FLESH_M = 0.02  # cloth and flesh beyond the cylinder: without it a thick link claims its thin neighbours' surface


def nearest_link(
    vertices: NDArray[np.float32], skeleton: Skeleton, T_world_link: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Link (V,) uint8 of each vertex (V, 3) [m, world]: the smallest distance to the bone relative to its thickness.

    ``T_world_link`` (L, 4, 4): the posed links (``forward_kinematics``). Dividing by the radius (and 2 cm of flesh)
    lets a thick torso reach its own surface before a thin arm beside it does.
    """
    starts, ends = bone_segments(skeleton, T_world_link)
    axes = ends - starts
    lengths_squared = np.maximum(np.einsum("lk,lk->l", axes, axes), np.float32(1e-12))
    thickness = skeleton.radii + np.float32(FLESH_M)
    return _nearest(vertices, starts, axes, 1 / lengths_squared, 1 / (thickness * thickness))


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest(vertices, starts, axes, inverse_lengths_squared, inverse_thickness_squared):  # type: ignore[no-untyped-def]
    links = np.empty(len(vertices), np.uint8)
    for v in range(len(vertices)):
        best = np.float32(np.inf)
        for link in range(len(starts)):
            x = vertices[v, 0] - starts[link, 0]
            y = vertices[v, 1] - starts[link, 1]
            z = vertices[v, 2] - starts[link, 2]
            ax, ay, az = axes[link, 0], axes[link, 1], axes[link, 2]
            along = (x * ax + y * ay + z * az) * inverse_lengths_squared[link]
            along = min(max(along, np.float32(0.0)), np.float32(1.0))
            x, y, z = x - along * ax, y - along * ay, z - along * az
            distance = (x * x + y * y + z * z) * inverse_thickness_squared[link]
            if distance < best:
                best = distance
                links[v] = link
    return links
