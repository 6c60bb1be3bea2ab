"""One camera's look at the person: the cropped depth and colour that candidate poses are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The person's pixels of one camera, cropped.

    ``u0, v0``: pixel of the crop's top left corner in the camera's image.
    ``depth_mm`` (h, w) uint16 [mm along the optical axis], 0 = not the person.
    ``colour`` (h, w, 3) uint8 RGB, registered to the depth.
    ``complete``: its outline was found in colour, too, so that nothing of the person is missing at it.
    """

    camera: Camera
    u0: int
    v0: int
    depth_mm: NDArray[np.uint16]
    colour: NDArray[np.uint8]
    complete: bool = False

    def __post_init__(self) -> None:
        h, w = self.depth_mm.shape
        if self.colour.shape != (h, w, 3):
            raise ValueError(f"view {self.camera.name}: colour {self.colour.shape} does not match depth {(h, w)}")
        if self.u0 < 0 or self.v0 < 0 or self.u0 + w > self.camera.width or self.v0 + h > self.camera.height:
            raise ValueError(f"view {self.camera.name}: crop {(self.u0, self.v0, w, h)} is outside the image")
