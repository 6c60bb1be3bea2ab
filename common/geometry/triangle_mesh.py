"""A triangle mesh with vertex colours in the world frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """``vertices`` (V, 3) float32 [m, world]; ``faces`` (F, 3) int32, counter-clockwise seen from outside;
    ``colours`` (V, 3) uint8 RGB."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    colours: NDArray[np.uint8]
