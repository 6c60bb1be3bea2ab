"""The modified visual hull of Rao & Hodges §7: lines of sight cut to what every camera sees as a person.

From one camera's silhouette go lines in space, one per grid point; each other camera keeps those stretches of a line
that its silhouette covers. What is left after all of them is a list of intervals per line: a line that meets two arms,
or two people, enters and leaves several times. The cost is one walk along a line's image per line and camera, so
linear in the number of cameras.

A camera cuts only what it sees: what lies outside its image stays, as long as two other cameras see it (one, when
there is only one).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from common.geometry.rigid_transform import inverse
from sender.reconstruction.silhouette import PERSON, Silhouette

Floats = NDArray[np.float64]

NEAR_M, FAR_M = 0.3, 12.0
MAX_INTERVALS = 16  # on one line; what comes behind is left out
LEAST_DEPTH_M = 0.05  # what is nearer to a camera it does not see
NOBODY = -1  # an end of an interval that no silhouette made: the line leaves a camera's sight there
SEEN_BY = 2  # other cameras, at least, that must have a place in their images
_STRIDE_PX = 2.0  # samples along a line's image; no limb is thinner. The edges between them are found by halving:
_HALVINGS = 2
_EDGE_PX = 1e-3  # an image ends so much before its edge, that rounding does not lead out of it


@dataclass(frozen=True, slots=True, eq=False)
class HullLines:
    """Lines of sight of one camera and the stretches of them that are inside the hull.

    ``origin`` (3,) [m, world]: the camera. ``directions`` (N, 3) [world]: one line each, of depth 1 in that camera.
    ``line`` (M,) int32: each interval's line, ascending. ``depths`` (M, 2) [m]: where it starts and ends.
    ``made_by`` (M, 2) int8: the camera whose silhouette ends it there, by its index, or ``NOBODY``.
    """

    origin: Floats
    directions: Floats
    line: NDArray[np.int32]
    depths: Floats
    made_by: NDArray[np.int8]

    def lengths_m(self) -> Floats:
        """Of each interval (M,) [m]."""
        longer = np.linalg.norm(self.directions, axis=1)[self.line]
        return np.asarray((self.depths[:, 1] - self.depths[:, 0]) * longer, np.float64)


class VisualHull:
    """The hull of two or more silhouettes of one instant, by any cameras, in any order. One without a person in it
    empties the hull.

    As arrays, for kernels: ``lenses`` (C, 4) fx fy cx cy, ``sizes`` (C, 2) width height [pixels], ``masks`` (C, H, W)
    padded to the largest, ``T_camera_world`` (C, 4, 4).

    Raises:
        ValueError: fewer than two silhouettes.
    """

    def __init__(self, silhouettes: Sequence[Silhouette]) -> None:
        if len(silhouettes) < 2:
            raise ValueError(f"a visual hull of {len(silhouettes)} silhouettes")
        self.silhouettes = tuple(silhouettes)
        self.cameras: tuple[Camera, ...] = tuple(silhouette.camera for silhouette in silhouettes)
        cameras = self.cameras
        self.lenses: Floats = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras])
        self.sizes = np.array([[c.width, c.height] for c in cameras])
        self._edges = np.array([[_EDGE_PX, c.width - _EDGE_PX, _EDGE_PX, c.height - _EDGE_PX] for c in cameras]) - 0.5
        self._boxes = np.empty_like(self._edges)
        self.masks = np.empty((len(cameras), max(c.height for c in cameras), max(c.width for c in cameras)), np.uint8)
        for index, silhouette in enumerate(silhouettes):
            u, v, width, height = cv2.boundingRect(silhouette.mask)
            self._boxes[index] = u - 1.5, u + width + 0.5, v - 1.5, v + height + 0.5  # the outline is inside
            self.masks[index, : cameras[index].height, : cameras[index].width] = silhouette.mask
        self._T_world_camera = np.stack([camera.T_world_camera for camera in cameras])
        self.T_camera_world: Floats = np.asarray(inverse(self._T_world_camera), np.float64)

    def lines(self, reference: int, count: int) -> HullLines:
        """About ``count`` lines of sight of camera ``reference``, cut by all others (Rao §7, steps 1 and 2a–c)."""
        camera = self.cameras[reference]
        pixels = _grid(self.silhouettes[reference].mask, count)
        rays = np.ones((len(pixels), 3))
        rays[:, 0] = (pixels[:, 0] - camera.cx) / camera.fx
        rays[:, 1] = (pixels[:, 1] - camera.cy) / camera.fy
        others = self._from_the_side_first(reference)
        T = self.T_camera_world[others] @ camera.T_world_camera
        lenses, edges, boxes = self.lenses[others], self._edges[others], self._boxes[others]
        seen_by = min(SEEN_BY, len(others))
        line, depths, made_by = _carve(rays, others, T, lenses, edges, boxes, self.masks, seen_by, NEAR_M, FAR_M)
        directions = rays @ camera.T_world_camera[:3, :3].T
        return HullLines(camera.T_world_camera[:3, 3].copy(), directions, line, depths, made_by)

    @property
    def largest(self) -> int:
        """The camera whose silhouette has most pixels, by its index."""
        pixels = [int(np.count_nonzero(silhouette.mask == PERSON)) for silhouette in self.silhouettes]
        return max(range(len(pixels)), key=lambda index: (pixels[index], self.cameras[index].name))

    def _from_the_side_first(self, reference: int) -> NDArray[np.int64]:
        """The indices of all but the reference; those that look across its lines first: they leave short intervals,
        on which the walks of the rest are short. Their names settle ties, so that no order of cameras matters."""
        axes = self._T_world_camera[:, :3, 2]
        along = np.abs(axes @ axes[reference]).round(6)
        others = [index for index in range(len(self.cameras)) if index != reference]
        return np.array(sorted(others, key=lambda index: (along[index], self.cameras[index].name)))


def _grid(mask: NDArray[np.uint8], count: int) -> NDArray[np.int64]:
    """Pixels (N, 2) as (u, v) on a square grid inside the mask, about ``count`` of them."""
    step = max(1.0, np.sqrt(np.count_nonzero(mask == PERSON) / max(count, 1)))
    rows, columns = (((np.arange(int(size / step)) + 0.5) * step).astype(np.int64) for size in mask.shape)
    i, j = np.nonzero(mask[np.ix_(rows, columns)] == PERSON)
    return np.stack([columns[j], rows[i]], axis=1)


@njit(nogil=True, cache=True, error_model="numpy")
def _carve(rays, others, T, lenses, edges, boxes, masks, seen_by, near, far):  # type: ignore[no-untyped-def]
    """``VisualHull.lines`` on arrays: ``rays`` (N, 3) in the reference camera's frame; of each other camera its index
    in ``masks`` and the results, ``T`` (C, 4, 4) T_camera_reference, lens, and edges of its image and of its box."""
    count = len(T)
    capacity = len(rays) * 2 + MAX_INTERVALS
    line = np.empty(capacity, np.int32)
    depths = np.empty((capacity, 2), np.float64)
    made_by = np.empty((capacity, 2), np.int8)
    epipolar = np.empty((count, 6), np.float64)  # the ray in each camera's frame: X(z) = [:3] + z [3:]
    sight = np.empty((count, 2), np.float64)  # the stretch of it that the camera has in its image
    now, then = np.empty((MAX_INTERVALS, 2)), np.empty((MAX_INTERVALS, 2))
    now_by, then_by = np.empty((MAX_INTERVALS, 2), np.int8), np.empty((MAX_INTERVALS, 2), np.int8)
    filled = 0
    for row in range(len(rays)):
        _image_of(rays[row], T, epipolar)
        for camera in range(count):
            sight[camera] = _within(camera, epipolar, lenses, edges, near, far)
        low, high = _seen_by(sight, seen_by)
        low, high = _in_boxes(low, high, epipolar, lenses, boxes, sight)
        now[0, 0], now[0, 1] = low, high
        now_by[0, 0] = now_by[0, 1] = NOBODY
        left = 1 if high > low else 0
        for camera in range(count):
            if left == 0:
                break
            left = _cut(camera, others[camera], epipolar, lenses, sight, masks, now, now_by, left, then, then_by)
            now, then, now_by, then_by = then, now, then_by, now_by
        if filled + left > capacity:
            capacity *= 2
            line, depths, made_by = _longer(line, depths, made_by, capacity)
        for k in range(left):
            line[filled] = row
            depths[filled, 0], depths[filled, 1] = now[k, 0], now[k, 1]
            made_by[filled, 0], made_by[filled, 1] = now_by[k, 0], now_by[k, 1]
            filled += 1
    return line[:filled], depths[:filled], made_by[:filled]


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _image_of(ray, T, out):  # type: ignore[no-untyped-def]
    """A ray in each camera's frame."""
    for camera in range(len(T)):
        for axis in range(3):
            out[camera, axis] = T[camera, axis, 3]
            out[camera, 3 + axis] = T[camera, axis, 0] * ray[0] + T[camera, axis, 1] * ray[1] + T[camera, axis, 2]


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _in_boxes(low, high, epipolar, lenses, boxes, sight):  # type: ignore[no-untyped-def]
    """The depths low..high shortened from both ends by what each camera sees, but not within its silhouette's box."""
    for camera in range(len(sight)):
        first, last = sight[camera, 0], sight[camera, 1]
        begin, end = _within(camera, epipolar, lenses, boxes, max(low, first), min(high, last))
        if not end > begin:
            begin, end = last, first
        if low >= first:
            low = max(low, begin)
        if high <= last:
            high = min(high, end)
    return low, high


@njit(nogil=True, cache=True, error_model="numpy")
def _longer(line, depths, made_by, capacity):  # type: ignore[no-untyped-def]
    """Copies with room for ``capacity`` intervals."""
    more_line, more_by = np.empty(capacity, np.int32), np.empty((capacity, 2), np.int8)
    more_depths = np.empty((capacity, 2), np.float64)
    more_line[: len(line)], more_depths[: len(line)], more_by[: len(line)] = line, depths, made_by
    return more_line, more_depths, more_by


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _within(camera, epipolar, lenses, edges, low, high):  # type: ignore[no-untyped-def]
    """The part of the depths low..high whose image lies within ``edges``: five half-spaces a + z·b >= 0."""
    z, zz = epipolar[camera, 2], epipolar[camera, 5]
    for side in range(5):
        if side == 4:
            a, b = z - LEAST_DEPTH_M, zz
        else:
            axis = side >> 1  # left, right, top, bottom
            focal, offset = lenses[camera, axis], edges[camera, side] - lenses[camera, 2 + axis]
            a = focal * epipolar[camera, axis] - offset * z
            b = focal * epipolar[camera, 3 + axis] - offset * zz
            if side & 1:
                a, b = -a, -b
        if b > 0.0:
            low = max(low, -a / b)
        elif b < 0.0:
            high = min(high, -a / b)
        elif a < 0.0:
            high = low
    return low, high


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _seen_by(sight, least):  # type: ignore[no-untyped-def]
    """The stretch around all places that at least ``least`` (1 or 2) cameras have in their images."""
    first, second = np.inf, np.inf
    last, last_but_one = -np.inf, -np.inf
    for camera in range(len(sight)):
        low, high = sight[camera, 0], sight[camera, 1]
        if not high > low:
            continue
        if low < first:
            first, second = low, first
        elif low < second:
            second = low
        if high > last:
            last, last_but_one = high, last
        elif high > last_but_one:
            last_but_one = high
    return (first, last) if least == 1 else (second, last_but_one)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _cut(camera, index, epipolar, lenses, sight, masks, now, now_by, left, then, then_by):  # type: ignore[no-untyped-def]
    """Keep of the ``left`` intervals ``now`` what the mask covers or the camera does not see; return how many."""
    kept = 0
    for k in range(left):
        low, high = now[k, 0], now[k, 1]
        begin, end = max(low, sight[camera, 0]), min(high, sight[camera, 1])
        if not end > begin:  # all of it out of sight
            kept = _keep(low, high, now_by[k, 0], now_by[k, 1], then, then_by, kept)
            continue
        if begin > low:
            kept = _keep(low, begin, now_by[k, 0], NOBODY, then, then_by, kept)
        begin_by = now_by[k, 0] if begin == low else NOBODY
        end_by = now_by[k, 1] if end == high else NOBODY
        kept = _walk(camera, index, epipolar, lenses, masks, begin, end, begin_by, end_by, then, then_by, kept)
        if end < high:
            kept = _keep(end, high, NOBODY, now_by[k, 1], then, then_by, kept)
    return kept


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _keep(low, high, low_by, high_by, out, out_by, kept):  # type: ignore[no-untyped-def]
    """Append an interval, or lengthen the last one when they touch."""
    if kept > 0 and low - out[kept - 1, 1] < 1e-9:
        out[kept - 1, 1] = high
        out_by[kept - 1, 1] = high_by
        return kept
    if kept == len(out):
        return kept
    out[kept, 0], out[kept, 1] = low, high
    out_by[kept, 0], out_by[kept, 1] = low_by, high_by
    return kept + 1


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _walk(camera, index, epipolar, lenses, masks, begin, end, begin_by, end_by, out, out_by, kept):  # type: ignore[no-untyped-def]
    """Walk along the epipolar line between two depths in sight and append the stretches that the mask covers.

    Between the image points of ``begin`` and ``end``, at share s, the depth is begin + (end − begin)·t with
    t = s·w0 / (w1 + s·(w0 − w1)), w0 and w1 the depths of both ends before this camera.
    """
    w0 = epipolar[camera, 2] + begin * epipolar[camera, 5]
    w1 = epipolar[camera, 2] + end * epipolar[camera, 5]
    fx, fy, cx, cy = lenses[camera, 0], lenses[camera, 1], lenses[camera, 2], lenses[camera, 3]
    u0 = fx * (epipolar[camera, 0] + begin * epipolar[camera, 3]) / w0 + cx
    v0 = fy * (epipolar[camera, 1] + begin * epipolar[camera, 4]) / w0 + cy
    du = fx * (epipolar[camera, 0] + end * epipolar[camera, 3]) / w1 + cx - u0
    dv = fy * (epipolar[camera, 1] + end * epipolar[camera, 4]) / w1 + cy - v0
    steps = int(max(abs(du), abs(dv)) / _STRIDE_PX) + 1
    inside = False
    low, low_by = begin, begin_by
    for k in range(steps + 1):
        s = k / steps
        if _covered(masks, index, u0 + s * du, v0 + s * dv) == inside:
            continue
        if k == 0:
            inside = True
            continue
        before, after = (k - 1) / steps, s
        for _ in range(_HALVINGS):
            s = 0.5 * (before + after)
            if _covered(masks, index, u0 + s * du, v0 + s * dv) == inside:
                before = s
            else:
                after = s
        s = 0.5 * (before + after)
        edge = begin + (end - begin) * s * w0 / (w1 + s * (w0 - w1))
        if inside:
            kept = _keep(low, edge, low_by, index, out, out_by, kept)
        low, low_by = edge, index
        inside = not inside
    if inside:
        kept = _keep(low, end, low_by, end_by, out, out_by, kept)
    return kept


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _covered(masks, index, u, v):  # type: ignore[no-untyped-def]
    """Whether the mask is not background at (u, v) inside the image."""
    return masks[index, np.uint32(v + 0.5), np.uint32(u + 0.5)] > 0
