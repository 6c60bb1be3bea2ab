"""Silhouettes of balls, by geometry alone: a pixel is a person when its ray meets a ball."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.geometry.camera_model import Camera, pixel_rays
from common.geometry.rigid_transform import look_at
from sender.reconstruction.silhouette import BACKGROUND, PERSON, Silhouette

Ball = tuple[tuple[float, float, float], float]  # centre [m, world] and radius [m]


def camera_at(name: str, eye: tuple[float, float, float], width: int = 320, height: int = 240) -> Camera:
    """A pinhole that looks at the origin; pictures 64° wide."""
    up = np.array([0.0, 0.0, -1.0]) if abs(eye[1]) > 1 else None
    pose = look_at(np.array(eye), np.zeros(3), up)
    return Camera(name, width, height, 0.8 * width, 0.8 * width, (width - 1) / 2, (height - 1) / 2, pose)


def three_cameras(distance_m: float = 3.0) -> list[Camera]:
    """One along each axis, as in Rao & Hodges Fig. 8."""
    return [
        camera_at("front", (0.0, 0.0, distance_m)),
        camera_at("side", (distance_m, 0.0, 0.0)),
        camera_at("above", (0.0, distance_m, 0.0)),
    ]


def in_cones(points: np.ndarray, camera: Camera, balls: Sequence[Ball], slack_px: float = 0.0) -> np.ndarray:
    """Which of ``points`` (N, 3) the camera sees before or behind a ball whose outline is ``slack_px`` larger."""
    away = points - camera.T_world_camera[:3, 3]
    directions = away / np.linalg.norm(away, axis=1, keepdims=True)
    hit = np.zeros(len(points), bool)
    for centre, radius_m in balls:
        to_ball = np.array(centre) - camera.T_world_camera[:3, 3]
        distance_m = np.linalg.norm(to_ball)
        angle = np.arccos(np.clip(directions @ (to_ball / distance_m), -1, 1))
        hit |= angle <= np.arcsin(radius_m / distance_m) + slack_px / camera.fx
    return hit


def silhouette(camera: Camera, *balls: Ball) -> Silhouette:
    """What the camera sees of the balls."""
    rays = pixel_rays(camera).reshape(-1, 3).astype(float) @ camera.T_world_camera[:3, :3].T
    hit = in_cones(camera.T_world_camera[:3, 3] + rays, camera, balls)
    mask = np.where(hit, PERSON, BACKGROUND).astype(np.uint8).reshape(camera.height, camera.width)
    return Silhouette(camera, mask)


def silhouettes(cameras: Sequence[Camera], *balls: Ball) -> list[Silhouette]:
    """What all of them see."""
    return [silhouette(camera, *balls) for camera in cameras]
