"""All joint angles at once: damped Gauss–Newton on point-to-plane distances (algorithms.md §3 and §8).

Every data point looks up the closest compatible model point among the links near it. Each link sums its 6×6 normal
equations; children are added to their parents, because whoever moves a link moves everything below it; the sums are
projected on the joint axes. What the cloud does not show is held by priors: the predicted pose, the rest pose, and the
soft joint limits of ``joint_limits``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sender.fitting.joint_limits import JointTable, add_priors, rotation_exp
from sender.fitting.surface_matching import Surface, match_points, near_links

Array = NDArray[Any]

DATA_SIGMA_M = 0.05  # of one of 2,500 points, unless a schedule says otherwise


class PoseState(NamedTuple):
    """``root`` (3,) float64 [m, world]; ``local`` (L, 3, 3) float64: rotation of each link relative to its parent."""

    root: Array
    local: Array


class Schedule(NamedTuple):
    """How one fit runs. Gates: metres; ``point_share``: share of plain point-to-point distance beside point-to-plane;
    ``step_scale``: how many 1/30 s the motion prior spans; ``damping``: added to every axis [rad⁻²]; ``sigma_m``: of
    one of 2,500 points [m], by which the cloud is weighed against the priors. Neighbours share their errors, so that a
    point counts for less than its noise alone would say."""

    iterations: int
    gate_first_m: float
    gate_last_m: float
    point_share: float
    step_scale: float
    damping: float
    sigma_m: float = DATA_SIGMA_M


class FitArrays(NamedTuple):
    """``score``: mean robust cost per point, 0 (perfect) .. 1 (no point explained); ``inliers``: share of points
    within ``INLIER_M`` of the surface; ``rms_m`` of those; ``assigned, explained`` (L,) float64: points nearest to each
    link, and those of them that are inliers; ``owner`` (N,) int64: link of each inlier, -1 otherwise."""

    pose: PoseState
    score: float
    inliers: float
    rms_m: float
    assigned: Array
    explained: Array
    owner: Array


INLIER_M = 0.035
ALONG_SHARE = 0.2  # how much of the squared distance along the surface counts: model points have gaps between them
JUDGED_M = 0.10  # points further from the surface than this count as not explained at all


@njit(nogil=True, cache=True, error_model="numpy")
def forward(root: Array, local: Array, offsets: Array, parents: Array) -> tuple[Array, Array]:
    """World rotations (L, 3, 3) and joint positions (L, 3) [m] of all links."""
    count = len(local)
    R = np.empty((count, 3, 3))
    t = np.empty((count, 3))
    R[0] = local[0]
    t[0] = root
    for link in range(1, count):
        up = parents[link]
        for i in range(3):
            t[link, i] = t[up, i]
            for k in range(3):
                t[link, i] += R[up, i, k] * offsets[link, k]
                R[link, i, k] = (
                    R[up, i, 0] * local[link, 0, k] + R[up, i, 1] * local[link, 1, k] + R[up, i, 2] * local[link, 2, k]
                )
    return R, t


@njit(nogil=True, cache=True, error_model="numpy")
def normal_equations(
    points: Array,
    links: Array,
    rows: Array,
    squares: Array,
    R: Array,
    t: Array,
    surface: Surface,
    gate: float,
    point_share: float,
    H: Array,
    g: Array,
) -> None:
    """Sums each link's H (L, 6, 6) and g (L, 6) of the twist (ω, v) about the root joint; Geman–McClure weights."""
    H[:] = 0.0
    g[:] = 0.0
    c = t[0]
    sigma2 = (0.5 * gate) ** 2
    J = np.empty(6)
    for n in range(len(points)):
        link, k, d2 = links[n], rows[n], squares[n]
        if link < 0 or d2 > gate * gate:
            continue
        m0, m1, m2 = surface.points[k, 0], surface.points[k, 1], surface.points[k, 2]
        a0, a1, a2 = surface.normals[k, 0], surface.normals[k, 1], surface.normals[k, 2]
        x0 = R[link, 0, 0] * m0 + R[link, 0, 1] * m1 + R[link, 0, 2] * m2 + t[link, 0]
        x1 = R[link, 1, 0] * m0 + R[link, 1, 1] * m1 + R[link, 1, 2] * m2 + t[link, 1]
        x2 = R[link, 2, 0] * m0 + R[link, 2, 1] * m1 + R[link, 2, 2] * m2 + t[link, 2]
        n0 = R[link, 0, 0] * a0 + R[link, 0, 1] * a1 + R[link, 0, 2] * a2
        n1 = R[link, 1, 0] * a0 + R[link, 1, 1] * a1 + R[link, 1, 2] * a2
        n2 = R[link, 2, 0] * a0 + R[link, 2, 1] * a1 + R[link, 2, 2] * a2
        d0, d1, e2 = points[n, 0] - x0, points[n, 1] - x1, points[n, 2] - x2
        x0, x1, x2 = x0 - c[0], x1 - c[1], x2 - c[2]
        r = n0 * d0 + n1 * d1 + n2 * e2
        w = (sigma2 / (sigma2 + d2)) ** 2
        J[0], J[1], J[2] = x1 * n2 - x2 * n1, x2 * n0 - x0 * n2, x0 * n1 - x1 * n0
        J[3], J[4], J[5] = n0, n1, n2
        for i in range(6):
            wJ = w * J[i]
            g[link, i] += wJ * r
            for j in range(i, 6):
                H[link, i, j] += wJ * J[j]
        w *= point_share  # the plain distance: Jacobian (-[x]×, I)
        xx = x0 * x0 + x1 * x1 + x2 * x2
        H[link, 0, 0] += w * (xx - x0 * x0)
        H[link, 1, 1] += w * (xx - x1 * x1)
        H[link, 2, 2] += w * (xx - x2 * x2)
        H[link, 0, 1] -= w * x0 * x1
        H[link, 0, 2] -= w * x0 * x2
        H[link, 1, 2] -= w * x1 * x2
        H[link, 0, 4] -= w * x2
        H[link, 0, 5] += w * x1
        H[link, 1, 3] += w * x2
        H[link, 1, 5] -= w * x0
        H[link, 2, 3] -= w * x1
        H[link, 2, 4] += w * x0
        H[link, 3, 3] += w
        H[link, 4, 4] += w
        H[link, 5, 5] += w
        g[link, 0] += w * (x1 * e2 - x2 * d1)
        g[link, 1] += w * (x2 * d0 - x0 * e2)
        g[link, 2] += w * (x0 * d1 - x1 * d0)
        g[link, 3] += w * d0
        g[link, 4] += w * d1
        g[link, 5] += w * e2
    for link in range(len(H)):
        for i in range(6):
            for j in range(i):
                H[link, i, j] = H[link, j, i]


@njit(nogil=True, cache=True, error_model="numpy")
def axis_twists(R: Array, t: Array, table: JointTable, S: Array, links: Array) -> None:
    """Unit twists (ω, v) about the root joint of the root's six and the D joint axes: fills the first 6+D rows of
    ``S`` (K, 6) and of ``links`` (K,) int64, the link each of them moves, with all below it."""
    S[: 6 + len(table.dof_link)] = 0.0
    for i in range(6):
        S[i, i] = 1.0
        links[i] = 0
    for d in range(len(table.dof_link)):
        link, axis = table.dof_link[d], table.dof_axis[d]
        a0, a1, a2 = R[link, 0, axis], R[link, 1, axis], R[link, 2, axis]
        o0, o1, o2 = t[0, 0] - t[link, 0], t[0, 1] - t[link, 1], t[0, 2] - t[link, 2]
        S[6 + d, 0], S[6 + d, 1], S[6 + d, 2] = a0, a1, a2
        S[6 + d, 3], S[6 + d, 4], S[6 + d, 5] = a1 * o2 - a2 * o1, a2 * o0 - a0 * o2, a0 * o1 - a1 * o0
        links[6 + d] = link


@njit(nogil=True, cache=True, error_model="numpy")
def project(H: Array, g: Array, S: Array, links: Array, table: JointTable, scale: float, A: Array, b: Array) -> None:
    """A (K, K) and b (K,): link sums ``H`` (L, 6, 6), ``g`` (L, 6), child into parent, on the twists ``S`` (K, 6)."""
    for link in range(len(H) - 1, 0, -1):
        up = table.parents[link]
        for i in range(6):
            g[up, i] += g[link, i]
            for j in range(6):
                H[up, i, j] += H[link, i, j]
    A[:] = 0.0
    y = np.empty(6)
    for d in range(len(S)):
        link = links[d]
        total = 0.0
        for i in range(6):
            total += S[d, i] * g[link, i]
            y[i] = 0.0
            for j in range(6):
                y[i] += H[link, i, j] * S[d, j]
        b[d] = scale * total
        for e in range(len(S)):
            if not table.ancestor[links[e], link]:
                continue
            total = 0.0
            for i in range(6):
                total += S[e, i] * y[i]
            A[d, e] = scale * total
            A[e, d] = A[d, e]


@njit(nogil=True, cache=True, error_model="numpy")
def project_on_axes(
    H: Array, g: Array, R: Array, t: Array, table: JointTable, scale: float, A: Array, b: Array
) -> None:
    """``project`` on the root's twist and the joint axes."""
    S, links = np.empty((len(b), 6)), np.empty(len(b), np.int64)
    axis_twists(R, t, table, S, links)
    project(H, g, S, links, table, scale, A, b)


@njit(nogil=True, cache=True, error_model="numpy")
def solve(A: Array, b: Array) -> None:
    """Solves A x = b in place of b by Cholesky; A (n, n) positive definite, its lower half is overwritten."""
    n = len(b)
    for j in range(n):
        for k in range(j):
            A[j, j] -= A[j, k] * A[j, k]
        A[j, j] = np.sqrt(max(A[j, j], 1e-9))
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = total / A[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]


@njit(nogil=True, cache=True, error_model="numpy")
def apply_step(x: Array, root: Array, local: Array, table: JointTable) -> None:
    """Moves the pose by the solution x (6+D,); steps are cut at half a radian and 20 cm."""
    v, M, old = np.zeros(3), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        v[i] = min(max(x[i], -0.5), 0.5)
        root[i] += min(max(x[3 + i], -0.2), 0.2)
    rotation_exp(v, M)
    old[:] = local[0]
    for i in range(3):
        for j in range(3):
            local[0, i, j] = M[i, 0] * old[0, j] + M[i, 1] * old[1, j] + M[i, 2] * old[2, j]
    for d in range(0, len(table.dof_link), 3):
        link = table.dof_link[d]
        for i in range(3):
            v[i] = min(max(x[6 + d + i], -0.5), 0.5)
        rotation_exp(v, M)
        old[:] = local[link]
        for i in range(3):
            for j in range(3):
                local[link, i, j] = old[i, 0] * M[0, j] + old[i, 1] * M[1, j] + old[i, 2] * M[2, j]


@njit(nogil=True, cache=True, error_model="numpy")
def fit_pose(
    points: Array,
    normals: Array,
    tinted: Array,
    start: PoseState,
    predicted: PoseState,
    offsets: Array,
    surface: Surface,
    table: JointTable,
    plan: Schedule,
) -> PoseState:
    """The pose fitted to a cloud; ``judge_pose`` says how well.

    ``points, normals`` (N, 3), ``tinted`` (N, 2) float32 [m, world]: the last from ``tints``; ``start``: where
    iterations begin; ``predicted``: where the motion prior pulls; ``offsets`` (L, 3) float64 [m]: joints in
    their parents' frames. An empty cloud returns the start.
    """
    root, local = start.root.copy(), start.local.copy()
    links, size = len(local), 6 + len(table.dof_link)
    H, g = np.empty((links, 6, 6)), np.empty((links, 6))
    A, b = np.empty((size, size)), np.empty(size)
    link, row, d2 = np.empty(len(points), np.int64), np.empty(len(points), np.int64), np.empty(len(points))
    scale = 2500.0 / max(len(points), 1) / plan.sigma_m**2
    shrink = (plan.gate_last_m / plan.gate_first_m) ** (1.0 / max(plan.iterations - 1, 1))
    gate = plan.gate_first_m
    for iteration in range(plan.iterations):
        R, t = forward(root, local, offsets, table.parents)
        if iteration % 3 == 0:
            first, members = near_links(points, R, t, surface, gate + 0.02)
        match_points(points, normals, tinted, first, members, R, t, surface, link, row, d2)
        normal_equations(points, link, row, d2, R, t, surface, gate, plan.point_share, H, g)
        project_on_axes(H, g, R, t, table, scale, A, b)
        add_priors(root, local, predicted.root, predicted.local, table, plan.step_scale, plan.damping, A, b)
        solve(A, b)
        apply_step(b, root, local, table)
        gate *= shrink
    return PoseState(root, local)


@njit(nogil=True, cache=True, error_model="numpy")
def judge_pose(
    points: Array, normals: Array, tinted: Array, state: PoseState, offsets: Array, surface: Surface, parents: Array
) -> FitArrays:
    """How well a pose explains a cloud, without moving it (arguments as in ``fit_pose``)."""
    R, t = forward(state.root, state.local, offsets, parents)
    count = len(points)
    first, members = near_links(points, R, t, surface, JUDGED_M)
    link, row, d2 = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    match_points(points, normals, tinted, first, members, R, t, surface, link, row, d2)
    assigned, explained = np.zeros(len(R)), np.zeros(len(R))
    score, inliers, square = 0.0, 0, 0.0
    for n in range(count):
        if link[n] < 0:
            score += 1.0
            continue
        c, k = link[n], row[n]
        off = 0.0
        for i in range(3):
            a = 0.0
            for j in range(3):
                a += R[c, i, j] * surface.normals[k, j]
            x = t[c, i]
            for j in range(3):
                x += R[c, i, j] * surface.points[k, j]
            off += a * (points[n, i] - x)
        distance2 = off * off + ALONG_SHARE * max(d2[n] - off * off - 2.0 * surface.spacing2_m2[c], 0.0)
        score += distance2 / (distance2 + INLIER_M**2)
        assigned[c] += 1.0
        if distance2 < INLIER_M**2:
            explained[c] += 1.0
            inliers += 1
            square += distance2
        else:
            link[n] = -1
    share = inliers / count if count else 0.0
    rms = np.sqrt(square / inliers) if inliers else 0.0
    return FitArrays(state, score / count if count else 1.0, share, rms, assigned, explained, link)
