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
        self._random = np.random.default_rng(seed)
        if settings is None:
            return
        h, w = background.shape
        noise = cv2.GaussianBlur(self._random.standard_normal((h + _SPARE_ROWS, w), np.float32), (3, 3), 0.8)
        self._noise = (noise * (settings.noise_per_m / settings.step_per_m / noise.std())).ravel()
        self._chance = self._random.integers(0, 255, (h + _SPARE_ROWS) * w, np.uint8)  # 255 in the loss map: always
        self._millimetres = _step_table(settings)
        graze, blind = np.tan([settings.grazing_rad, settings.blind_rad]) / focal_px
        self._limits = tuple(
            np.float32(limit)
            for limit in (1 / settings.step_per_m, settings.max_range_m, settings.edge_m, graze, blind - graze)
        )
        self._losses = int(255 * settings.lost_at_edge), int(255 * settings.lost_in_shadow)
        self._readings = [self.background_reading() for _ in range(_BACKGROUNDS)]

    def measure(self, person: Crop | None, out: NDArray[np.uint16] | None = None) -> NDArray[np.uint16]:
        """One frame (H, W) uint16 [mm], 0 = no reading: the background with ``person`` in front of it."""
        h, w = self._background.shape
        out = np.empty((h, w), np.uint16) if out is None else out
        if self._settings is None:
            scene = self._background if person is None else self._behind(person, max(h, w))[0]
            np.rint(scene * 1000, casting="unsafe", out=out)
            return out
        out[:] = self._readings[self._random.integers(_BACKGROUNDS)]
        if person is not None:
            self._read(*self._behind(person, 2), out)
        return out

    def background_reading(self) -> NDArray[np.uint16]:
        """A fresh frame (H, W) uint16 [mm] of the background alone."""
        out = np.empty(self._background.shape, np.uint16)
        if self._settings is None:
            return self.measure(None, out)
        self._read(self._background, np.ones(out.shape, np.uint8), (0, 0), out)
        return out

    def _read(
        self, scene: NDArray[np.float32], fresh: NDArray[np.uint8], corner: tuple[int, int], out: NDArray[np.uint16]
    ) -> None:
        """Readings of a part of the image whose corner is at pixel (v0, u0), where fresh, into the image ``out``."""
        spare = _SPARE_ROWS * out.shape[1]
        noise, chance = (table[self._random.integers(spare) :] for table in (self._noise, self._chance))
        sign = np.float32(self._random.choice((-1.0, 1.0)))
        _read(scene, fresh, self._limits, self._losses, noise, chance, sign, self._millimetres, corner, out)

    def _behind(self, person: Crop, border: int) -> tuple[NDArray[np.float32], NDArray[np.uint8], tuple[int, int]]:
        """The crop with a border: depth (h, w) with the person in front, where they are, and the corner (v0, u0)."""
        h, w = self._background.shape
        ph, pw = person.depth.shape
        v0, v1 = max(person.v0 - border, 0), min(person.v0 + ph + border, h)
        u0, u1 = max(person.u0 - border, 0), min(person.u0 + pw + border, w)
        scene = self._background[v0:v1, u0:u1].copy()
        there = np.zeros(scene.shape, np.uint8)
        _stand_before(scene, there, person.depth, person.v0 - v0, person.u0 - u0)
        return scene, there, (v0, u0)


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
def _stand_before(scene, there, person, top, left):  # type: ignore[no-untyped-def]
    """The person's depth (h, w) into ``scene`` from (top, left) on, where nearer; there ``there`` becomes 1."""
    for v in range(person.shape[0]):
        for u in range(person.shape[1]):
            z, behind = person[v, u], scene[top + v, left + u]
            nearer = (z > 0) & ((z < behind) | (behind == 0))
            scene[top + v, left + u] = z if nearer else behind
            there[top + v, left + u] = nearer


@njit(nogil=True, cache=True, error_model="numpy")
def _read(scene, fresh, limits, losses, noise, chance, sign, millimetres, corner, out):  # type: ignore[no-untyped-def]
    """Readings [mm] of the fresh pixels of ``scene`` (h, w) and of those beside them, as their edges are new.

    They go into ``out`` from pixel ``corner`` (v0, u0) on; the tables of noise and chance run over all of ``out``.
    ``limits``: disparity steps · m, range, edge, least slope at which readings get lost and the span until all are.
    """
    h, w = scene.shape
    steps_m, max_range_m, _, _, _ = limits
    for v in range(h):
        above, below = max(v - 1, 0), min(v + 1, h - 1)
        row = (corner[0] + v) * out.shape[1] + corner[1]
        for u in range(w):
            before, after = max(u - 1, 0), min(u + 1, w - 1)
            if not fresh[v, u] | fresh[above, u] | fresh[below, u] | fresh[v, before] | fresh[v, after]:
                continue
            z, reading = scene[v, u], np.uint16(0)
            if z > 0 and z <= max_range_m:
                around = scene[above, u], scene[below, u], scene[v, before], scene[v, after]
                if chance[row + u] >= _loss(z, around, limits, losses):
                    k = int(steps_m / z + sign * noise[row + u] + np.float32(0.5))
                    reading = millimetres[min(max(k, 0), len(millimetres) - 1)]
            out[corner[0] + v, corner[1] + u] = reading


@njit(nogil=True, cache=True, error_model="numpy")
def _loss(z, around, limits, losses):  # type: ignore[no-untyped-def]
    """How often a pixel is lost, in 255ths; tan of the angle to the normal ≈ |Δz| · f / z a pixel."""
    _, _, edge_m, least_slope, slope_span = limits
    slope, worst = np.float32(0), 0
    for beside in around:
        drop = beside - z if beside > 0 else np.float32(1e3)
        if drop > edge_m:
            worst = max(worst, losses[0])
        elif drop < -edge_m:
            worst = max(worst, losses[1])
        else:
            slope = max(slope, abs(drop))
    grazing = (slope / z - least_slope) / slope_span
    return max(worst, int(255 * min(max(grazing, np.float32(0)), np.float32(1))))
