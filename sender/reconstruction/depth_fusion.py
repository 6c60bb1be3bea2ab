"""A camera's depth of one instant, averaged with its frames before: the body has moved, but link by link.

A sensor's noise is new in every frame, while a link carries its surface along rigidly. Each pixel of a view is followed
to the other frames by its link's motion, and the readings found there are averaged. The skeletons know that motion only
roughly, so each link is first registered to each frame: one Gauss–Newton step, point to plane (Chen and Medioni 1992).
Cloth that slips and joints that bend are why a few frames are better than many.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.depth_mesher import SMOOTHING_RADIUS_PIXELS, SMOOTHING_RANGE_MM, smooth_depth
from common.body.link_segmentation import nearest_link
from common.body.skeleton import LINK_COUNT, Skeleton
from common.body.view import View
from common.geometry import quaternion
from common.geometry.camera_model import Camera, pixel_rays
from common.geometry.rigid_transform import inverse, transform_points

LINK_GRID = 4  # pixels: links are looked up once in a square of so many
REGISTRATION_GRID = 3  # pixels: every so many take part in a registration
REGISTRATION_GATE_MM = 50.0  # readings farther from where they are expected are another surface
# A registration trusts the skeletons to so much, against readings that are off by NOISE_MM: a link seen by few pixels
# stays where the skeleton has it.
NOISE_MM, SHIFT_MM, TURN_RAD = 14.0, 10.0, 0.08
SEEN_IN = 0.7  # of the other frames a pixel must have a reading that an incomplete frame itself lacks
_PRIOR = np.diag(NOISE_MM**2 / np.array([TURN_RAD] * 3 + [SHIFT_MM] * 3) ** 2)
GATE_PER_MM2 = 5e-6  # readings averaged lie within so much · depth² of the surface: a sensor's noise grows so
ROUNDNESS_PER_MM2 = 1e-6  # means take at most so much · depth² off a limb: its curvature times a pixel's size squared

Floats = NDArray[np.floating]


@dataclass(frozen=True, slots=True, eq=False)
class PosedViews:
    """What the cameras saw at ``capture_ns``, and the links then: ``T_world_link`` (L, 4, 4)."""

    capture_ns: int
    views: tuple[View, ...]
    T_world_link: NDArray[np.float32]


class DepthFusion:
    """Fuses a frame's depth with that of ``frames`` before it, the last ones it was told to remember; 0: with none.

    One thread's own.
    """

    def __init__(self, frames: int) -> None:
        self._most = frames
        self._frames: deque[PosedViews] = deque(maxlen=frames + 1)  # the frame itself is mostly among them
        self._rays: dict[str, tuple[Camera, NDArray[np.float32]]] = {}

    def remember(self, frame: PosedViews) -> None:
        """A frame to average others with; the oldest one is forgotten."""
        self._frames.append(frame)

    def copy(self) -> DepthFusion:
        """Another with the same frames, which may go on differently."""
        other = DepthFusion(self._most)
        other._frames.extend(self._frames)
        other._rays = self._rays
        return other

    def fused(self, frame: PosedViews, skeleton: Skeleton) -> tuple[View, ...]:
        """The views of ``frame``, which are unchanged where no earlier frame is remembered.

        Their depth has less noise, and readings at the outline and in holes that only this frame lacks.
        """
        others = [other for other in self._frames if other.capture_ns < frame.capture_ns][-self._most :]
        return tuple(self._fused(view, frame, others, skeleton) for view in frame.views)

    def _fused(self, view: View, frame: PosedViews, others: Sequence[PosedViews], skeleton: Skeleton) -> View:
        if self._most == 0:
            return view
        pairs = [(then, other) for other in others for then in other.views if _same(then.camera, view.camera)]
        if not pairs:
            return view
        camera, rays = view.camera, self._rays_of(view)
        surface = smooth_depth(view.depth_mm, SMOOTHING_RADIUS_PIXELS, SMOOTHING_RANGE_MM)
        links = _links(camera, surface, rays, skeleton, frame.T_world_link)
        normals, centres = _normals_and_centres(surface, rays, links, LINK_COUNT)
        _extend(surface)
        total, count = _own_readings(surface, view.depth_mm)
        motion = _motion(camera, frame.T_world_link, np.stack([other.T_world_link for _, other in pairs]))
        at = np.einsum("nlij,lj->nli", motion[..., :3], centres) + motion[..., 3]
        focal = np.array([camera.fx, camera.fy], np.float32)
        shifts = np.array([(view.u0 - then.u0, view.v0 - then.v0) for then, _ in pairs], np.float32)
        equations = [
            _registration(surface, rays, normals, links, then.depth_mm, roughly, centre, focal, shift)
            for (then, _), roughly, centre, shift in zip(pairs, motion.astype(np.float32), at, shifts, strict=True)
        ]
        motion = _moved(motion, at, *(np.stack(parts) for parts in zip(*equations, strict=True)))
        for (then, _), registered, shift in zip(pairs, motion.astype(np.float32), shifts, strict=True):
            _gather(surface, rays, links, then.depth_mm, registered, focal, shift, total, count)
        mean = surface + total / np.maximum(count, 1)
        there = view.depth_mm > 0
        if not view.complete:
            there |= count >= SEEN_IN * len(pairs)
        depth = np.where(there & (surface > 0), np.clip(np.rint(mean), 1, 65535), 0).astype(np.uint16)
        return replace(view, depth_mm=_sharpened(depth))

    def _rays_of(self, view: View) -> NDArray[np.float32]:
        """Viewing rays (h, w, 3) of a crop; a camera's are computed once."""
        known = self._rays.get(view.camera.name)
        if known is None or known[0] is not view.camera:
            known = self._rays[view.camera.name] = view.camera, pixel_rays(view.camera)
        h, w = view.depth_mm.shape
        return np.ascontiguousarray(known[1][view.v0 : view.v0 + h, view.u0 : view.u0 + w])


def _sharpened(depth_mm: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Depth with twice what the mesher's means will take away, a limb's roundness as well as noise; with less noise
    the roundness counts for more. Their sum is Tukey's twicing. At a step in depth the means take more than roundness
    can: there it fades, or the step would grow, and what spans it would count as a bridge over an occlusion."""
    means = smooth_depth(depth_mm, SMOOTHING_RADIUS_PIXELS, SMOOTHING_RANGE_MM)
    return _twiced(depth_mm, means, np.float32(ROUNDNESS_PER_MM2))


def _same(a: Camera, b: Camera) -> bool:
    return a.name == b.name and a.width == b.width and np.array_equal(a.T_world_camera, b.T_world_camera)


def _links(
    camera: Camera, surface: NDArray[np.float32], rays: NDArray[np.float32], skeleton: Skeleton, T_world_link: Floats
) -> NDArray[np.uint8]:
    """Link of each square of ``LINK_GRID`` pixels, taken at the largest depth in it and its corner's ray."""
    g = LINK_GRID
    depth = cv2.dilate(surface, np.ones((g, g), np.uint8), anchor=(0, 0))[::g, ::g]
    rows, columns = np.nonzero(depth)
    at = rays[rows * g, columns * g] * (depth[rows, columns] * np.float32(1e-3))[:, None]
    links = np.zeros(depth.shape, np.uint8)
    points = transform_points(camera.T_world_camera, at).astype(np.float32)
    links[rows, columns] = nearest_link(points, skeleton, np.asarray(T_world_link, np.float32))
    return links


def _motion(camera: Camera, now: Floats, then: Floats) -> NDArray[np.float64]:
    """Each link's motion (N, L, 3, 4) in the camera's frame [mm], from ``now`` (L, 4, 4) to ``then`` (N, L, 4, 4)."""
    T = camera.T_world_camera
    motion = inverse(T) @ then.astype(np.float64) @ (inverse(now.astype(np.float64)) @ T)
    motion[..., :3, 3] *= 1e3
    return np.ascontiguousarray(motion[..., :3, :])


def _moved(motion: Floats, at: Floats, H: Floats, g: Floats) -> NDArray[np.float64]:
    """The motions (N, L, 3, 4) after one Gauss–Newton step, which turns each link about its centre ``at`` (N, L, 3)."""
    step = np.linalg.solve(H + _PRIOR, g[..., None])[..., 0]
    turns = np.concatenate([np.ones((*step.shape[:-1], 1)), step[..., :3] / 2], axis=-1)
    R = quaternion.to_matrix(turns / np.linalg.norm(turns, axis=-1, keepdims=True))
    out = np.empty_like(motion, np.float64)
    out[..., :3] = R @ motion[..., :3]
    out[..., 3] = np.einsum("nlij,nlj->nli", R, motion[..., 3] - at) + at + step[..., 3:]
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _normals_and_centres(surface, rays, links, link_count):  # type: ignore[no-untyped-def]
    """Of every ``REGISTRATION_GRID``-th pixel the normal towards the camera (h', w', 3), 0 = none; the links' centres
    (L, 3) [mm]."""
    h, w = surface.shape
    g, k = REGISTRATION_GRID, 3
    normals = np.zeros(((h + g - 1) // g, (w + g - 1) // g, 3), np.float32)
    centres, counts = np.zeros((link_count, 3)), np.zeros(link_count)
    for y in range(0, h, g):
        for x in range(0, w, g):
            z = surface[y, x]
            if z <= 0:
                continue
            link = links[y // LINK_GRID, x // LINK_GRID]
            counts[link] += 1
            for n in range(3):
                centres[link, n] += rays[y, x, n] * z
            if y < k or x < k or y + k >= h or x + k >= w:
                continue
            left, right, up, down = surface[y, x - k], surface[y, x + k], surface[y - k, x], surface[y + k, x]
            if max(abs(left - z), abs(right - z), abs(up - z), abs(down - z)) > 15 * k:
                continue
            gx = (right - left) / ((rays[y, x + k, 0] - rays[y, x - k, 0]) * z)
            gy = (down - up) / ((rays[y + k, x, 1] - rays[y - k, x, 1]) * z)
            nz = -(1 + gx * rays[y, x, 0] + gy * rays[y, x, 1])
            length = np.sqrt(gx * gx + gy * gy + nz * nz)
            if -nz < 0.3 * length:  # grazing: its reading says little of where it is
                continue
            normals[y // g, x // g, 0], normals[y // g, x // g, 1] = gx / length, gy / length
            normals[y // g, x // g, 2] = nz / length
    for link in range(link_count):
        for n in range(3):
            centres[link, n] /= max(counts[link], 1.0)
    return normals, centres


@njit(nogil=True, cache=True, error_model="numpy")
def _followed(z, ray, M, x, y, focal, shift):  # type: ignore[no-untyped-def]
    """A pixel's point moved by ``M`` (3, 4) [mm], and its column and row in the other crop.

    The way it goes in the image is that without distortion, which hardly changes over so short a way.
    """
    X, Y = ray[0] * z, ray[1] * z
    px = M[0, 0] * X + M[0, 1] * Y + M[0, 2] * z + M[0, 3]
    py = M[1, 0] * X + M[1, 1] * Y + M[1, 2] * z + M[1, 3]
    pz = M[2, 0] * X + M[2, 1] * Y + M[2, 2] * z + M[2, 3]
    u = x + shift[0] + (px / pz - ray[0]) * focal[0]
    v = y + shift[1] + (py / pz - ray[1]) * focal[1]
    return px, py, pz, int(np.floor(u + np.float32(0.5))), int(np.floor(v + np.float32(0.5)))


@njit(nogil=True, cache=True, error_model="numpy")
def _registration(surface, rays, normals, links, then, motion, at, focal, shift):  # type: ignore[no-untyped-def]
    """Normal equations (L, 6, 6), (L, 6) of each link's small turn about ``at`` [rad] and shift [mm]."""
    H, g = np.zeros((len(motion), 6, 6)), np.zeros((len(motion), 6))
    J = np.zeros(6)
    for row in range(normals.shape[0]):
        for column in range(normals.shape[1]):
            n = normals[row, column]
            if n[2] == 0:
                continue
            y, x = row * REGISTRATION_GRID, column * REGISTRATION_GRID
            link = links[y // LINK_GRID, x // LINK_GRID]
            M = motion[link]
            px, py, pz, i, j = _followed(surface[y, x], rays[y, x], M, x, y, focal, shift)
            if i < 0 or j < 0 or i >= then.shape[1] or j >= then.shape[0] or pz <= 0 or then[j, i] == 0:
                continue
            r = then[j, i] - pz
            if abs(r) > REGISTRATION_GATE_MM:
                continue
            n0 = M[0, 0] * n[0] + M[0, 1] * n[1] + M[0, 2] * n[2]
            n1 = M[1, 0] * n[0] + M[1, 1] * n[1] + M[1, 2] * n[2]
            n2 = M[2, 0] * n[0] + M[2, 1] * n[1] + M[2, 2] * n[2]
            error = r * (n0 * px + n1 * py + n2 * pz) / pz
            qx, qy, qz = px - at[link, 0], py - at[link, 1], pz - at[link, 2]
            J[0], J[1], J[2] = qy * n2 - qz * n1, qz * n0 - qx * n2, qx * n1 - qy * n0
            J[3], J[4], J[5] = n0, n1, n2
            weight = (1 - (r / REGISTRATION_GATE_MM) ** 2) ** 2
            for a in range(6):
                g[link, a] += weight * J[a] * error
                for b in range(6):
                    H[link, a, b] += weight * J[a] * J[b]
    return H, g


@njit(nogil=True, cache=True, error_model="numpy")
def _extend(surface):  # type: ignore[no-untyped-def]
    """Continue the surface by a pixel, into holes and over the outline: the mean of three or more neighbours."""
    h, w = surface.shape
    seen = surface.copy()
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            if seen[y, x] > 0:
                continue
            total, count = np.float32(0), 0
            for j in range(y - 1, y + 2):
                for i in range(x - 1, x + 2):
                    total += seen[j, i]
                    count += seen[j, i] > 0
            if count >= 3:
                surface[y, x] = total / count


@njit(nogil=True, cache=True, error_model="numpy")
def _own_readings(surface, depth_mm):  # type: ignore[no-untyped-def]
    """Sum (h, w) and number (h, w) of the readings about the surface, so far the frame's own."""
    total, count = np.zeros(surface.shape, np.float32), np.zeros(surface.shape, np.float32)
    for y in range(surface.shape[0]):
        for x in range(surface.shape[1]):
            if depth_mm[y, x] > 0:
                total[y, x], count[y, x] = np.float32(depth_mm[y, x]) - surface[y, x], 1
    return total, count


@njit(nogil=True, cache=True, error_model="numpy")
def _gather(surface, rays, links, then, motion, focal, shift, total, count):  # type: ignore[no-untyped-def]
    """Add one frame's readings, each as far before or behind its pixel's surface as it was found."""
    for y in range(surface.shape[0]):
        for x in range(surface.shape[1]):
            z = surface[y, x]
            if z <= 0:
                continue
            M = motion[links[y // LINK_GRID, x // LINK_GRID]]
            _, _, pz, i, j = _followed(z, rays[y, x], M, x, y, focal, shift)
            if i < 0 or j < 0 or i >= then.shape[1] or j >= then.shape[0] or pz <= 0 or then[j, i] == 0:
                continue
            r = then[j, i] - pz
            if abs(r) <= np.float32(GATE_PER_MM2) * z * z:
                total[y, x] += r
                count[y, x] += 1


@njit(nogil=True, cache=True, error_model="numpy")
def _twiced(depth_mm, means, per_mm2):  # type: ignore[no-untyped-def]
    """Each reading and its difference to the mean, of which so much · depth² counts, and less beyond: nothing of three
    times as much (Hampel's three-part weight)."""
    out = np.zeros(depth_mm.shape, np.uint16)
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            z = np.float32(depth_mm[y, x])
            if z > 0:
                limit = per_mm2 * z * z
                change = z - means[y, x]
                fading = min(max((3 * limit - abs(change)) / (2 * limit), np.float32(0)), np.float32(1))
                change = min(max(change, -limit), limit) * fading
                out[y, x] = min(max(np.rint(z + change), np.float32(1)), np.float32(65535))
    return out
