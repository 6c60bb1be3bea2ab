"""What a depth sensor makes of the true depth: noise, steps and missing pixels.

A structured-light sensor measures disparity, so its errors are constant in 1/z and grow with z² in depth: noise and
step are given in 1/m. The defaults add up to a standard deviation of 8 mm at 2.5 m and 2.3 mm at 1.35 m, as measured
on real Kinect v1 and Orbbec recordings. Noise is correlated over neighbouring pixels, as block matching makes it.

To be cheap, readings of the steady background are made ahead, a few of them, and one is drawn per frame; only the
person's pixels are measured anew. Noise is read from a table made once, at a random offset and sign per frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.geometry.rasterizer import Crop

_BACKGROUNDS = 12  # readings of the background made ahead
_SPARE_ROWS = 128  # random offsets into the tables reach over this many image rows


@dataclass(frozen=True, slots=True)
class SensorSettings:
    """One depth sensor.

    ``noise_per_m``, ``step_per_m``: standard deviation and quantisation step of 1/z [1/m].
    ``max_range_m``: farther surfaces give no reading. ``edge_m``: a larger jump between neighbouring pixels is an edge;
    there the nearer pixel is missing with probability ``lost_at_edge`` and the farther one, in the projector's shadow,
    with ``lost_in_shadow``. From ``grazing_rad`` between viewing ray and normal on, more and more readings are missing
    until none is left at ``blind_rad``.
    """

    noise_per_m: float = 0.97e-3
    step_per_m: float = 2.87e-3
    max_range_m: float = 7.0
    edge_m: float = 0.10
    lost_at_edge: float = 0.35
    lost_in_shadow: float = 0.7
    grazing_rad: float = 1.25
    blind_rad: float = 1.48


class DepthSensor:
    """The sensor of one camera in front of a steady background; ``settings`` None gives true depth in whole mm."""

    def __init__(
        self, background: NDArray[np.float32], focal_px: float, settings: SensorSettings | None, seed: int
    ) -> None:
        """``background`` (H, W) float32 [m along the optical axis], 0 = nothing there."""
        self._background = np.ascontiguousarray(background, np.float32)
        self._settings = settings
        self._focal_px = focal_px
        self._random = np.random.default_rng(seed)
        if settings is None:
            return
        h, w = background.shape
        noise = cv2.GaussianBlur(self._random.standard_normal((h + _SPARE_ROWS, w), np.float32), (3, 3), 0.8)
        self._noise = (noise * (settings.noise_per_m / settings.step_per_m / noise.std())).ravel()
        self._chance = self._random.integers(0, 255, (h + _SPARE_ROWS) * w, np.uint8)  # 255 in the loss map: always
        self._millimetres = _step_table(settings)
        self._steps, self._loss = self._measurable(self._background)
        self._readings = [self.background_reading() for _ in range(_BACKGROUNDS)]

    def measure(self, person: Crop | None, out: NDArray[np.uint16] | None = None) -> NDArray[np.uint16]:
        """One frame (H, W) uint16 [mm], 0 = no reading: the background with ``person`` in front of it."""
        h, w = self._background.shape
        out = np.empty((h, w), np.uint16) if out is None else out
        if self._settings is None:
            scene = self._background if person is None else self._behind(person, 0)[0]
            np.rint(scene * 1000, casting="unsafe", out=out)
            return out
        out[:] = self._readings[self._random.integers(_BACKGROUNDS)]
        if person is not None:
            scene, corner = self._behind(person, 1)
            self._read(*self._measurable(scene), corner, out)
        return out

    def background_reading(self) -> NDArray[np.uint16]:
        """A fresh frame (H, W) uint16 [mm] of the background alone."""
        out = np.empty(self._background.shape, np.uint16)
        if self._settings is None:
            return self.measure(None, out)
        self._read(self._steps, self._loss, (0, 0), out)
        return out

    def _read(
        self, steps: NDArray[np.float32], loss: NDArray[np.uint8], corner: tuple[int, int], out: NDArray[np.uint16]
    ) -> None:
        """Readings of a part of the image whose corner is at pixel (v0, u0), into the image ``out``."""
        spare = _SPARE_ROWS * out.shape[1]
        noise, chance = (table[self._random.integers(spare) :] for table in (self._noise, self._chance))
        sign = np.float32(self._random.choice((-1.0, 1.0)))
        _sample(steps, loss, noise, chance, sign, self._millimetres, corner, out)

    def _behind(self, person: Crop, border: int) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Depth with the person in front: the whole image, or (border > 0) the crop with a border; and its corner."""
        h, w = self._background.shape
        ph, pw = person.depth.shape
        v0, v1, u0, u1 = 0, h, 0, w
        if border:
            v0, v1 = max(person.v0 - border, 0), min(person.v0 + ph + border, h)
            u0, u1 = max(person.u0 - border, 0), min(person.u0 + pw + border, w)
        scene = self._background[v0:v1, u0:u1].copy()
        part = scene[person.v0 - v0 : person.v0 - v0 + ph, person.u0 - u0 : person.u0 - u0 + pw]
        nearer = (person.depth > 0) & ((person.depth < part) | (part == 0))
        np.copyto(part, person.depth, where=nearer)
        return scene, (v0, u0)

    def _measurable(self, depth: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Disparity in steps (h, w) and how often a pixel is lost, in 255ths (h, w)."""
        s = self._settings
        assert s is not None
        graze = np.float32(np.tan(s.grazing_rad) / self._focal_px), np.float32(np.tan(s.blind_rad) / self._focal_px)
        losses = (int(255 * s.lost_at_edge), int(255 * s.lost_in_shadow))
        steps, loss = np.empty(depth.shape, np.float32), np.empty(depth.shape, np.uint8)
        limits = np.float32(s.max_range_m), np.float32(s.edge_m)
        _prepare(depth, np.float32(1 / s.step_per_m), *limits, graze, losses, steps, loss)
        return steps, loss


def averaged(frames: Sequence[NDArray[np.uint16]]) -> NDArray[np.uint16]:
    """Mean depth (H, W) uint16 [mm] of readings of one steady scene; 0 where fewer than half of them have one."""
    stack = np.stack(frames)
    count = np.count_nonzero(stack, axis=0)
    mean = stack.sum(axis=0, dtype=np.float64) / np.maximum(count, 1)
    return np.where(2 * count >= len(stack), np.rint(mean), 0).astype(np.uint16)


def _step_table(settings: SensorSettings) -> NDArray[np.uint16]:
    """Depth [mm] of every disparity step from 0 to that of 0.2 m; beyond the range: 0."""
    steps = np.arange(int(1 / (0.2 * settings.step_per_m)) + 2)
    depth_m = 1 / np.maximum(steps * settings.step_per_m, 1e-9)
    return np.where(depth_m > settings.max_range_m, 0, np.rint(depth_m * 1000)).astype(np.uint16)


@njit(nogil=True, cache=True, error_model="numpy")
def _prepare(depth, steps_m, max_range_m, edge_m, graze, losses, steps, loss):  # type: ignore[no-untyped-def]
    """Disparity in steps and loss in 255ths of true depth; tan of the angle to the normal ≈ |Δz| · f / z a pixel."""
    h, w = depth.shape
    for v in range(h):
        for u in range(w):
            z = depth[v, u]
            if z <= 0 or z > max_range_m:
                steps[v, u], loss[v, u] = 0, 255
                continue
            steps[v, u] = steps_m / z
            around = (
                depth[max(v - 1, 0), u], depth[min(v + 1, h - 1), u],
                depth[v, max(u - 1, 0)], depth[v, min(u + 1, w - 1)],
            )  # fmt: skip
            slope, worst = np.float32(0), 0
            for beside in around:
                drop = beside - z if beside > 0 else np.float32(1e3)
                if drop > edge_m:
                    worst = max(worst, losses[0])
                elif drop < -edge_m:
                    worst = max(worst, losses[1])
                else:
                    slope = max(slope, abs(drop))
            grazing = (slope / z - graze[0]) / (graze[1] - graze[0])
            loss[v, u] = max(worst, int(255 * min(max(grazing, np.float32(0)), np.float32(1))))


@njit(nogil=True, cache=True, error_model="numpy")
def _sample(steps, loss, noise, chance, sign, millimetres, corner, out):  # type: ignore[no-untyped-def]
    """Readings [mm] of (h, w) disparities into ``out`` at pixel ``corner`` (v0, u0); tables run over all of ``out``."""
    h, w = steps.shape
    last = len(millimetres) - 1
    for v in range(h):
        row = (corner[0] + v) * out.shape[1] + corner[1]
        for u in range(w):
            k = int(steps[v, u] + sign * noise[row + u] + np.float32(0.5))
            k = min(max(k, 0), last)
            out[corner[0] + v, corner[1] + u] = millimetres[k] if chance[row + u] >= loss[v, u] else 0
