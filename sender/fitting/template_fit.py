"""Fits the human template to a cloud: damped Gauss–Newton over sizes and joint angles at once.

Residuals are distances of points to the nearest cone that faces the same way (data → model, as in ICP, Lien 2009
Eq. 1, with Geman–McClure weights), the extents of the body's ends along their bones, the floor under the feet, and
priors on all parameters. One side of a body is enough: nothing asks for points on surfaces no camera saw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sender.fitting.body_template import Template, place

_STEP = 1e-5  # of the difference quotients
_POINT_SIGMA_M = 0.015  # spread of a point about a cone of the right size: clothes and bodies are not cones
_EFFECTIVE_POINTS = 400  # neighbouring points err together, so more points do not outweigh the priors


@dataclass(frozen=True, slots=True, eq=False)
class TemplateFit:
    """Where the fit ended. ``theta`` (P,), ``heading`` [rad]; ``cone`` (N,) int: each point's cone, -1 = none;
    ``distance_m`` (N,) signed distance to it; ``cost``: mean robust cost of a point, 0 (all on the surface) to 1."""

    theta: NDArray[np.float64]
    heading: float
    cone: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    cost: float


@njit(nogil=True, cache=True, error_model="numpy")
def _jacobian(theta, heading, tables, root, ends, radii, d_ends, d_radii):  # type: ignore[no-untyped-def]
    """Cones at θ and their derivatives by every parameter: ``d_ends`` (P, K, 2, 3), ``d_radii`` (P, K, 2)."""
    (parents, offsets, offset_sizes, ends0, end_sizes, radii0, radius_sizes, cone_links, angle_links, angle_axes) = (
        tables
    )
    rotations = np.empty((len(parents), 3, 3))
    origins = np.empty((len(parents), 3))
    place(theta, heading, parents, offsets, offset_sizes, ends0, end_sizes, radii0, radius_sizes, cone_links,
          angle_links, angle_axes, root, rotations, origins, ends, radii)  # fmt: skip
    moved = theta.copy()
    for p in range(len(theta)):
        moved[p] = theta[p] + _STEP
        place(moved, heading, parents, offsets, offset_sizes, ends0, end_sizes, radii0, radius_sizes, cone_links,
              angle_links, angle_axes, root, rotations, origins, d_ends[p], d_radii[p])  # fmt: skip
        moved[p] = theta[p]
    for p in range(len(theta)):
        for k in range(len(cone_links)):
            for end in range(2):
                d_radii[p, k, end] = (d_radii[p, k, end] - radii[k, end]) / _STEP
                for axis in range(3):
                    d_ends[p, k, end, axis] = (d_ends[p, k, end, axis] - ends[k, end, axis]) / _STEP


@njit(nogil=True, cache=True, error_model="numpy")
def _match(points, normals, ends, radii, used, cone, along, distance, outward):  # type: ignore[no-untyped-def]
    """Each point's nearest used cone: its index, the place on its axis 0..1, the signed distance [m], the normal.

    A cone whose surface faces away there is no match; one that faces aside is charged for it.
    """
    for i in range(len(points)):
        best = 1e9
        cone[i] = -1
        for k in range(len(ends)):
            if not used[k]:
                continue
            ax, ay, az = ends[k, 0]
            bx, by, bz = ends[k, 1, 0] - ax, ends[k, 1, 1] - ay, ends[k, 1, 2] - az
            px, py, pz = points[i, 0] - ax, points[i, 1] - ay, points[i, 2] - az
            t = (px * bx + py * by + pz * bz) / (bx * bx + by * by + bz * bz)
            t = min(max(t, 0.0), 1.0)
            px, py, pz = px - t * bx, py - t * by, pz - t * bz
            length = np.sqrt(px * px + py * py + pz * pz) + 1e-9
            facing = (px * normals[i, 0] + py * normals[i, 1] + pz * normals[i, 2]) / length
            if facing < 0.0:
                continue
            d = length - (radii[k, 0] + t * (radii[k, 1] - radii[k, 0]))
            cost = abs(d) + 0.04 * (1.0 - facing)
            if cost < best:
                best = cost
                cone[i] = k
                along[i] = t
                distance[i] = d
                outward[i, 0], outward[i, 1], outward[i, 2] = px / length, py / length, pz / length


@njit(nogil=True, cache=True, error_model="numpy")
def _normal_equations(cone, along, distance, outward, d_ends, d_radii, scale_m, sigma_m, H, g):  # type: ignore[no-untyped-def]
    """Add the points' rows to H (P, P) and g (P,); return their summed Geman–McClure cost d²/(d² + scale²)."""
    P = len(g)
    row = np.empty(P)
    nonzero = np.empty(P, np.int64)
    total = 0.0
    for i in range(len(cone)):
        k = cone[i]
        if k < 0:
            total += 1.0
            continue
        d2 = distance[i] * distance[i]
        ratio = 1.0 / (1.0 + d2 / (scale_m * scale_m))
        total += 1.0 - ratio
        weight = ratio * ratio / (sigma_m * sigma_m)
        t = along[i]
        count = 0
        for p in range(P):
            value = -(1.0 - t) * d_radii[p, k, 0] - t * d_radii[p, k, 1]
            for axis in range(3):
                value -= outward[i, axis] * ((1.0 - t) * d_ends[p, k, 0, axis] + t * d_ends[p, k, 1, axis])
            if value != 0.0:
                row[count] = value
                nonzero[count] = p
                count += 1
        for a in range(count):
            p = nonzero[a]
            g[p] += weight * row[a] * distance[i]
            for b in range(a + 1):
                H[p, nonzero[b]] += weight * row[a] * row[b]
    return total


@njit(nogil=True, cache=True, error_model="numpy")
def _extents(points, ends, radii, d_ends, d_radii, tips, sigma_m, H, g):  # type: ignore[no-untyped-def]
    """Rows for the body's ends: how far points reach past the end of cone ``tips[j]``, along its axis.

    Points beyond the middle of the cone and within a hand's breadth of its axis count; the third farthest is the
    extent, so that two stray points do not stretch a limb.
    """
    P = len(g)
    row = np.empty(P)
    for k in tips:
        axis = ends[k, 1] - ends[k, 0]
        length = np.sqrt((axis * axis).sum()) + 1e-9
        axis = axis / length
        far = np.full(3, -1e9)
        for i in range(len(points)):
            px, py, pz = points[i, 0] - ends[k, 0, 0], points[i, 1] - ends[k, 0, 1], points[i, 2] - ends[k, 0, 2]
            s = px * axis[0] + py * axis[1] + pz * axis[2]
            aside2 = px * px + py * py + pz * pz - s * s
            reach = radii[k, 1] + 0.03
            if s < 0.3 * length or s > length + 0.12 or aside2 > reach * reach or s <= far[2]:
                continue
            far[2] = s
            for j in (1, 0):
                if far[j + 1] > far[j]:
                    far[j], far[j + 1] = far[j + 1], far[j]
        if far[2] < 0.0:
            continue
        d = far[2] - length - radii[k, 1]
        for p in range(P):
            row[p] = -d_radii[p, k, 1]
            for c in range(3):
                row[p] -= axis[c] * d_ends[p, k, 1, c]
        _add_row(row, d, 1.0 / (sigma_m * sigma_m), H, g)


@njit(nogil=True, cache=True, error_model="numpy")
def _add_row(row, residual, weight, H, g):  # type: ignore[no-untyped-def]
    for p in range(len(row)):
        if row[p] != 0.0:
            g[p] += weight * row[p] * residual
            for q in range(p + 1):
                H[p, q] += weight * row[p] * row[q]


@njit(nogil=True, cache=True, error_model="numpy")
def _floor(floor_y, ends, radii, d_ends, d_radii, feet, sigma_m, H, g):  # type: ignore[no-untyped-def]
    """Rows that put the underside of the ``feet`` cones' ends on the floor."""
    row = np.empty(len(g))
    for k in feet:
        for end in range(2):
            d = ends[k, end, 1] - radii[k, end] - floor_y
            for p in range(len(row)):
                row[p] = d_ends[p, k, end, 1] - d_radii[p, k, end]
            _add_row(row, d, 1.0 / (sigma_m * sigma_m), H, g)


def fit_template(
    template: Template,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    start: NDArray[np.float64],
    prior: NDArray[np.float64],
    heading: float,
    *,
    used: NDArray[np.bool_],
    floor_y: float | None,
    iterations: int,
    gates_m: tuple[float, float] = (0.15, 0.04),
) -> TemplateFit:
    """Fit sizes and angles from ``start`` (P,); the priors pull towards ``prior`` (P,).

    ``points``, ``normals`` (N, 3) [m, world]; ``heading`` [rad] about y; ``used`` (K,): cones of parts the cloud can
    show; ``floor_y`` [m]: height of the floor under the feet, None when they are not seen; ``gates_m``: scale of the
    robust kernel in the first and the last iteration.

    Raises:
        numpy.linalg.LinAlgError: never with positive priors.
    """
    K, P, N = len(template.cone_links), len(start), len(points)
    ends, radii = np.empty((K, 2, 3)), np.empty((K, 2))
    d_ends, d_radii = np.empty((P, K, 2, 3)), np.empty((P, K, 2))
    cone, along, distance, outward = np.empty(N, np.int64), np.empty(N), np.zeros(N), np.empty((N, 3))
    tables, root = tuple(template[:10]), len(template.prior) - 3 - len(template.angle_links)
    precision = 1.0 / template.sigma**2
    theta, total = start.copy(), float(N)
    point_sigma_m = _POINT_SIGMA_M * np.sqrt(max(N, 1) / _EFFECTIVE_POINTS)
    for iteration in range(iterations + 1):
        _jacobian(theta, heading, tables, root, ends, radii, d_ends, d_radii)
        _match(points, normals, ends, radii, used, cone, along, distance, outward)
        scale_m = gates_m[0] * (gates_m[1] / gates_m[0]) ** min(1.5 * iteration / iterations, 1.0)
        H, g = np.diag(precision), precision * (theta - prior)
        total = _normal_equations(cone, along, distance, outward, d_ends, d_radii, scale_m, point_sigma_m, H, g)
        if iteration == iterations:
            break
        _extents(points, ends, radii, d_ends, d_radii, template.tip_cones[used[template.tip_cones]], 0.01, H, g)
        if floor_y is not None:
            _floor(floor_y, ends, radii, d_ends, d_radii, template.sole_cones, 0.01, H, g)
        H = H + np.tril(H, -1).T
        step = np.linalg.solve(H, -g)
        theta += step / max(1.0, float(np.abs(step).max()) / 0.5)
        theta[:root] = np.clip(theta[:root], 0.5 * template.prior[:root], 1.6 * template.prior[:root])
        theta[template.lower_bounded] = np.maximum(theta[template.lower_bounded], -0.05)
        theta[template.upper_bounded] = np.minimum(theta[template.upper_bounded], 0.05)
    return TemplateFit(theta, heading, cone, distance, total / max(N, 1))
