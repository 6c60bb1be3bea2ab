"""How like its input a decoded cloud looks (Lien §6.3): PSNR of six rendered views 60° apart, as all benches render.

Points are round splats of 12 mm radius, which close the gaps between 10 000 points on a body, on white, with 2 × 2
samples a pixel: without these the edges of single splats decide, and 1 mm of noise in the input alone gives 31 dB.
The paper's printed rmse lacks 1/N; here it is the mean.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from common.geometry.camera_model import Camera
from common.geometry.point_cloud import PointCloud
from common.geometry.point_splats import render_points
from scripts.fidelity import Picture, compare, measuring_cameras

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


def likeness(truth: PointCloud, shown: PointCloud) -> Likeness:
    """How like ``truth`` a cloud looks from around it."""
    cameras = measuring_cameras(truth.positions)
    pairs = list(zip(pictures(truth, cameras), pictures(shown, cameras), strict=True))
    all_views = compare([a for a, _ in pairs], [b for _, b in pairs]).psnr_db
    return Likeness(all_views, min(compare([a], [b]).psnr_db for a, b in pairs))


def _picture(cloud: PointCloud, camera: Camera) -> Picture:
    fine = replace(
        camera,
        width=SAMPLES * camera.width,
        height=SAMPLES * camera.height,
        fx=SAMPLES * camera.fx,
        fy=SAMPLES * camera.fy,
        cx=SAMPLES * (camera.cx + 0.5) - 0.5,
        cy=SAMPLES * (camera.cy + 0.5) - 0.5,
    )
    colour, depth = render_points(cloud.positions, cloud.colours, fine, SPLAT_RADIUS_M)
    mean = cv2.resize(colour, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(mean, np.uint8), np.ascontiguousarray(depth[::SAMPLES, ::SAMPLES])
