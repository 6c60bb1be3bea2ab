"""A coloured, oriented point cloud in the world frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """``positions`` (N, 3) float32 [m, world]; ``normals`` (N, 3) float32 unit, towards the camera that saw the
    point; ``colours`` (N, 3) uint8 RGB."""

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    colours: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.positions)
