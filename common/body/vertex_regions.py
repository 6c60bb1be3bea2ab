"""Which region of the body each vertex is in: its link's, and at a hand the palm's or the thumb's."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.body_regions import REGION_INDEX
from common.body.skeleton import LINK_INDEX, SIDES, Skeleton

# The thumb lies beside the hand's bone, on the side that faces forward at rest: its ends as (along the hand's bone in
# its lengths, to the side in the hand's radii), and its radius in the hand's.
_THUMB_FROM, _THUMB_TO, _THUMB_RADIUS = (0.3, 0.9), (1.0, 1.8), 0.6


def vertex_regions(
    vertices: NDArray[np.float32],
    vertex_link: NDArray[np.uint8],
    skeleton: Skeleton,
    T_link_world: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Region (V,) uint8 of each vertex (V, 3) [m, world] of link ``vertex_link`` (V,); ``T_link_world`` (L, 4, 4).

    A hand's vertex is the thumb's if it is nearer to the thumb's bone than to the hand's, in their thicknesses.
    """
    regions = vertex_link.copy()
    for side in SIDES:
        hand, thumb_region = LINK_INDEX[f"{side}_hand"], REGION_INDEX[f"{side}_thumb"]
        radius, tip = skeleton.radii[hand], skeleton.tips[hand]
        forward = np.array([0, 0, radius], np.float32)
        (a, b), (c, d) = _THUMB_FROM, _THUMB_TO
        thumb = np.stack([a * tip + b * forward, c * tip + d * forward]).astype(np.float32)
        bone = np.stack([0 * tip, tip])
        to_hand = T_link_world[hand, :3].astype(np.float32)
        thickness = (radius, np.float32(_THUMB_RADIUS) * radius)
        _set_thumb(regions, vertices, vertex_link, hand, thumb_region, to_hand, bone, thumb, thickness)
    return regions


@njit(nogil=True, cache=True, error_model="numpy")
def _set_thumb(regions, vertices, vertex_link, hand, thumb_region, to_hand, bone, thumb, thickness):  # type: ignore[no-untyped-def]
    point = np.empty(3, np.float32)
    for v in range(len(vertices)):
        if vertex_link[v] != hand:
            continue
        for i in range(3):
            point[i] = to_hand[i, 3]
            for j in range(3):
                point[i] += to_hand[i, j] * vertices[v, j]
        if _distance(point, thumb) / thickness[1] < _distance(point, bone) / thickness[0]:
            regions[v] = thumb_region


@njit(nogil=True, cache=True, error_model="numpy")
def _distance(point, segment):  # type: ignore[no-untyped-def]
    """Distance from a point (3,) to a segment (2, 3)."""
    along, length_squared = np.float32(0.0), np.float32(1e-12)
    for i in range(3):
        axis = segment[1, i] - segment[0, i]
        along += (point[i] - segment[0, i]) * axis
        length_squared += axis * axis
    share = min(max(along / length_squared, np.float32(0.0)), np.float32(1.0))
    squared = np.float32(0.0)
    for i in range(3):
        across = point[i] - segment[0, i] - share * (segment[1, i] - segment[0, i])
        squared += across * across
    return np.sqrt(squared)
