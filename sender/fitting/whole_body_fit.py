"""All joint angles at once on ellipsoids: Gauss–Newton that needs neither a learned surface nor normals.

A point with a normal lies on the skin: what counts is its distance to the nearest ellipsoid whose surface faces its way
there. A point without one (zeros: a visual hull's) lies somewhere inside the body: what counts is its offset from the
ellipsoid's middle in units of the semi-axes, and the sum is least where the points fill the ellipsoid evenly. Steps,
priors and joint limits are those of ``articulated_gauss_newton``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sender.fitting.articulated_gauss_newton import (
    PoseState,
    Schedule,
    apply_step,
    forward,
    project_on_axes,
    solve,
)
from sender.fitting.joint_limits import JointTable, add_priors
from sender.fitting.whole_body_ellipsoids import Ellipsoids, unit_maps

Array = NDArray[Any]

DATA_SIGMA_M = 0.05  # of one of 2,500 points; neighbours share their errors
SMALLER_FIRST = 0.4  # times the logarithm of the volume: a point inside two ellipsoids is rather the limb's
INLIER_M = 0.035


class EllipsoidFit(NamedTuple):
    """``score``: mean robust cost per point, 0 (all explained) .. 1 (none). ``inliers``: share of points within
    ``INLIER_M`` of the body, inside counts for points without a normal; ``rms_m``: their distance from the surface.
    ``explained`` (E,) float64: inliers of each ellipsoid; ``owner`` (N,) int64: the ellipsoid of each, -1 otherwise."""

    pose: PoseState
    score: float
    inliers: float
    rms_m: float
    explained: Array
    owner: Array


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_ellipsoids(points: Array, normals: Array, maps: Array, bias: Array, owner: Array, distance: Array) -> None:
    """Each point's ellipsoid ``owner`` (N,) int64 (-1: none) and signed distance to its surface ``distance`` (N,) [m],
    to first order; ``maps`` (E, 3, 4) as of ``unit_maps``, ``bias`` (E,): added to |Q p|² for points inside."""
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        a, b, c = normals[n, 0], normals[n, 1], normals[n, 2]
        skin = a != 0.0 or b != 0.0 or c != 0.0
        best = np.inf
        owner[n], distance[n] = -1, np.inf
        for e in range(len(maps)):
            M = maps[e]
            u = M[0, 0] * x + M[0, 1] * y + M[0, 2] * z + M[0, 3]
            v = M[1, 0] * x + M[1, 1] * y + M[1, 2] * z + M[1, 3]
            w = M[2, 0] * x + M[2, 1] * y + M[2, 2] * z + M[2, 3]
            gx = M[0, 0] * u + M[1, 0] * v + M[2, 0] * w
            gy = M[0, 1] * u + M[1, 1] * v + M[2, 1] * w
            gz = M[0, 2] * u + M[1, 2] * v + M[2, 2] * w
            if skin and gx * a + gy * b + gz * c < 0.0:
                continue
            square = u * u + v * v + w * w
            q = np.sqrt(square) + 1e-9
            d = (q - 1.0) * q / (np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-9)
            cost = abs(d) if skin else square + bias[e]
            if cost < best:
                best = cost
                owner[n], distance[n] = e, d


@njit(nogil=True, cache=True, error_model="numpy")
def _normal_equations(
    points: Array,
    normals: Array,
    owner: Array,
    distance: Array,
    maps: Array,
    ellipsoids: Ellipsoids,
    root: Array,
    gate: float,
    H: Array,
    g: Array,
) -> None:
    """Sums each link's H (L, 6, 6) and g (L, 6) of the twist (ω, v) about the root joint; Geman–McClure weights. A
    point on the skin gives one row, along the surface's normal; a point inside three, along the semi-axes."""
    H[:] = 0.0
    g[:] = 0.0
    sigma2 = (0.5 * gate) ** 2
    u, rows, residuals, J = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(6)
    for n in range(len(points)):
        e = owner[n]
        if e < 0 or distance[n] > gate:
            continue
        M = maps[e]
        p0, p1, p2 = points[n, 0], points[n, 1], points[n, 2]
        for k in range(3):
            u[k] = M[k, 0] * p0 + M[k, 1] * p1 + M[k, 2] * p2 + M[k, 3]
        d = distance[n]
        if normals[n, 0] != 0.0 or normals[n, 1] != 0.0 or normals[n, 2] != 0.0:
            length = 1e-9
            for i in range(3):
                rows[0, i] = M[0, i] * u[0] + M[1, i] * u[1] + M[2, i] * u[2]
                length += rows[0, i] * rows[0, i]
            for i in range(3):
                rows[0, i] /= np.sqrt(length)
            residuals[0] = d
            count = 1
        else:
            d = max(d, 0.0)
            scale = min(ellipsoids.axes[e, 0], ellipsoids.axes[e, 1], ellipsoids.axes[e, 2])
            for k in range(3):
                residuals[k] = u[k] * scale
                for i in range(3):
                    rows[k, i] = M[k, i] * scale
            count = 3
        weight = (sigma2 / (sigma2 + d * d)) ** 2
        x0, x1, x2 = p0 - root[0], p1 - root[1], p2 - root[2]
        link = ellipsoids.links[e]
        for k in range(count):
            n0, n1, n2 = rows[k, 0], rows[k, 1], rows[k, 2]
            J[0], J[1], J[2], J[3], J[4], J[5] = x1 * n2 - x2 * n1, x2 * n0 - x0 * n2, x0 * n1 - x1 * n0, n0, n1, n2
            for i in range(6):
                g[link, i] += weight * J[i] * residuals[k]
                for j in range(6):
                    H[link, i, j] += weight * J[i] * J[j]


@njit(nogil=True, cache=True, error_model="numpy")
def fit_ellipsoids(
    points: Array,
    normals: Array,
    start: PoseState,
    predicted: PoseState,
    offsets: Array,
    ellipsoids: Ellipsoids,
    table: JointTable,
    plan: Schedule,
) -> PoseState:
    """The pose fitted to a cloud; arguments as in ``articulated_gauss_newton.fit_pose``, with ``ellipsoids`` in place
    of the surface. ``plan.point_share`` has no meaning here."""
    root, local = start.root.copy(), start.local.copy()
    links, size = len(local), 6 + len(table.dof_link)
    H, g = np.empty((links, 6, 6)), np.empty((links, 6))
    A, b = np.empty((size, size)), np.empty(size)
    maps = np.empty((len(ellipsoids.links), 3, 4))
    owner, distance = np.empty(len(points), np.int64), np.empty(len(points))
    bias = _bias(ellipsoids)
    scale = 2500.0 / max(len(points), 1) / DATA_SIGMA_M**2
    shrink = (plan.gate_last_m / plan.gate_first_m) ** (1.0 / max(plan.iterations - 1, 1))
    gate = plan.gate_first_m
    for _ in range(plan.iterations):
        R, t = forward(root, local, offsets, table.parents)
        unit_maps(R, t, ellipsoids, maps)
        nearest_ellipsoids(points, normals, maps, bias, owner, distance)
        _normal_equations(points, normals, owner, distance, maps, ellipsoids, root, gate, H, g)
        project_on_axes(H, g, R, t, table, scale, A, b)
        add_priors(root, local, predicted.root, predicted.local, table, plan.step_scale, plan.damping, A, b)
        solve(A, b)
        apply_step(b, root, local, table)
        gate *= shrink
    return PoseState(root, local)


@njit(nogil=True, cache=True, error_model="numpy")
def judge_ellipsoids(
    points: Array, normals: Array, state: PoseState, offsets: Array, ellipsoids: Ellipsoids, parents: Array
) -> EllipsoidFit:
    """How well a pose explains a cloud, without moving it (arguments as in ``fit_ellipsoids``)."""
    count = len(points)
    R, t = forward(state.root, state.local, offsets, parents)
    maps = np.empty((len(ellipsoids.links), 3, 4))
    unit_maps(R, t, ellipsoids, maps)
    owner, distance = np.empty(count, np.int64), np.empty(count)
    nearest_ellipsoids(points, normals, maps, _bias(ellipsoids), owner, distance)
    explained = np.zeros(len(maps))
    score, inliers, square = 0.0, 0, 0.0
    for n in range(count):
        d = distance[n]
        if normals[n, 0] == 0.0 and normals[n, 1] == 0.0 and normals[n, 2] == 0.0:
            d = max(d, 0.0)
        if owner[n] < 0 or abs(d) > INLIER_M:
            owner[n] = -1
            score += d * d / (d * d + INLIER_M**2) if d < np.inf else 1.0
            continue
        score += d * d / (d * d + INLIER_M**2)
        explained[owner[n]] += 1.0
        inliers += 1
        square += d * d
    rms_m = np.sqrt(square / inliers) if inliers else 0.0
    return EllipsoidFit(state, score / max(count, 1), inliers / max(count, 1), rms_m, explained, owner)


@njit(nogil=True, cache=True, error_model="numpy")
def _bias(ellipsoids: Ellipsoids) -> Array:
    axes = ellipsoids.axes
    return SMALLER_FIRST * np.log(axes[:, 0] * axes[:, 1] * axes[:, 2])
