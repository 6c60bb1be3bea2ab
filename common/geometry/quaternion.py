"""Unit quaternions ``(w, x, y, z)`` acting as rotations; all functions broadcast over leading axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def normalized(q: Array) -> Array:
    """Quaternions (..., 4) scaled to unit length, same dtype."""
    unit: Array = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return unit


def conjugate(q: Array) -> Array:
    """Inverse rotation of unit quaternions (..., 4)."""
    return q * np.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product (..., 4): the rotation ``a`` after ``b``."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def to_matrix(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    m = np.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ],
        axis=-1,
    )
    return m.reshape(*q.shape[:-1], 3, 3)


def from_matrix(R: Array) -> Array:
    """Unit quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3) (Bar-Itzhack's stable branches)."""
    m = np.asarray(R)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    yz, zx, xy = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    sxy, sxz, syz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    rows = np.stack(
        [
            np.stack([1 + xx + yy + zz, yz, zx, xy], -1),
            np.stack([yz, 1 + xx - yy - zz, sxy, sxz], -1),
            np.stack([zx, sxy, 1 - xx + yy - zz, syz], -1),
            np.stack([xy, sxz, syz, 1 - xx - yy + zz], -1),
        ],
        axis=-2,
    )
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = normalized(np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :])
    return np.where(q[..., :1] < 0, -q, q)


def from_rotation_vector(v: Array) -> Array:
    """Unit quaternions (..., 4) of rotation vectors (..., 3) [rad]."""
    v = np.asarray(v, float)
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * v], axis=-1)


def to_rotation_vector(q: Array) -> Array:
    """Rotation vectors (..., 3) [rad], angle in [0, π], of unit quaternions (..., 4)."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def angle_between(a: Array, b: Array) -> Array:
    """Angle (...,) [rad] of the rotation from ``b`` to ``a``."""
    return np.linalg.norm(to_rotation_vector(multiply(a, conjugate(b))), axis=-1)


def slerp(a: Array, b: Array, t: float | Array) -> Array:
    """Spherical interpolation (..., 4) from ``a`` (t = 0) to ``b`` (t = 1); t outside [0, 1] extrapolates."""
    step = to_rotation_vector(multiply(b, conjugate(a)))
    return multiply(from_rotation_vector(np.asarray(t)[..., None] * step), a)


def shortest_arc(a: Array, b: Array) -> Array:
    """Smallest rotations (..., 4) turning directions ``a`` (..., 3) onto directions ``b`` (..., 3)."""
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    dot = np.sum(a * b, axis=-1, keepdims=True)
    axis = np.cross(a, b)
    helper = np.where(np.abs(a[..., :1]) < 0.9, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    axis = np.where(dot < -1 + 1e-9, np.cross(a, helper), axis)  # opposite: any perpendicular axis will do
    return normalized(np.concatenate([np.where(dot < -1 + 1e-9, 0.0, 1 + dot), axis], axis=-1))
