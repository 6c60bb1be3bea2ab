"""Coloured points that hang on links, each in its own link's frame: any pose moves them rigidly (Lien §5.1's P_l)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

SPLAT_RADIUS_M = 0.012  # of the round splat a point is drawn as: closes the gaps between 10 000 on a body


@dataclass(frozen=True, slots=True, eq=False)
class LinkPoints:
    """``positions`` (N, 3) float32 [m, in the frame of the point's link], ``links`` (N,) uint8, ``colours`` (N, 3)
    uint8 RGB."""

    positions: NDArray[np.float32]
    links: NDArray[np.uint8]
    colours: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.positions)

    def posed(self, T_world_link: NDArray[np.float32]) -> NDArray[np.float32]:
        """Where the points are (N, 3) [m, world] with links at ``T_world_link`` (L, 3 or 4, 4)."""
        out = np.empty_like(self.positions)
        _move(self.positions, self.links, np.ascontiguousarray(T_world_link, np.float32), out)
        return out


@njit(nogil=True, cache=True, error_model="numpy")
def _move(positions, links, T_world_link, out):  # type: ignore[no-untyped-def]
    for n in range(len(positions)):
        T = T_world_link[links[n]]
        for i in range(3):
            out[n, i] = T[i, 0] * positions[n, 0] + T[i, 1] * positions[n, 1] + T[i, 2] * positions[n, 2] + T[i, 3]
