"""A textured triangle mesh in the world frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """``vertices`` (V, 3) float32 [m, world]; ``faces`` (F, 3) int32, counter-clockwise seen from outside;
    ``uv`` (V, 2) float32: place in the texture, 0..1 from its top left corner, the middle of pixel i at
    (i + 0.5) / size; ``texture`` (h, w, 3) uint8 RGB."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    uv: NDArray[np.float32]
    texture: NDArray[np.uint8]

    @property
    def surface(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """What ``rasterizer.render`` paints."""
        return self.uv, self.texture
