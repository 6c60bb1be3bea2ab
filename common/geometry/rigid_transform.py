"""Rigid transforms as 4×4 matrices ``T_target_source`` (``p_target = T_target_source @ p_source``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def rigid_transform(rotation: Array, translation: Array) -> Array:
    """Stack rotations (..., 3, 3) and translations (..., 3) [m] into transforms (..., 4, 4)."""
    rotation = np.asarray(rotation)
    T = np.zeros((*rotation.shape[:-2], 4, 4), np.result_type(rotation, np.asarray(translation)))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def inverse(T: Array) -> Array:
    """Inverse of rigid transforms (..., 4, 4): ``T_source_target`` from ``T_target_source``."""
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    return rigid_transform(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def transform_points(T_target_source: Array, points: Array) -> Array:
    """Points (N, 3) [m, source frame] in the target frame, (N, 3), dtype of the points."""
    T = np.asarray(T_target_source, points.dtype)
    return np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3])


def look_at(eye: Array, target: Array, up: Array | None = None) -> NDArray[np.float64]:
    """``T_world_camera`` (4, 4) of an OpenCV camera at ``eye`` (3,) looking at ``target`` (3,) [m, world].

    Raises:
        ValueError: eye and target coincide, or the view direction is parallel to ``up`` (default: world y).
    """
    forward = np.asarray(target, float) - np.asarray(eye, float)
    right = np.cross(forward, np.array([0.0, 1.0, 0.0]) if up is None else up)
    if np.linalg.norm(forward) < 1e-9 or np.linalg.norm(right) < 1e-9:
        raise ValueError("look_at: eye, target and up do not span a view")
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    R_world_camera = np.stack([right, np.cross(forward, right), forward], axis=1)
    return np.asarray(rigid_transform(R_world_camera, np.asarray(eye, float)), np.float64)
