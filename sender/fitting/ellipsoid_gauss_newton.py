"""Particles brought onto the cloud by Gauss–Newton on the points' distances to the ellipsoids.

An annealed filter's particles come near the pose and stop at the spread of its last layer. A few steps of least
squares from the best of them find the pose itself. A point belongs to the ellipsoid whose surface is nearest, with a
first-order distance and a Geman–McClure weight; each ellipsoid sums 6×6 normal equations, which are projected on the
angles.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sender.fitting.ellipsoid_body import EllipsoidBody, link_transforms, quadrics

Array = NDArray[Any]
Floats = NDArray[np.float64]

DAMPING = 1e-3  # of the mean curvature: what the points do not show stays where it is
_STEP = 1e-4  # rad or m: finite differences of the kinematics


class Polish(NamedTuple):
    """``steps``: Gauss–Newton steps; ``sigma_m``: distance at which a point's weight has fallen to a quarter."""

    steps: int = 6
    sigma_m: float = 0.03


def polished(
    body: EllipsoidBody, points: Array, particles: Floats, T_world_parent: Floats, plan: Polish
) -> tuple[Floats, Floats]:
    """``particles`` (P, D) after ``plan.steps`` steps each, and their mean robust costs (P,), 0 (every point on the
    surface) .. 1. ``points`` (N, 3) [m, world]; ``body``: ellipsoids that are the surface; its limits are kept."""
    count, D = particles.shape
    H, g = np.empty((count, len(body.axes), 6, 6)), np.empty((count, len(body.axes), 6))
    costs = np.empty(count)
    for _ in range(plan.steps):
        _sums(points, quadrics(body, particles, T_world_parent), plan.sigma_m, H, g, costs)
        S = _motions(body, particles, T_world_parent)
        SH = S.transpose(0, 2, 1, 3) @ H
        A = np.matmul(SH, S.transpose(0, 2, 3, 1)).sum(axis=1)
        b = (S.transpose(0, 2, 1, 3) @ g[..., None]).sum(axis=1)
        A[:, np.arange(D), np.arange(D)] += (DAMPING * np.trace(A, axis1=1, axis2=2) / D)[:, None]
        particles = np.clip(particles + np.linalg.solve(A, b)[..., 0], body.low, body.high)
    _sums(points, quadrics(body, particles, T_world_parent), plan.sigma_m, H, g, costs)
    return particles, costs / max(len(points), 1)


def _motions(body: EllipsoidBody, particles: Floats, T_world_parent: Floats) -> Floats:
    """How every ellipsoid moves (P, D, E, 6) per unit of each degree of freedom: (ω, v), velocity at p = ω × p + v."""
    count, D = particles.shape
    shifts = np.concatenate([_STEP * np.eye(D), -_STEP * np.eye(D), np.zeros((1, D))])
    beside = (particles[:, None] + shifts).reshape(-1, D)
    T = link_transforms(body, beside, T_world_parent)[:, body.ellipsoid_link]
    T = T.reshape(count, 2 * D + 1, len(body.axes), 3, 4)
    dT = (T[:, :D] - T[:, D : 2 * D]) / (2 * _STEP)
    R, t = T[:, -1:, :, :, :3], T[:, -1:, :, :, 3]
    W = dT[..., :3] @ np.swapaxes(R, -1, -2)
    wx, wy, wz = W[..., 2, 1], W[..., 0, 2], W[..., 1, 0]
    x, y, z = t[..., 0], t[..., 1], t[..., 2]
    at_origin = np.stack([wy * z - wz * y, wz * x - wx * z, wx * y - wy * x], axis=-1)
    return np.concatenate([np.stack([wx, wy, wz], axis=-1), dT[..., 3] - at_origin], axis=-1)


@njit(nogil=True, cache=True, error_model="numpy")
def _sums(points: Array, quadrics: Array, sigma: float, H: Array, g: Array, costs: Array) -> None:
    """Sums H (P, E, 6, 6) and g (P, E, 6) over the points, and the Geman–McClure cost d² / (d² + σ²) to ``costs``."""
    H[:] = 0.0
    g[:] = 0.0
    costs[:] = 0.0
    J = np.empty(6)
    for p in range(len(quadrics)):
        for n in range(len(points)):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            own, d, nx, ny, nz = _nearest(quadrics[p], x, y, z)
            far = d * d + sigma * sigma
            costs[p] += d * d / far
            weight = (sigma * sigma / far) ** 2
            J[0], J[1], J[2] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            J[3], J[4], J[5] = nx, ny, nz
            for i in range(6):
                g[p, own, i] += weight * d * J[i]
                for j in range(i + 1):
                    H[p, own, i, j] += weight * J[i] * J[j]
    for p in range(len(quadrics)):
        for e in range(quadrics.shape[1]):
            for i in range(6):
                for j in range(i):
                    H[p, e, j, i] = H[p, e, i, j]


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest(Q: Array, x: float, y: float, z: float) -> tuple[int, float, float, float, float]:
    """The ellipsoid whose surface is nearest to a point, the signed distance [m] to first order, and its normal."""
    best, own = np.inf, 0
    d = nx = ny = nz = 0.0
    for e in range(len(Q)):
        q = Q[e]
        u = q[0, 0] * x + q[0, 1] * y + q[0, 2] * z + q[0, 3]
        v = q[1, 0] * x + q[1, 1] * y + q[1, 2] * z + q[1, 3]
        w = q[2, 0] * x + q[2, 1] * y + q[2, 2] * z + q[2, 3]
        a = q[0, 0] * u + q[1, 0] * v + q[2, 0] * w
        b = q[0, 1] * u + q[1, 1] * v + q[2, 1] * w
        c = q[0, 2] * u + q[1, 2] * v + q[2, 2] * w
        r = np.sqrt(u * u + v * v + w * w)
        s = max(np.sqrt(a * a + b * b + c * c), 1e-9)
        off = (r - 1.0) * r / s
        if abs(off) < best:
            best, own = abs(off), e
            d, nx, ny, nz = off, a / s, b / s, c / s
    return own, d, nx, ny, nz
