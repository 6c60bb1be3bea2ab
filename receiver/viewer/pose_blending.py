"""The mean of several poses' pictures: what is wrong with one of them alone is not wrong with the others.

Each candidate pose, moved to one skeleton, errs in its own way: noise in its depth, an outline a pixel off, a hole that
no camera saw. Their mean errs less than the best of them, and changes less when the choice does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

Picture = tuple[NDArray[np.uint8], NDArray[np.float32]]


def blended(pictures: Sequence[Picture]) -> Picture:
    """The mean of pictures (colour (H, W, 3) uint8, depth (H, W) float32 [m], 0 = nothing).

    Depth is that of the first picture that has any there, where at least half of them show something.
    """
    if len(pictures) == 1:
        return pictures[0]
    colours = np.stack([colour for colour, _ in pictures])
    depths = np.stack([depth for _, depth in pictures])
    colour, depth = np.empty_like(colours[0]), np.empty_like(depths[0])
    _blend(colours, depths, colour, depth)
    return colour, depth


@njit(nogil=True, cache=True, error_model="numpy")
def _blend(colours, depths, colour, depth):  # type: ignore[no-untyped-def]
    share = np.float32(1.0 / len(colours))
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            covered, first = np.float32(0), np.float32(0)
            r = g = b = np.float32(0.5)
            for n in range(len(colours)):
                z = depths[n, v, u]
                r += share * colours[n, v, u, 0]
                g += share * colours[n, v, u, 1]
                b += share * colours[n, v, u, 2]
                covered += share if z > 0 else np.float32(0)
                first = z if first == 0 else first
            colour[v, u, 0], colour[v, u, 1], colour[v, u, 2] = np.uint8(r), np.uint8(g), np.uint8(b)
            depth[v, u] = first if covered >= np.float32(0.499) else np.float32(0)
