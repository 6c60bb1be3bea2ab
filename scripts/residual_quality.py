"""How like its input a decoded cloud looks (Lien §6.3): PSNR of six rendered views 60° apart, as all benches render.

The cameras do not zoom: the person fills 80 % of the height in the sequence's tallest frame. Other benches zoom in on
who crouches, which makes quality seem to vary with the motion.
Points are round splats of 12 mm radius, which close the gaps between 10 000 points on a body, on white, with 2 × 2
samples a pixel: without these the edges of single splats decide, and 1 mm of noise in the input alone gives 31 dB.
The paper's printed rmse lacks 1/N; here it is the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry.camera_model import Camera
from common.geometry.point_cloud import PointCloud
from common.geometry.point_splats import render_points
from scripts.fidelity import Picture, compare, finer, measuring_cameras, smooth

SPLAT_RADIUS_M = 0.012
SAMPLES = 2  # each way in a pixel


@dataclass(frozen=True, slots=True)
class Likeness:
    """Of one frame: all six views together, and the worst of them."""

    psnr_db: float
    worst_view_db: float


def pictures(cloud: PointCloud, cameras: list[Camera]) -> list[Picture]:
    """The cloud seen by each camera."""
    return [_picture(cloud, camera) for camera in cameras]


def fixed_cameras(cloud: PointCloud, height_m: float) -> list[Camera]:
    """Six cameras around a cloud that see ``height_m`` in 80 % of theirs."""
    middle = (cloud.positions.min(axis=0) + cloud.positions.max(axis=0)) / 2
    return measuring_cameras(np.stack([middle, middle]) + np.array([[0, -0.5, 0], [0, 0.5, 0]]) * height_m)


def likeness(truth: PointCloud, shown: PointCloud, height_m: float, true: list[Picture] | None = None) -> Likeness:
    """How like ``truth`` a cloud looks from around it; ``height_m``: the tallest in the sequence. ``true``: the truth's
    pictures by the fixed cameras, where they are known."""
    cameras = fixed_cameras(truth, height_m)
    pairs = list(zip(true or pictures(truth, cameras), pictures(shown, cameras), strict=True))
    all_views = compare([a for a, _ in pairs], [b for _, b in pairs]).psnr_db
    return Likeness(all_views, min(compare([a], [b]).psnr_db for a, b in pairs))


def _picture(cloud: PointCloud, camera: Camera) -> Picture:
    colour, depth = render_points(cloud.positions, cloud.colours, finer(camera, SAMPLES), SPLAT_RADIUS_M)
    return smooth(colour, SAMPLES), np.ascontiguousarray(depth[::SAMPLES, ::SAMPLES])
