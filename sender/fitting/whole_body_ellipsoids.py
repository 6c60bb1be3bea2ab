"""A whole body of ellipsoids on the link tree: what the particle tracker fits (beyond Rao & Hodges, who track limbs).

A limb's ellipsoids are round and a little longer than its bones; a trunk is wider than deep. Shares are of the bone's
length and of the link's radius; they are anatomy's (Drillis & Contini's outlines), not fitted to any recording.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, SIDES, Skeleton
from common.geometry import quaternion

Array = NDArray[Any]


class Ellipsoids(NamedTuple):
    """E ellipsoids. ``links`` (E,) int64: the link each moves with. ``centres`` (E, 3) float64 [m] and ``directions``
    (E, 3, 3) (columns: the principal directions) in the link's frame; ``axes`` (E, 3) [m]: the semi-axes."""

    links: Array
    centres: Array
    directions: Array
    axes: Array


# part: along the bone from and to [shares of its length], across and deep [of the link's radius]
_BONES = {
    "neck": (-0.5, 1.5, 1.1, 1.1),
    "clavicle": (0.1, 1.25, 1.0, 1.0),
    "upper_arm": (-0.1, 1.1, 1.1, 1.1),
    "forearm": (-0.1, 1.1, 1.05, 1.05),
    "hand": (-0.1, 1.0, 0.7, 1.3),
    "thigh": (-0.2, 1.1, 1.15, 1.15),
    "shin": (-0.1, 1.1, 1.15, 1.15),
    "foot": (0.0, 1.0, 1.1, 1.1),
}
_LONGER = {"hand": "fingers", "foot": "toes"}  # one ellipsoid for both links
_HEEL = np.array([0.0, 0.8, -0.32])  # behind and below the ankle, in shares of the way to the tips of the toes
_HIP_RADII = 0.8  # of a thigh, that the pelvis is wider than the hip joints


def whole_body_ellipsoids(skeleton: Skeleton) -> Ellipsoids:
    """The ellipsoids of a person of these sizes: 5 from pelvis to head, 7 on each side."""
    rows = _trunk(skeleton)
    for name in ("neck", *(f"{side}_{part}" for side in SIDES for part in _BONES if part != "neck")):
        rows.append(_bone(skeleton, name))
    links, centres, directions, axes = zip(*rows, strict=True)
    return Ellipsoids(np.array(links), np.array(centres), np.array(directions), np.array(axes))


def _trunk(skeleton: Skeleton) -> list[tuple[int, Array, Array, Array]]:
    offsets, radii = skeleton.offsets.astype(np.float64), skeleton.radii.astype(np.float64)
    pelvis, waist, chest, head = (LINK_INDEX[name] for name in ("pelvis", "lower_spine", "upper_spine", "head"))
    thigh = LINK_INDEX["left_thigh"]
    hips = abs(offsets[thigh, 0]) + _HIP_RADII * radii[thigh]
    low, middle, high = (np.linalg.norm(offsets[LINK_INDEX[n]]) for n in ("lower_spine", "upper_spine", "neck"))
    crown = np.linalg.norm(skeleton.tips[head])
    shapes = (
        (pelvis, (0.0, 0.1 * low, 0.0), (hips, 1.2 * low, 0.85 * radii[pelvis])),
        (waist, (0.0, 0.5 * middle, 0.1 * radii[waist]), (1.05 * radii[waist], 0.8 * middle, 0.75 * radii[waist])),
        (chest, (0.0, 0.4 * high, 0.05 * radii[chest]), (1.08 * radii[chest], 0.75 * high, 0.75 * radii[chest])),
        (head, (0.0, 0.42 * crown, 0.15 * radii[head]), (0.95 * radii[head], 0.68 * crown, 1.2 * radii[head])),
    )
    return [(link, np.array(centre), np.eye(3), np.array(axes)) for link, centre, axes in shapes]


def _bone(skeleton: Skeleton, name: str) -> tuple[int, Array, Array, Array]:
    """Second direction along the bone."""
    side, _, part = name.rpartition("_") if name == "neck" else name.partition("_")
    link, part = LINK_INDEX[name], part or name
    start, end, across, deep = _BONES[part]
    bone = skeleton.tips[link].astype(np.float64)
    if part in _LONGER:
        bone = bone + skeleton.tips[LINK_INDEX[f"{side}_{_LONGER[part]}"]]
    origin = _HEEL * bone if part == "foot" else np.zeros(3)
    bone = bone - origin
    length, radius = float(np.linalg.norm(bone)), float(skeleton.radii[link])
    directions = quaternion.to_matrix(quaternion.shortest_arc(np.array([0.0, 1.0, 0.0]), bone))
    axes = np.array([across * radius, (end - start) / 2 * length, deep * radius])
    return link, origin + bone * (start + end) / 2, np.asarray(directions), axes


@njit(nogil=True, cache=True, error_model="numpy")
def unit_maps(R: Array, t: Array, ellipsoids: Ellipsoids, out: Array) -> None:
    """Writes into ``out`` (E, 3, 4) the affine maps from the world [m] to the frames in which the ellipsoids are unit
    balls; ``R`` (L, 3, 3), ``t`` (L, 3) [m]: link frames in the world."""
    for e in range(len(ellipsoids.links)):
        link = ellipsoids.links[e]
        for k in range(3):
            shift = 0.0
            for j in range(3):
                shift -= ellipsoids.directions[e, j, k] * ellipsoids.centres[e, j]
            for i in range(3):
                m = 0.0
                for j in range(3):
                    m += R[link, i, j] * ellipsoids.directions[e, j, k]
                out[e, k, i] = m / ellipsoids.axes[e, k]
                shift -= m * t[link, i]
            out[e, k, 3] = shift / ellipsoids.axes[e, k]
