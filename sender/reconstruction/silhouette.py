"""Which pixels are people, for a colour camera without depth, as a mask that a pinhole camera would see.

Rao & Hodges subtract the background from each camera's picture. Here OpenCV's mixture of Gaussians per pixel
(Zivkovic 2004, with its test for shadows) learns the empty room; a recording may bring silhouettes of its own
instead. Lens distortion is taken out of the masks once, so that lines in space are straight lines in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from sender.capture.frame_set import ColourFrame

BACKGROUND, PERSON = 0, 255
_SHADOW = 127  # MOG2's own mark


@dataclass(frozen=True, slots=True, eq=False)
class Silhouette:
    """The people in one camera's view. ``camera``: a pinhole, no distortion. ``mask`` (H, W) uint8: ``PERSON`` or
    ``BACKGROUND``."""

    camera: Camera
    mask: NDArray[np.uint8]

    def __post_init__(self) -> None:
        if self.mask.shape != (self.camera.height, self.camera.width) or self.mask.dtype != np.uint8:
            raise ValueError(f"silhouette of {self.camera.name}: {self.mask.dtype} {self.mask.shape} is not its image")
        if self.camera.distortion.any():
            raise ValueError(f"silhouette of {self.camera.name}: its camera is not a pinhole")


@dataclass(frozen=True, slots=True)
class SilhouetteSettings:
    """``longest_px``: images are worked on at this size at most. ``deviations``: distance to the room's colours in σ
    from which a pixel is a person. ``darkest_shadow``: brightness a shadow leaves of the room's, at least.
    ``speck_px``: width of what is too thin to be a limb. ``least_share``: islands below this share of the largest, and
    holes below it, are mistakes."""

    longest_px: int = 320
    deviations: float = 5.0
    darkest_shadow: float = 0.5
    speck_px: int = 3
    least_share: float = 0.02


def pinhole_of(camera: Camera, longest_px: int) -> Camera:
    """A camera without distortion that sees nothing that ``camera`` does not see (of a bulging picture the corners are
    lost), at most ``longest_px`` [pixels] long."""
    scale = min(longest_px / max(camera.width, camera.height), 1.0)
    width, height = max(round(camera.width * scale), 1), max(round(camera.height * scale), 1)
    if camera.distortion.any():
        size = camera.width, camera.height
        matrix, _ = cv2.getOptimalNewCameraMatrix(camera.matrix, camera.distortion, size, 0.0, size)
    else:
        matrix = camera.matrix
    across, down = width / camera.width, height / camera.height
    fx, fy = float(matrix[0, 0]) * across, float(matrix[1, 1]) * down
    cx, cy = (float(matrix[0, 2]) + 0.5) * across - 0.5, (float(matrix[1, 2]) + 0.5) * down - 0.5
    return Camera(camera.name, width, height, fx, fy, cx, cy, camera.T_world_camera)


class SilhouetteModel:
    """The silhouettes of one camera. ``empty_room`` (F, H, W, 3) uint8 RGB: frames of it without people; None for a
    source that brings silhouettes.

    Raises:
        ValueError: the empty room does not have the camera's size, or shows nothing.
    """

    def __init__(
        self, camera: Camera, empty_room: NDArray[np.uint8] | None, settings: SilhouetteSettings | None = None
    ) -> None:
        self._settings = s = settings or SilhouetteSettings()
        self._camera = camera
        self.pinhole = pinhole_of(camera, s.longest_px)
        self._size = self.pinhole.width, self.pinhole.height
        self._columns, self._rows = cv2.initUndistortRectifyMap(
            *_scaled(camera, *self._size), np.eye(3), self.pinhole.matrix, self._size, cv2.CV_16SC2
        )
        self._subtractor: cv2.BackgroundSubtractorMOG2 | None = None
        if empty_room is None:
            return
        if empty_room.ndim != 4 or len(empty_room) < 1 or empty_room.shape[1:] != (camera.height, camera.width, 3):
            raise ValueError(f"camera {camera.name}: empty room {empty_room.shape}, not frames of the camera's size")
        self._subtractor = cv2.createBackgroundSubtractorMOG2(len(empty_room), s.deviations**2, detectShadows=True)
        self._subtractor.setShadowThreshold(s.darkest_shadow)
        for frame in empty_room:
            self._subtractor.apply(self._reduced(frame))

    def silhouette(self, frame: ColourFrame) -> Silhouette:
        """The people in ``frame``: its own silhouette where it has one, else what differs from the empty room.

        The room is not learned any further: somebody who stands still must not become part of it.

        Raises:
            ValueError: the frame does not have the camera's size, or neither a silhouette nor a room to compare with.
        """
        camera = self._camera
        if frame.shape != (camera.height, camera.width):
            raise ValueError(f"camera {camera.name}: frame {frame.shape}, camera {(camera.height, camera.width)}")
        if frame.silhouette is not None:
            mask = np.where(self._reduced(frame.silhouette) >= 128, PERSON, BACKGROUND).astype(np.uint8)
        elif self._subtractor is not None and frame.colour is not None:
            marked = np.asarray(self._subtractor.apply(self._reduced(frame.colour), learningRate=0.0), np.uint8)
            mask = cleaned(np.where(marked > _SHADOW, PERSON, BACKGROUND).astype(np.uint8), self._settings)
        else:
            raise ValueError(f"camera {camera.name}: neither a silhouette nor a picture of the empty room")
        return Silhouette(self.pinhole, self._straightened(mask))

    def _reduced(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if image.shape[1::-1] == self._size:
            return image
        return np.asarray(cv2.resize(image, self._size, interpolation=cv2.INTER_AREA), np.uint8)

    def _straightened(self, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if not self._camera.distortion.any():
            return mask
        straight = cv2.remap(mask, self._columns, self._rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(straight, np.uint8)


def cleaned(mask: NDArray[np.uint8], settings: SilhouetteSettings) -> NDArray[np.uint8]:
    """The mask (H, W) uint8 (``PERSON`` or ``BACKGROUND``) without specks, small islands and small holes."""
    brush = np.ones((settings.speck_px, settings.speck_px), np.uint8)
    opened = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, brush), np.uint8)
    outlines, _ = cv2.findContours(opened, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)  # of islands, and of their holes
    areas = [cv2.contourArea(outline) for outline in outlines]
    least = settings.least_share * max(areas, default=0.0)
    large = [outline for outline, area in zip(outlines, areas, strict=True) if area >= least]
    out = np.zeros_like(mask)
    cv2.drawContours(out, large, -1, PERSON, cv2.FILLED)  # inside an odd number of outlines
    return out


def _scaled(camera: Camera, width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matrix and distortion of the real camera at the size worked on."""
    across, down = width / camera.width, height / camera.height
    matrix = camera.matrix
    matrix[0] *= across
    matrix[1] *= down
    matrix[0, 2] += (across - 1) / 2
    matrix[1, 2] += (down - 1) / 2
    return matrix, camera.distortion
