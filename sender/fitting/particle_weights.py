"""How well particles explain a cloud: the share of its points inside the ellipsoids (Rao & Hodges §6).

The ellipsoids of a particle are tried in order and a point belongs to the first that contains it (the paper's BNE
flag). The paper prints the inside test as three separate bounds, which is a box of 1.91 times the ellipsoid's volume;
this is the ellipsoid. The paper's score is one-sided: ellipsoids without points cost nothing, so limbs may hide in
the torso. With expected shares, an ellipsoid that holds too few points lowers the weight.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]
Floats32 = NDArray[np.float32]

BLOCK = 512  # points at a time: they stay in the fastest cache for all ellipsoids of all particles


class ParticleWeights(Protocol):
    """Weights of P particles on some device.

    ``points`` (N, 3) float32 [m, world], C-contiguous. ``quadrics`` (P, E, 3, 4) float32, C-contiguous: maps of
    ``ellipsoid_body.quadrics``; point p is inside ellipsoid e where |Q_e [p, 1]|² ≤ 1. ``expected`` (E,) float32, sum
    at most 1: the share of all points that each ellipsoid should hold at least; zeros give the paper's score.
    Returns (P,) float32 in [0, 1]: with c_e = points claimed by e ÷ N,
    ``(Σ_e c_e) · (1 − Σ_e max(0, expected_e − c_e))``; 0 without points.
    """

    def __call__(self, points: Floats32, quadrics: Floats32, expected: Floats32) -> Floats32: ...


def numba_weights(points: Floats32, quadrics: Floats32, expected: Floats32) -> Floats32:
    """``ParticleWeights`` on one CPU core."""
    return weights_of(claimed_points(points, quadrics), len(points), expected)


def claimed_points(points: Floats32, quadrics: Floats32) -> Floats32:
    """Points each ellipsoid claims, (P, E) float32 (whole numbers; exact up to 2²⁴ points); arguments as in
    ``ParticleWeights``."""
    counts = np.zeros(quadrics.shape[:2], np.float32)
    x, y, z = np.ascontiguousarray(points.T)
    _claim(x, y, z, quadrics, counts)
    return counts


def weights_of(claimed: Floats32, point_count: int, expected: Floats32) -> Floats32:
    """Weights (P,) float32 of ``claimed`` points (P, E), as in ``ParticleWeights``."""
    shares = claimed / np.float32(max(point_count, 1))
    missing = np.maximum(expected - shares, np.float32(0)).sum(axis=1)
    return np.asarray(shares.sum(axis=1) * (1 - missing), np.float32)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _claim(x: Array, y: Array, z: Array, quadrics: Array, counts: Array) -> None:
    """Adds to ``counts`` (P, E). A point's smallest |Q p|² so far stands for its flag: at most 1 once claimed."""
    nearest = np.empty(BLOCK, np.float32)
    one, zero = np.float32(1), np.float32(0)
    for start in range(0, len(x), BLOCK):
        bx, by, bz = x[start : start + BLOCK], y[start : start + BLOCK], z[start : start + BLOCK]
        n = len(bx)
        for p in range(len(quadrics)):
            nearest[:n] = np.inf
            before = zero
            for e in range(quadrics.shape[1]):
                q = quadrics[p, e]
                a, b, c, d = q[0, 0], q[0, 1], q[0, 2], q[0, 3]
                f, g, h, k = q[1, 0], q[1, 1], q[1, 2], q[1, 3]
                r, s, t, o = q[2, 0], q[2, 1], q[2, 2], q[2, 3]
                inside = zero
                for i in range(n):
                    u = a * bx[i] + b * by[i] + c * bz[i] + d
                    v = f * bx[i] + g * by[i] + h * bz[i] + k
                    w = r * bx[i] + s * by[i] + t * bz[i] + o
                    m = min(nearest[i], u * u + v * v + w * w)
                    nearest[i] = m
                    inside += one if m <= one else zero
                counts[p, e] += inside - before
                before = inside
