"""Pinhole camera with Brown–Conrady distortion; depth and colour share one image (colour registered to depth)."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from common.geometry.rigid_transform import inverse


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """One calibrated depth camera.

    ``T_world_camera``: (4, 4) float64, camera frame x right, y down, z forward.
    ``distortion``: (5,) float64, k1 k2 p1 p2 k3 (OpenCV order), zeros when rectified.

    Raises:
        ValueError: sizes, focal lengths or matrices that cannot be a camera.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    T_world_camera: NDArray[np.float64]
    distortion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(5))

    def __post_init__(self) -> None:
        T = np.ascontiguousarray(self.T_world_camera, np.float64)
        k = np.zeros(5)
        given = np.asarray(self.distortion, np.float64).ravel()
        if given.size > 5:
            raise ValueError(f"camera {self.name}: {given.size} distortion terms, at most 5 are supported")
        k[: given.size] = given
        object.__setattr__(self, "T_world_camera", T)
        object.__setattr__(self, "distortion", k)
        if not (0 < self.width <= 8192 and 0 < self.height <= 8192):
            raise ValueError(f"camera {self.name}: image size {self.width}×{self.height}")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0 and self.fy > 0):
            raise ValueError(f"camera {self.name}: intrinsics fx={self.fx} fy={self.fy} cx={self.cx} cy={self.cy}")
        if T.shape != (4, 4) or not np.isfinite(T).all() or not np.isfinite(k).all():
            raise ValueError(f"camera {self.name}: pose or distortion is not finite")
        if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3 or np.linalg.det(T[:3, :3]) < 0:
            raise ValueError(f"camera {self.name}: T_world_camera is not a rigid transform")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Intrinsic matrix K (3, 3) [pixels]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])


def pixel_rays(camera: Camera) -> NDArray[np.float32]:
    """Undistorted viewing rays (H, W, 3) float32, camera frame, z = 1: point = depth_m × ray.

    Computed once per camera: the inverse distortion is iterative.
    """
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    xy = cv2.undistortPoints(pixels, camera.matrix, camera.distortion).reshape(camera.height, camera.width, 2)
    return np.concatenate([xy, np.ones_like(xy[..., :1])], -1).astype(np.float32)


def project(camera: Camera, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (N, 2) and depths (N,) [m] of world points (N, 3); depth <= 0 is behind the camera."""
    T_camera_world = inverse(camera.T_world_camera)
    p = np.asarray(points, np.float64) @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    pixels, _ = cv2.projectPoints(p.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return np.asarray(pixels, np.float64).reshape(-1, 2), p[:, 2]
