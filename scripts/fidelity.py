"""How good the received person looks and how true the joints are: the measures every bench and report shares.

Six views 60° apart, 480×480, the true person filling 80 % of the height, white background, unlit; squared error is
averaged over the views before the logarithm. One sample a pixel, at its centre, or the mean of ``SAMPLES``², as a
screen's smooth edges have it: single samples of a striped shirt and of outlines are off by much for half a pixel.
e_t is Lien 2009 §6's joint error over the radius of the bounding ball.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from common.geometry.rigid_transform import look_at

VIEWS = 6
IMAGE_PIXELS = 480
PERSON_SHARE_OF_HEIGHT = 0.8
DISTANCE_M = 4.0
SAMPLES = 3  # each way in a pixel, the middle one at its centre


Picture = tuple[NDArray[np.uint8], NDArray[np.float32]]


@dataclass(frozen=True)
class Fidelity:
    """One instant: ``psnr_db`` whole images, ``psnr_inside_db`` inside both silhouettes, ``iou`` of silhouettes."""

    psnr_db: float
    psnr_inside_db: float
    iou: float


def measuring_cameras(surface: NDArray[np.floating]) -> list[Camera]:
    """Six cameras around a true surface (V, 3) [m, world]."""
    low, high = surface.min(axis=0), surface.max(axis=0)
    centre = (low + high) / 2
    focal = PERSON_SHARE_OF_HEIGHT * IMAGE_PIXELS * DISTANCE_M / max(high[1] - low[1], 0.3)
    cameras = []
    for view in range(VIEWS):
        angle = 2 * np.pi * view / VIEWS
        eye = centre + DISTANCE_M * np.array([np.sin(angle), 0, np.cos(angle)])
        middle = (IMAGE_PIXELS - 1) / 2
        cameras.append(
            Camera(f"view{view}", IMAGE_PIXELS, IMAGE_PIXELS, focal, focal, middle, middle, look_at(eye, centre))
        )
    return cameras


def finer(camera: Camera, samples: int = SAMPLES) -> Camera:
    """The same view with so many samples each way in a pixel."""
    return replace(
        camera,
        width=samples * camera.width,
        height=samples * camera.height,
        fx=samples * camera.fx,
        fy=samples * camera.fy,
        cx=samples * (camera.cx + 0.5) - 0.5,
        cy=samples * (camera.cy + 0.5) - 0.5,
    )


def centres(picture: Picture) -> Picture:
    """Of a finer camera's picture the samples at the pixels' centres: what the camera itself sees."""
    colour, depth = (image[SAMPLES // 2 :: SAMPLES, SAMPLES // 2 :: SAMPLES] for image in picture)
    return np.ascontiguousarray(colour), np.ascontiguousarray(depth)


def smooth(colour: NDArray[np.uint8], samples: int = SAMPLES) -> NDArray[np.uint8]:
    """The pixels' means (H, W, 3) of a finer camera's colour."""
    size = colour.shape[1] // samples, colour.shape[0] // samples
    return np.asarray(cv2.resize(colour, size, interpolation=cv2.INTER_AREA), np.uint8)


def smooth_psnr_db(truth: list[NDArray[np.uint8]], shown: list[NDArray[np.uint8]]) -> float:
    """PSNR of pictures (H, W, 3) of the same views."""
    squared = [cv2.norm(a, b, cv2.NORM_L2SQR) for a, b in zip(truth, shown, strict=True)]
    return psnr_db(float(sum(squared)), sum(a.size for a in truth))


def compare(
    truth: list[tuple[NDArray[np.uint8], NDArray[np.float32]]],
    shown: list[tuple[NDArray[np.uint8], NDArray[np.float32]]],
) -> Fidelity:
    """Compare rendered (colour (H, W, 3), depth (H, W) with 0 = nothing) pairs of the same views."""
    total = np.zeros(5)
    for (true_colour, true_depth), (colour, depth) in zip(truth, shown, strict=True):
        total += _errors(true_colour, true_depth, colour, depth)
    squared, inside_squared, pixels, both, either = total.tolist()
    return Fidelity(psnr_db(squared, int(3 * pixels)), psnr_db(inside_squared, int(3 * both)), both / max(either, 1))


@njit(nogil=True, cache=True)
def _errors(true_colour, true_depth, colour, depth):  # type: ignore[no-untyped-def]
    """Σ squared error, the same where both see the person; pixels: all, where both and where either sees the person."""
    out = np.zeros(5)
    for v in range(true_depth.shape[0]):
        for u in range(true_depth.shape[1]):
            error = np.int64(0)
            for n in range(3):
                error += (np.int64(true_colour[v, u, n]) - np.int64(colour[v, u, n])) ** 2
            out[0] += error
            out[2] += 1
            true_seen, seen = true_depth[v, u] > 0, depth[v, u] > 0
            if true_seen and seen:
                out[1] += error
                out[3] += 1
            if true_seen or seen:
                out[4] += 1
    return out


def psnr_db(squared_error: float, samples: int) -> float:
    """PSNR of 8-bit samples from their summed squared error, at most 99 dB; 0 dB where nothing compares."""
    if samples == 0:
        return 0.0
    return 99.0 if squared_error == 0 else min(99.0, float(10 * np.log10(255.0**2 * samples / squared_error)))


def bounding_ball_radius(points: NDArray[np.floating]) -> float:
    """R of e_t [m]: radius of a ball around all points (V, 3), centred on their bounding box."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return float(np.linalg.norm(points - centre, axis=1).max())


def constant_offsets(
    estimated: NDArray[np.floating], rotations: NDArray[np.floating], truth: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Estimated joints (N, 16, 3) after one constant offset per joint in its link's frame (least squares).

    ``rotations`` (N, 16, 3, 3): R_world_link of each joint's link. A clothed surface does not show where the joint
    inside is; what stays after this is the error of the pose.
    """
    error = np.asarray(truth, np.float64) - estimated
    in_link = np.einsum("njba,njb->nja", rotations, error)
    return estimated + np.einsum("njab,jb->nja", rotations, in_link.mean(axis=0))


def joint_errors_m(estimated: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean joint distance of each frame (N,) [m] of joints (N, 16, 3)."""
    return np.linalg.norm(np.asarray(estimated, np.float64) - truth, axis=2).mean(axis=1)
