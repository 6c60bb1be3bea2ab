"""The virtual rig: where its cameras stand, and the room they stand in.

The first camera looks at the performer's front (from +Z), the others stand evenly around. The room is a box with a
tiled floor; its pictures are ray-cast, once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera, pixel_rays
from common.geometry.rigid_transform import look_at

RADIUS_M, HEIGHT_M = 2.7, 1.3  # distance of the cameras from the origin, and their height
HORIZONTAL_VIEW_RAD = np.deg2rad(64.0)  # at 640×480 that is 50° vertically: from the floor a step ahead of the
REACH_M, STEP_M = 2.2, 0.4  # person, STEP_M, up to raised hands, REACH_M, at 2.7 m
ROOM_HALF_M, ROOM_HEIGHT_M = 3.5, 3.0
_TILE_M = 0.4


@dataclass(frozen=True, slots=True)
class RigSettings:
    """What the virtual rig shows and how; ``skew_ms``: the last camera's shutter opens so much after the first's."""

    performer: str = "builtin"
    motion: str | None = None
    data: str | None = None
    cameras: int = 4
    width: int = 640
    height: int = 480
    fps: float = 30.0
    seed: int = 1
    skew_ms: float = 0.0
    dropout: float = 0.0
    noise: bool = True

    def __post_init__(self) -> None:
        if not (1 <= self.cameras <= 16 and 1 <= self.fps <= 240 and 0 <= self.dropout < 1):
            raise ValueError(f"virtual rig: {self.cameras} cameras, {self.fps} fps, dropout {self.dropout}")
        if not (16 <= self.width <= 4096 and 16 <= self.height <= 4096 and 0 <= self.skew_ms < 1000):
            raise ValueError(f"virtual rig: {self.width}×{self.height}, skew {self.skew_ms} ms")


def cameras_around(count: int, width: int = 640, height: int = 480) -> tuple[Camera, ...]:
    """``count`` cameras ``cam1``… evenly around the origin, the first at +Z, tilted to see feet and raised hands."""
    focal = width / 2 / np.tan(HORIZONTAL_VIEW_RAD / 2)
    tilt = (np.arctan2(REACH_M - HEIGHT_M, RADIUS_M) - np.arctan2(HEIGHT_M, RADIUS_M - STEP_M)) / 2
    target = np.array([0.0, HEIGHT_M + RADIUS_M * np.tan(tilt), 0.0])
    cameras = []
    for index in range(count):
        around = 2 * np.pi * index / count
        eye = np.array([RADIUS_M * np.sin(around), HEIGHT_M, RADIUS_M * np.cos(around)])
        pose = look_at(eye, target).astype(np.float64)
        centre = (width - 1) / 2, (height - 1) / 2
        cameras.append(Camera(f"cam{index + 1}", width, height, focal, focal, *centre, pose))
    return tuple(cameras)


def room_view(camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The empty room: colour (H, W, 3) uint8 RGB and depth (H, W) float32 [m along the optical axis]."""
    eye = camera.T_world_camera[:3, 3]
    rays = pixel_rays(camera).astype(np.float64) @ camera.T_world_camera[:3, :3].T
    low = np.array([-ROOM_HALF_M, 0.0, -ROOM_HALF_M])
    high = np.array([ROOM_HALF_M, ROOM_HEIGHT_M, ROOM_HALF_M])
    with np.errstate(divide="ignore"):
        to_walls = np.where(rays > 0, high - eye, low - eye) / rays  # per axis; the room is convex: the nearest counts
    to_walls[~np.isfinite(to_walls)] = np.inf
    axis = to_walls.argmin(axis=-1)
    depth = np.take_along_axis(to_walls, axis[..., None], axis=-1)[..., 0]
    points = eye + depth[..., None] * rays
    return _room_colour(points, axis), depth.astype(np.float32)


def _room_colour(points: NDArray[np.float64], axis: NDArray[np.intp]) -> NDArray[np.uint8]:
    """Paint (H, W, 3) of points on the room's surfaces: tiles below, a skirting board and mottled paint around."""
    x, y, z = np.moveaxis(points, -1, 0)
    checker = (np.floor(x / _TILE_M) + np.floor(z / _TILE_M)) % 2
    floor = np.array([150.0, 128.0, 104.0]) + 26 * checker[..., None]
    along = np.where(axis == 0, z, x)
    mottle = 6 * np.sin(7.1 * along + 1.3 * np.sin(5.3 * y)) * np.sin(6.4 * y) + 3 * np.sin(41 * along) * np.sin(37 * y)
    wall = np.array([176.0, 186.0, 190.0]) - np.array([18.0, 10.0, 0.0]) * (axis == 0)[..., None] + mottle[..., None]
    wall = np.where((y < 0.12)[..., None], 96.0, wall)
    ceiling = np.full(3, 225.0)
    paint = np.where((axis == 1)[..., None], np.where((y < ROOM_HEIGHT_M / 2)[..., None], floor, ceiling), wall)
    return np.clip(paint, 0, 255).astype(np.uint8)
