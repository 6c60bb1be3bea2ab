"""Fits the human template to a cloud: damped Gauss–Newton over sizes and joint angles at once.

Residuals are distances of points to the nearest cone that faces the same way (data → model, as in ICP, Lien 2009
Eq. 1, with Geman–McClure weights), the extents of the body's ends along their bones, the floor under the feet, and
priors on all parameters. One side of a body is enough: nothing asks for points on surfaces no camera saw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT
from sender.fitting.body_template import Template
from sender.fitting.template_kernels import add_extents, add_floor, add_points, jacobian, match

_POINT_SIGMA_M = 0.015  # spread of a point about a cone of the right size: clothes and bodies are not cones
SURFACE_M = 0.035  # points nearer than this lie on the surface
UNSEEN_WEIGHT = 0.5  # of surface without points against points without surface: it may be hidden
_FEW = 0.3  # of the points that an evenly covered link would hold
_EFFECTIVE_POINTS = 400  # neighbouring points err together, so more points do not outweigh the priors


@dataclass(frozen=True, slots=True, eq=False)
class TemplateFit:
    """Where a fit ended, or a start to fit from. ``theta`` (P,): sizes, root position, angles; ``prior`` (P,): where
    their priors are centred; ``heading`` [rad about y]; ``cone`` (N,) int: each point's cone, -1 = none;
    ``distance_m`` (N,): signed distance to it; ``cost``: half the sum of robust squared residuals and priors, each
    over its variance, by which fits of the same points compare; surface that no point lies on costs as much as points
    off the surface (a score of points alone is best for a body with its limbs folded into the trunk).
    ``unseen_share``: of the surface, 0..1."""

    theta: NDArray[np.float64]
    prior: NDArray[np.float64]
    heading: float
    cone: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    cost: float
    unseen_share: float


def unfitted(start: NDArray[np.float64], heading: float, prior: NDArray[np.float64] | None = None) -> TemplateFit:
    """Parameters ``start`` (P,) and ``heading`` [rad about y] to fit from, and around which the priors are centred."""
    return TemplateFit(
        start, start if prior is None else prior, heading, np.empty(0, np.int64), np.empty(0), np.inf, 1.0
    )


def fit_template(
    template: Template,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    start: TemplateFit,
    used: NDArray[np.bool_],
    floor_y: float | None,
    iterations: int,
    gates_m: tuple[float, float],
    edge_m: float = 0.0,
) -> TemplateFit:
    """Fit sizes and angles to ``points``, ``normals`` (N, 3) [m, world] from ``start``, with its priors.

    ``used`` (K,): cones of parts the cloud can show; ``floor_y`` [m]: height of the floor under the feet, None when
    they are not seen; ``gates_m``: scale of the robust kernel in the first and the last iteration; ``edge_m``:
    how far inside the body's outline the outermost points lie.
    """
    K, P, N = len(template.cone_links), len(start.theta), len(points)
    ends, radii = np.empty((K, 2, 3)), np.empty((K, 2))
    d_ends, d_radii = np.empty((P, K, 2, 3)), np.empty((P, K, 2))
    cone, along, distance, outward = np.empty(N, np.int64), np.empty(N), np.zeros(N), np.empty((N, 3))
    tables, root = tuple(template[:10]), len(template.prior) - 3 - len(template.angle_links)
    precision, tips = 1.0 / template.sigma**2, template.tip_cones[used[template.tip_cones]]
    theta, prior, heading = start.theta.copy(), start.prior, start.heading
    total, scale_m = float(N), gates_m[1]
    point_sigma_m = _POINT_SIGMA_M * np.sqrt(max(N, 1) / _EFFECTIVE_POINTS)
    for iteration in range(iterations + 1):
        jacobian(theta, heading, tables, root, ends, radii, d_ends, d_radii)
        match(points, normals, ends, radii, used, cone, along, distance, outward)
        scale_m = gates_m[0] * (gates_m[1] / gates_m[0]) ** min(1.5 * iteration / iterations, 1.0)
        H, g = np.diag(precision), precision * (theta - prior)
        total = add_points(cone, along, distance, outward, d_ends, d_radii, scale_m, point_sigma_m, H, g)
        if iteration == iterations:
            break
        add_extents(points, ends, radii, d_ends, d_radii, tips, edge_m, 0.01, H, g)
        if floor_y is not None:
            add_floor(floor_y, ends, radii, d_ends, d_radii, template.sole_cones, 0.01, H, g)
        H = H + np.tril(H, -1).T
        step = np.linalg.solve(H, -g)
        theta += step / max(1.0, float(np.abs(step).max()) / 0.5)
        theta[:root] = np.clip(theta[:root], 0.5 * template.prior[:root], 1.6 * template.prior[:root])
        theta[template.lower_bounded] = np.maximum(theta[template.lower_bounded], -0.05)
        theta[template.upper_bounded] = np.minimum(theta[template.upper_bounded], 0.05)
    near = cone[(cone >= 0) & (np.abs(distance) < SURFACE_M)]
    unseen_share = _unseen_share(template, ends, radii, used, near)
    missed = (total + UNSEEN_WEIGHT * N * unseen_share) * (scale_m / point_sigma_m) ** 2
    cost = 0.5 * missed + 0.5 * float(precision @ (theta - prior) ** 2)
    return TemplateFit(theta, prior, heading, cone, distance, cost, unseen_share)


def _unseen_share(
    template: Template,
    ends: NDArray[np.float64],
    radii: NDArray[np.float64],
    used: NDArray[np.bool_],
    near: NDArray[np.int64],
) -> float:
    """Share of the used cones' side area on links that hold clearly fewer points than their area promises."""
    sides = np.pi * radii.sum(axis=1) * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) * used
    links = template.cone_links
    areas = np.bincount(links, sides, LINK_COUNT) / sides.sum()
    counts = np.bincount(links[near], minlength=LINK_COUNT)
    expected = np.maximum(_FEW * areas * len(near), 1e-9)
    return float(areas @ np.maximum(1.0 - counts / expected, 0.0))
