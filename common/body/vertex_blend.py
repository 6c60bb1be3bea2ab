"""Which second link moves a vertex near a joint, and how much: the weights of blend skinning.

A segment is rigid but for a narrow band at its joints, across which the weight goes over to the neighbour smoothly:
wider bands shrink the limb (measured: 0.3 of the thickness loses nothing in the picture, 1.0 loses 0.1 dB).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.link_segmentation import bone_metric
from common.body.skeleton import LINK_COUNT, LINK_PARENTS, Skeleton

BAND = 0.3  # of a link's thickness, either side of the border


@dataclass(frozen=True, slots=True, eq=False)
class VertexBlend:
    """``other`` (V,) uint8: the neighbouring link; ``share`` (V,) uint8: its part of the motion in 1/255, at most
    127; ``joint`` (V,) uint8: the one of the two links whose joint lies between them."""

    other: NDArray[np.uint8]
    share: NDArray[np.uint8]
    joint: NDArray[np.uint8]


def vertex_blend(
    vertices: NDArray[np.float32],
    vertex_link: NDArray[np.uint8],
    skeleton: Skeleton,
    T_world_link: NDArray[np.float32],
) -> VertexBlend:
    """Blend of each vertex (V, 3) [m, world], whose own link is ``vertex_link`` (V,); ``T_world_link`` (L, 4, 4)."""
    metric = bone_metric(skeleton, T_world_link)
    other, share = _blend(vertices, vertex_link, _NEIGHBOURS, np.float32(BAND), metric)
    return VertexBlend(other, share, np.where(_PARENTS[vertex_link] == other, vertex_link, other).astype(np.uint8))


def _neighbours() -> NDArray[np.int64]:
    """The links joined to each (L, N), in order; -1 beyond the last."""
    joined: list[list[int]] = [[] for _ in range(LINK_COUNT)]
    for link, parent in enumerate(LINK_PARENTS[1:], start=1):
        joined[link].append(parent)
        joined[parent].append(link)
    out = np.full((LINK_COUNT, max(map(len, joined))), -1)
    for link, others in enumerate(joined):
        out[link, : len(others)] = sorted(others)
    return out


_NEIGHBOURS, _PARENTS = _neighbours(), np.array(LINK_PARENTS)


@njit(nogil=True, cache=True, error_model="numpy")
def _blend(vertices, own, neighbours, band, metric):  # type: ignore[no-untyped-def]
    starts, axes, lengths, per_thickness2, per_cap2 = metric
    other, share = np.empty(len(vertices), np.uint8), np.empty(len(vertices), np.uint8)
    for v in range(len(vertices)):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        mine = _distance(x, y, z, np.int64(own[v]), starts, axes, lengths, per_thickness2, per_cap2)
        nearest = np.float32(np.inf)
        for link in neighbours[own[v]]:
            if link < 0:
                break
            distance = _distance(x, y, z, link, starts, axes, lengths, per_thickness2, per_cap2)
            if distance < nearest:
                nearest = distance
                other[v] = link
        t = min(max((nearest - mine) / band, np.float32(0.0)), np.float32(1.0))
        share[v] = np.uint8(np.float32(127.0) * (1 - t * t * (3 - 2 * t)))
    return other, share


@njit(nogil=True, cache=True, error_model="numpy")
def _distance(x, y, z, link, starts, axes, lengths, per_thickness2, per_cap2):  # type: ignore[no-untyped-def]
    """Distance to a bone in its thicknesses (``bone_metric``)."""
    x, y, z = x - starts[link, 0], y - starts[link, 1], z - starts[link, 2]
    along = x * axes[link, 0] + y * axes[link, 1] + z * axes[link, 2]
    across = max(x * x + y * y + z * z - along * along, np.float32(0.0))
    beyond = max(-along, along - lengths[link], np.float32(0.0))
    return np.sqrt(across * per_thickness2[link] + beyond * beyond * per_cap2[link])
