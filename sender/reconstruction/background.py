"""Which pixels are the person: a background model per camera, on depth.

A modified Gaussian average (Lien 2009 §6.1; Piccardi 2004): mean and variance of the empty room per pixel, updated
slowly and only where the background shows. A person stands in front of the room, so a pixel is foreground when it is
nearer than the mean by more than k σ, never when it is farther. Of cameras with colour the outline can be completed
(``outline``).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.view import View
from common.geometry.camera_model import Camera
from sender.capture.frame_set import DepthFrame
from sender.reconstruction.outline import REACH, RoomColour, SeenView

UPDATE_STRIPES = 8  # a frame updates every eighth row: the model is slow anyway, and this keeps it cheap


@dataclass(frozen=True, slots=True)
class BackgroundSettings:
    """``near_m, far_m``: readings outside are ignored. ``deviations``: k, the distance to the mean in σ.
    ``noise_mm, noise_mm_per_m2``: the sensor's σ at depth z [m] is noise_mm + noise_mm_per_m2·z²: where the model's σ
    starts, and its lower bound. ``learning_rate``: weight of one reading in the mean. ``range_limit_mm``: how far
    neighbours on one surface may differ in depth, per metre of depth. ``minimum_pixels``: smaller islands are
    speckles. ``smooth``: average each depth with its neighbours. ``margin_px``: border of the crop, in which an
    outline that depth missed is found.
    """

    near_m: float = 0.3
    far_m: float = 6.0
    deviations: float = 3.5
    noise_mm: float = 1.5
    noise_mm_per_m2: float = 1.6
    learning_rate: float = 0.02
    range_limit_mm: float = 20.0
    minimum_pixels: int = 100
    smooth: bool = True
    margin_px: int = REACH + 1


@njit(nogil=True, cache=True)
def _update(depth, first_row, stripes, mean, variance, limit, far, rate, k, noise, noise_per_m2):  # type: ignore[no-untyped-def]
    """μ ← μ + α(d − μ), σ² ← σ² + α((d − μ)² − σ²) on background pixels of every ``stripes``-th row."""
    for r in range(first_row, depth.shape[0], stripes):
        for c in range(depth.shape[1]):
            d = np.float32(depth[r, c])
            if d <= limit[r, c] or mean[r, c] <= 0.0:  # the person, no reading, or nothing behind this pixel
                continue
            difference = d - mean[r, c]
            mean[r, c] += rate * difference
            floor = noise + noise_per_m2 * (mean[r, c] * 0.001) ** 2
            square = min(difference * difference, 25.0 * floor * floor)
            variance[r, c] = max(variance[r, c] + rate * (square - variance[r, c]), floor * floor)
            limit[r, c] = np.uint16(min(max(mean[r, c] - k * np.sqrt(variance[r, c]), 0.0), far))


@njit(nogil=True, cache=True)
def _cut_out(depth, mask, labels, keep, u0, v0, out):  # type: ignore[no-untyped-def]
    """Copy the crop's pixels that are in the mask and in a kept component of the half-resolution labels, others 0."""
    h, w = out.shape
    last_row, last_column = labels.shape[0] - 1, labels.shape[1] - 1
    for i in range(h):
        r = v0 + i
        half_row = min(r >> 1, last_row)
        for j in range(w):
            c = u0 + j
            person = mask[r, c] > 0 and keep[labels[half_row, min(c >> 1, last_column)]]
            out[i, j] = depth[r, c] if person else 0


@njit(nogil=True, cache=True)
def _filter(source, range_limit, smooth, out):  # type: ignore[no-untyped-def]
    """Drop flying pixels and average the others with their neighbours on the same surface.

    A pixel with fewer than three neighbours within the range limit hangs in the air between two surfaces. Neighbours
    are averaged in opposite pairs, so that a slope or an outline is not pulled to one side.
    """
    h, w = source.shape
    out[0], out[h - 1], out[:, 0], out[:, w - 1] = 0, 0, 0, 0
    for i in range(1, h - 1):
        for j in range(1, w - 1):
            d = np.int32(source[i, j])
            if d == 0:
                out[i, j] = 0
                continue
            reach = np.int32(range_limit * d)
            total, weight, neighbours = d, np.int32(1), np.int32(0)
            for pair in range(4):
                di, dj = (0, 1, 1, 1)[pair], (1, -1, 0, 1)[pair]
                a, b = np.int32(source[i - di, j - dj]), np.int32(source[i + di, j + dj])
                near_a, near_b = np.int32(abs(a - d) <= reach), np.int32(abs(b - d) <= reach)
                both = near_a & near_b
                neighbours += near_a + near_b
                total += both * (a + b)
                weight += 2 * both
            mean = np.uint16(np.float32(total) / np.float32(weight) + np.float32(0.5)) if smooth else np.uint16(d)
            out[i, j] = mean if neighbours >= 3 else np.uint16(0)


@njit(nogil=True, cache=True)
def _shade(depth, fx, fy, out):  # type: ignore[no-untyped-def]
    """Grey as under a lamp at the camera, for cameras without colour: 255·cosine of surface and optical axis."""
    h, w = depth.shape
    for i in range(h):
        for j in range(w):
            d = np.float32(depth[i, j])
            grey = np.uint8(0)
            if d > 0:
                left, right = depth[i, max(j - 1, 0)], depth[i, min(j + 1, w - 1)]
                up, down = depth[max(i - 1, 0), j], depth[min(i + 1, h - 1), j]
                gx = (np.float32(right) - np.float32(left)) * fx / (2.0 * d) if left > 0 and right > 0 else 0.0
                gy = (np.float32(down) - np.float32(up)) * fy / (2.0 * d) if up > 0 and down > 0 else 0.0
                grey = np.uint8(60.0 + 180.0 / np.sqrt(1.0 + gx * gx + gy * gy))
            out[i, j, 0] = out[i, j, 1] = out[i, j, 2] = grey


def shaded(camera: Camera, depth_mm: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Colour (h, w, 3) uint8 made from depth (h, w) uint16 [mm] alone: surfaces facing the camera are light."""
    out = np.empty((*depth_mm.shape, 3), np.uint8)
    _shade(depth_mm, camera.fx, camera.fy, out)
    return out


def _without_holes(empty_room_mm: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Empty room (H, W) uint16 [mm] with small holes closed by their nearest neighbour reading (7×7)."""
    unknown = empty_room_mm == 0
    nearest = cv2.erode(np.where(unknown, np.uint16(65535), empty_room_mm), np.ones((7, 7), np.uint8))
    filled = np.where(nearest == 65535, 0, nearest).astype(np.uint16)
    return np.where(unknown, filled, empty_room_mm).astype(np.uint16)


class BackgroundModel:
    """The background of one camera; ``foreground`` cuts the person out of each of its frames.

    ``empty_room`` (H, W) uint16 [mm]: depth without the person, 0 = nothing there within range. None: the source has
    removed the background itself, every reading between ``near_m`` and ``far_m`` is the person.
    ``room_colour`` (H, W, 3) uint8 RGB: the same without depth; None: it is learned, beside the person.

    Raises:
        ValueError: the empty room does not have the camera's size.
    """

    def __init__(
        self,
        camera: Camera,
        empty_room: NDArray[np.uint16] | None,
        settings: BackgroundSettings | None = None,
        room_colour: NDArray[np.uint8] | None = None,
    ) -> None:
        self._camera = camera
        self._settings = s = settings or BackgroundSettings()
        shape = (camera.height, camera.width)
        if empty_room is not None and empty_room.shape != shape:
            raise ValueError(f"camera {camera.name}: empty room {empty_room.shape}, images {shape}")
        if room_colour is not None and room_colour.shape != (*shape, 3):
            raise ValueError(f"camera {camera.name}: room's colour {room_colour.shape}, images {shape}")
        self._learns = empty_room is not None
        self._room_colour = RoomColour(*shape, room_colour) if self._learns else None
        self._mean = (
            np.zeros(shape, np.float32) if empty_room is None else _without_holes(empty_room).astype(np.float32)
        )
        sigma = s.noise_mm + s.noise_mm_per_m2 * (self._mean * 1e-3) ** 2
        self._variance = (sigma**2).astype(np.float32)
        limit = np.where(self._mean > 0, self._mean - s.deviations * sigma, np.inf)
        self._near = np.full(shape, min(round(s.near_m * 1000), 65535), np.uint16)
        self._limit = np.clip(limit, 0, min(round(s.far_m * 1000), 65535)).astype(np.uint16)
        self._stripe = 0

    def foreground(self, frame: DepthFrame) -> View | None:
        """The person's pixels of ``frame``, cropped to their bounding box, or None when nobody is in view.

        Depth outside the person is 0; colour is the camera's, or shaded depth where the camera has none.

        Raises:
            ValueError: the frame does not have the camera's size.
        """
        depth, camera, s = frame.depth_mm, self._camera, self._settings
        if depth.shape != self._limit.shape:
            raise ValueError(f"camera {camera.name}: frame {depth.shape}, camera {self._limit.shape}")
        mask = np.asarray(cv2.inRange(depth, self._near, self._limit), np.uint8)
        labels, keep, box = self._components(mask)
        if self._learns:
            self._learn(depth)
        if self._room_colour is not None and frame.colour is not None:
            self._room_colour.learn(frame.colour, box)
        if box is None:
            return None
        u0, v0, w, h = box
        cut = np.empty((h, w), np.uint16)
        _cut_out(depth, mask, labels, keep, u0, v0, cut)
        person = np.empty((h, w), np.uint16)
        _filter(cut, np.float32(s.range_limit_mm / 1000), s.smooth, person)
        if frame.colour is None:
            return View(camera, u0, v0, person, shaded(camera, person))
        colour = np.ascontiguousarray(frame.colour[v0 : v0 + h, u0 : u0 + w])
        if self._room_colour is None or not self._room_colour.steady:
            return View(camera, u0, v0, person, colour)
        readings, room = depth[v0 : v0 + h, u0 : u0 + w], self._room_colour.around(box)
        limit = s.range_limit_mm / 1000
        return SeenView(camera, u0, v0, person, colour, readings_mm=readings, room=room, range_limit=limit)

    def _components(
        self, mask: NDArray[np.uint8]
    ) -> tuple[NDArray[np.int32], NDArray[np.bool_], tuple[int, int, int, int] | None]:
        """Half-resolution labels, which of them are the person, and the box (u0, v0, w, h) [px] around those."""
        s, camera = self._settings, self._camera
        half = cv2.resize(mask, (max(camera.width // 2, 1), max(camera.height // 2, 1)), interpolation=cv2.INTER_AREA)
        count, found, stats, _ = cv2.connectedComponentsWithStats(half, connectivity=8, ltype=cv2.CV_32S)
        labels = np.asarray(found, np.int32)
        area = stats[:, cv2.CC_STAT_AREA]
        keep: NDArray[np.bool_] = area * 4 >= s.minimum_pixels
        keep[0] = False  # label 0 is the background
        if count < 2 or not keep.any():
            return labels, keep, None
        keep &= area >= 0.01 * area[1:].max()  # a foot cut off by a drop-out stays, a ghost on the wall does not
        x0, y0 = stats[keep, cv2.CC_STAT_LEFT], stats[keep, cv2.CC_STAT_TOP]
        x1, y1 = x0 + stats[keep, cv2.CC_STAT_WIDTH], y0 + stats[keep, cv2.CC_STAT_HEIGHT]
        u0, v0 = max(2 * int(x0.min()) - s.margin_px, 0), max(2 * int(y0.min()) - s.margin_px, 0)
        u1 = min(2 * int(x1.max()) + s.margin_px, camera.width)
        v1 = min(2 * int(y1.max()) + s.margin_px, camera.height)
        return labels, keep, (u0, v0, u1 - u0, v1 - v0)

    def _learn(self, depth: NDArray[np.uint16]) -> None:
        s = self._settings
        _update(
            depth,
            self._stripe,
            UPDATE_STRIPES,
            self._mean,
            self._variance,
            self._limit,
            np.float32(min(s.far_m * 1000, 65535.0)),
            np.float32(s.learning_rate),
            np.float32(s.deviations),
            np.float32(s.noise_mm),
            np.float32(s.noise_mm_per_m2),
        )
        self._stripe = (self._stripe + 1) % UPDATE_STRIPES
