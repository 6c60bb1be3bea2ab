"""The regions r of DISPOSE Eq. (1)–(2): the links, with the thumb apart from the palm, and how much each counts.

Thumb, palm and foot are prone to capture errors: "reducing the ω values for these regions improves the result
significantly" (§5.2).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, LINK_NAMES, SIDES, Skeleton

# A region has its link's number, the palm that of the hand; the thumbs, which move with it, come after the links.
REGION_NAMES = (*(name.replace("hand", "palm") for name in LINK_NAMES), *(f"{side}_thumb" for side in SIDES))
REGION_COUNT = len(REGION_NAMES)
REGION_INDEX = {name: index for index, name in enumerate(REGION_NAMES)}
REGION_LINKS = np.array(
    [*range(len(LINK_NAMES)), *(LINK_INDEX[f"{side}_hand"] for side in SIDES)], np.uint8
)  # the link each region moves with

# The thumb lies beside the hand's bone, on the side that faces forward at rest: its ends as (along the hand's bone in
# its lengths, to the side in the hand's radii), and its radius in the hand's.
_THUMB_FROM, _THUMB_TO, _THUMB_RADIUS = (0.3, 0.9), (1.0, 1.8), 0.6

DEFAULT_WEIGHTS = {"thumb": 0.25, "palm": 0.5, "fingers": 0.25, "foot": 0.5, "toes": 0.25}


def default_region_weights() -> NDArray[np.float32]:
    """ω (R,) float32: 1, less for the regions prone to capture errors."""
    return region_weights({})


def region_weights(weights: Mapping[str, float]) -> NDArray[np.float32]:
    """ω (R,) float32 with ``weights`` in place of the defaults.

    A name is a region's ("left_thumb") or that of both sides' ("thumb"); a side's own goes before both sides'.

    Raises:
        ValueError: a name that is no region's, or a weight that is negative, not finite or above 10.
    """
    omega = np.ones(REGION_COUNT, np.float32)
    for table in (DEFAULT_WEIGHTS, weights):
        for name, weight in sorted(table.items(), key=lambda item: item[0] in REGION_INDEX):
            regions = [REGION_INDEX[r] for r in (name, *(f"{side}_{name}" for side in SIDES)) if r in REGION_INDEX]
            if not regions:
                raise ValueError(f"region_weights: no region {name!r}; there are {', '.join(_short_names())}")
            if not 0 <= weight <= 10:
                raise ValueError(f"region_weights: {name} = {weight} is outside 0..10")
            omega[regions] = weight
    if not omega.any():
        raise ValueError("region_weights: every region weighs 0")
    return omega


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


def _short_names() -> list[str]:
    sides = tuple(f"{side}_" for side in SIDES)
    return list(dict.fromkeys(name.removeprefix(sides[0]).removeprefix(sides[1]) for name in REGION_NAMES))


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
