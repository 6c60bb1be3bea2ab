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

from sender.fitting.joint_limits import JointTable

Array = NDArray[Any]

NEAR_LINKS = 12  # candidate links a point may have


class Surface(NamedTuple):
    """The body's points and grids, all links one after the other (L links, M points, C grid cells).

    ``points, normals`` (M, 3) float32 [m, link frame]; ``weights`` (M,) float32: how rigidly the point follows its link;
    ``first_point`` (L,) int64; ``origin`` (L, 3) float32 [m]; ``shape`` (L, 3) int64; ``cells_per_m`` (L,) float32;
    ``first_cell`` (L,) int64; ``nearest`` (C,) int16, see ``closest_point_grid``;
    ``low, high`` (L, 3) float32 [m, link frame]: box around the link's points; low > high when it has none.
    """

    points: Array
    normals: Array
    weights: Array
    first_point: Array
    origin: Array
    shape: Array
    cells_per_m: Array
    first_cell: Array
    nearest: Array
    low: Array
    high: Array


class PoseState(NamedTuple):
    """``root`` (3,) float64 [m, world]; ``local`` (L, 3, 3) float64: rotation of each link relative to its parent."""

    root: Array
    local: Array


class Schedule(NamedTuple):
    """How one fit runs. Gates and ``sigma``: metres; ``point_share``: share of plain point-to-point distance beside
    point-to-plane; ``step_scale``: how many 1/30 s the motion prior spans; ``damping``: added to every axis [rad⁻²]."""

    iterations: int
    gate_first_m: float
    gate_last_m: float
    point_share: float
    step_scale: float
    damping: float


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
NORMAL_GATE = 0.35
DATA_SIGMA_M = 0.05  # of one of 2,500 points; neighbours share their errors, so one counts for less than its noise says
LIMIT_SIGMA = 0.06  # rad beyond a joint limit


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
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


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _near_links(points: Array, R: Array, t: Array, surface: Surface, gate: float, near: Array) -> None:
    """Fills ``near`` (N, NEAR_LINKS) int8 with the links whose box, grown by the gate, holds the point; -1 ends."""
    near[:, 0] = -1
    fill = np.zeros(len(points), np.int64)
    for link in range(len(R)):
        if surface.low[link, 0] > surface.high[link, 0]:
            continue
        cx = 0.5 * (surface.low[link, 0] + surface.high[link, 0])
        cy = 0.5 * (surface.low[link, 1] + surface.high[link, 1])
        cz = 0.5 * (surface.low[link, 2] + surface.high[link, 2])
        hx = surface.high[link, 0] - cx + gate
        hy = surface.high[link, 1] - cy + gate
        hz = surface.high[link, 2] - cz + gate
        x = t[link, 0] + R[link, 0, 0] * cx + R[link, 0, 1] * cy + R[link, 0, 2] * cz
        y = t[link, 1] + R[link, 1, 0] * cx + R[link, 1, 1] * cy + R[link, 1, 2] * cz
        z = t[link, 2] + R[link, 2, 0] * cx + R[link, 2, 1] * cy + R[link, 2, 2] * cz
        for n in range(len(points)):
            dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
            if (
                abs(R[link, 0, 0] * dx + R[link, 1, 0] * dy + R[link, 2, 0] * dz) < hx
                and abs(R[link, 0, 1] * dx + R[link, 1, 1] * dy + R[link, 2, 1] * dz) < hy
                and abs(R[link, 0, 2] * dx + R[link, 1, 2] * dy + R[link, 2, 2] * dz) < hz
                and fill[n] < NEAR_LINKS
            ):
                near[n, fill[n]] = link
                fill[n] += 1
                if fill[n] < NEAR_LINKS:
                    near[n, fill[n]] = -1


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _closest_point(
    points: Array, normals: Array, near: Array, n: int, R: Array, t: Array, surface: Surface
) -> tuple[int, int, float]:
    """Of point n: link, model point and squared distance [m²] of the closest compatible model point; link -1 when there is none."""
    zero = np.float32(0.0)  # single precision throughout: this is where the time goes
    best_link, best_point, best = -1, -1, np.float32(np.inf)
    for c in range(near.shape[1]):
        link = int(near[n, c])
        if link < 0:
            break
        dx, dy, dz = points[n, 0] - t[link, 0], points[n, 1] - t[link, 1], points[n, 2] - t[link, 2]
        qx = R[link, 0, 0] * dx + R[link, 1, 0] * dy + R[link, 2, 0] * dz
        qy = R[link, 0, 1] * dx + R[link, 1, 1] * dy + R[link, 2, 1] * dz
        qz = R[link, 0, 2] * dx + R[link, 1, 2] * dy + R[link, 2, 2] * dz
        ux = max(surface.low[link, 0] - qx, qx - surface.high[link, 0], zero)
        uy = max(surface.low[link, 1] - qy, qy - surface.high[link, 1], zero)
        uz = max(surface.low[link, 2] - qz, qz - surface.high[link, 2], zero)
        d = ux * ux + uy * uy + uz * uz  # from the box of the link's points: none of them can be closer
        if d >= best:
            continue
        mx = R[link, 0, 0] * normals[n, 0] + R[link, 1, 0] * normals[n, 1] + R[link, 2, 0] * normals[n, 2]
        my = R[link, 0, 1] * normals[n, 0] + R[link, 1, 1] * normals[n, 1] + R[link, 2, 1] * normals[n, 2]
        mz = R[link, 0, 2] * normals[n, 0] + R[link, 1, 2] * normals[n, 1] + R[link, 2, 2] * normals[n, 2]
        ax, ay, az = abs(mx), abs(my), abs(mz)
        if ax >= ay and ax >= az:
            side = 0 if mx > 0 else 1
        elif ay >= az:
            side = 2 if my > 0 else 3
        else:
            side = 4 if mz > 0 else 5
        nx, ny, nz = surface.shape[link, 0], surface.shape[link, 1], surface.shape[link, 2]
        cell = surface.cells_per_m[link]
        x = min(max(int((qx - surface.origin[link, 0]) * cell), 0), nx - 1)
        y = min(max(int((qy - surface.origin[link, 1]) * cell), 0), ny - 1)
        z = min(max(int((qz - surface.origin[link, 2]) * cell), 0), nz - 1)
        k = int(surface.nearest[surface.first_cell[link] + ((side * nx + x) * ny + y) * nz + z])
        if k < 0:
            continue
        k += surface.first_point[link]
        ex, ey, ez = qx - surface.points[k, 0], qy - surface.points[k, 1], qz - surface.points[k, 2]
        d = ex * ex + ey * ey + ez * ez
        if d >= best:
            continue
        if mx * surface.normals[k, 0] + my * surface.normals[k, 1] + mz * surface.normals[k, 2] < NORMAL_GATE:
            continue
        best_link, best_point, best = link, k, d
    return best_link, best_point, best


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def match_points(
    points: Array, normals: Array, near: Array, R: Array, t: Array, surface: Surface, link: Array, row: Array, d2: Array
) -> None:
    """Closest compatible model point of every point (N, 3): fills ``link`` (N,) int64 (-1: none), ``row`` (N,) int64
    and the squared distance ``d2`` (N,) [m²]; ``R, t``: link frames in the world, from ``forward``."""
    R32, t32 = R.astype(np.float32), t.astype(np.float32)
    for n in range(len(points)):
        link[n], row[n], d2[n] = _closest_point(points, normals, near, n, R32, t32, surface)
        for c in range(1, near.shape[1]):  # asked first next time: its short distance rules the other boxes out
            if near[n, c] < 0 or link[n] < 0:
                break
            if near[n, c] == link[n]:
                near[n, 0], near[n, c] = near[n, c], near[n, 0]
                break


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _normal_equations(
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
        w = surface.weights[k] * (sigma2 / (sigma2 + d2)) ** 2
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


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _project(H: Array, g: Array, R: Array, t: Array, table: JointTable, scale: float, A: Array, b: Array) -> None:
    """A (6+D, 6+D) and b (6+D,): link sums, child into parent, on the root's twist and the joint axes."""
    links = len(H)
    for link in range(links - 1, 0, -1):
        up = table.parents[link]
        for i in range(6):
            g[up, i] += g[link, i]
            for j in range(6):
                H[up, i, j] += H[link, i, j]
    dofs = len(table.dof_link)
    A[:] = 0.0
    S = np.zeros((6 + dofs, 6))  # unit twists about the root joint
    for i in range(6):
        S[i, i] = 1.0
    for d in range(dofs):
        link, axis = table.dof_link[d], table.dof_axis[d]
        a0, a1, a2 = R[link, 0, axis], R[link, 1, axis], R[link, 2, axis]
        o0, o1, o2 = t[0, 0] - t[link, 0], t[0, 1] - t[link, 1], t[0, 2] - t[link, 2]
        S[6 + d, 0], S[6 + d, 1], S[6 + d, 2] = a0, a1, a2
        S[6 + d, 3], S[6 + d, 4], S[6 + d, 5] = a1 * o2 - a2 * o1, a2 * o0 - a0 * o2, a0 * o1 - a1 * o0
    y = np.empty(6)
    for d in range(6 + dofs):
        link = table.dof_link[d - 6] if d >= 6 else 0
        total = 0.0
        for i in range(6):
            total += S[d, i] * g[link, i]
            y[i] = 0.0
            for j in range(6):
                y[i] += H[link, i, j] * S[d, j]
        b[d] = scale * total
        for e in range(d + 1):
            if e >= 6 and not table.ancestor[table.dof_link[e - 6], link]:
                continue
            total = 0.0
            for i in range(6):
                total += S[e, i] * y[i]
            A[d, e] = scale * total
            A[e, d] = A[d, e]


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def rotation_log(M: Array, v: Array) -> None:
    """Writes the rotation vector (3,) [rad] of M (3, 3) into ``v``; near a half turn the axis is only approximate."""
    x, y, z = M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]
    s = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(s, M[0, 0] + M[1, 1] + M[2, 2] - 1.0)
    f = angle / s if s > 1e-9 else 0.5
    v[0], v[1], v[2] = f * x, f * y, f * z


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def rotation_exp(v: Array, M: Array) -> None:
    """Writes the rotation matrix (3, 3) of the rotation vector ``v`` (3,) [rad] into M (Rodrigues)."""
    angle = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    f = np.sin(angle) / angle if angle > 1e-9 else 1.0
    h = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-9 else 0.5
    c = np.cos(angle)
    M[0, 0], M[0, 1], M[0, 2] = c + h * v[0] * v[0], h * v[0] * v[1] - f * v[2], h * v[0] * v[2] + f * v[1]
    M[1, 0], M[1, 1], M[1, 2] = h * v[0] * v[1] + f * v[2], c + h * v[1] * v[1], h * v[1] * v[2] - f * v[0]
    M[2, 0], M[2, 1], M[2, 2] = h * v[0] * v[2] - f * v[1], h * v[1] * v[2] + f * v[0], c + h * v[2] * v[2]


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def swing_twist_angles(M: Array, axis: int, v: Array) -> None:
    """Writes into ``v`` (3,) [rad]: at ``axis`` the twist about it, elsewhere the swing's rotation vector."""
    w = np.sqrt(max(1.0 + M[0, 0] + M[1, 1] + M[2, 2], 1e-12)) * 0.5
    q = np.empty(3)
    q[0], q[1], q[2] = M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]
    q /= 4.0 * w
    n = np.sqrt(w * w + q[axis] * q[axis])
    if n < 1e-6:
        v[:] = 0.0
        return
    cw, cx = w / n, q[axis] / n
    i, j = (axis + 1) % 3, (axis + 2) % 3
    si, sj = cw * q[i] - cx * q[j], cw * q[j] + cx * q[i]  # swing = q · twist⁻¹; its component at the axis is 0
    s = np.sqrt(si * si + sj * sj)
    f = 2.0 * np.arctan2(s, n) / s if s > 1e-9 else 2.0
    v[axis] = 2.0 * np.arctan2(cx, cw)
    v[i], v[j] = f * si, f * sj


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _add_priors(state: PoseState, predicted: PoseState, table: JointTable, plan: Schedule, A: Array, b: Array) -> None:
    """Holds every axis near the prediction, near rest, and within its limits (the root only near the prediction)."""
    off, angles, turned = np.empty(3), np.empty(3), np.empty(3)
    M = np.empty((3, 3))
    last = -1
    A3 = 1.0 / (0.10 * plan.step_scale) ** 2
    for i in range(3):
        A[3 + i, 3 + i] += A3 + plan.damping * 10
        b[3 + i] += A3 * (predicted.root[i] - state.root[i])
        A[i, i] += 1.0 / (table.step[0, i] * plan.step_scale) ** 2 + plan.damping
    for d in range(len(table.dof_link)):
        link, axis, row = table.dof_link[d], table.dof_axis[d], 6 + d
        if link != last:
            M[:] = 0.0
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        M[i, j] += state.local[link, k, i] * predicted.local[link, k, j]
            rotation_log(M, off)  # from the state to the prediction, in the link's frame
            swing_twist_angles(state.local[link], table.twist_axis[link], angles)
            last = link
            _to_link_axes(angles, table.twist_axis[link], turned)
        k = 1.0 / (table.step[link, axis] * plan.step_scale) ** 2
        A[row, row] += k + plan.damping
        b[row] += k * off[axis]
        k = 1.0 / table.spread[link, axis] ** 2
        A[row, row] += k
        b[row] -= k * turned[axis]
        beyond = max(angles[axis] - table.high[link, axis], 0.0) + min(angles[axis] - table.low[link, axis], 0.0)
        if beyond != 0.0:
            k = 1.0 / LIMIT_SIGMA**2
            _push_back(A, b, row, d, table, link, axis, angles[table.twist_axis[link]], k, beyond)


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _to_link_axes(angles: Array, axis: int, turned: Array) -> None:
    """Swing components as the turning link's own axes see them: turned back by the twist."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(angles[axis]), np.sin(angles[axis])
    turned[axis] = angles[axis]
    turned[i], turned[j] = c * angles[i] + s * angles[j], c * angles[j] - s * angles[i]


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _push_back(
    A: Array,
    b: Array,
    row: int,
    d: int,
    table: JointTable,
    link: int,
    axis: int,
    twist: float,
    k: float,
    beyond: float,
) -> None:
    """Adds one limit, a plane in angle space; a swing component moves with both of the link's own swing axes."""
    twist_axis = table.twist_axis[link]
    grad = np.zeros(3)
    if axis == twist_axis:
        grad[axis] = 1.0
    else:
        i, j = (twist_axis + 1) % 3, (twist_axis + 2) % 3
        c, s = np.cos(twist), np.sin(twist)
        grad[i], grad[j] = (c, -s) if axis == i else (s, c)
    first = row - axis  # free axes of a link are stored together: all three or none
    for i in range(3):
        b[first + i] -= k * grad[i] * beyond
        for j in range(3):
            A[first + i, first + j] += k * grad[i] * grad[j]


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _solve(A: Array, b: Array) -> None:
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


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _apply(x: Array, root: Array, local: Array, table: JointTable) -> None:
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


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def fit_pose(
    points: Array,
    normals: Array,
    start: PoseState,
    predicted: PoseState,
    offsets: Array,
    surface: Surface,
    table: JointTable,
    plan: Schedule,
) -> FitArrays:
    """Fits the pose to a cloud.

    ``points, normals`` (N, 3) float32 [m, world]; ``start``: where iterations begin; ``predicted``: where the motion
    prior pulls; ``offsets`` (L, 3) float64 [m]: joints in their parents' frames. An empty cloud returns the start.
    """
    root, local = start.root.copy(), start.local.copy()
    links, size = len(local), 6 + len(table.dof_link)
    H, g = np.empty((links, 6, 6)), np.empty((links, 6))
    A, b = np.empty((size, size)), np.empty(size)
    near = np.empty((len(points), NEAR_LINKS), np.int8)
    link, row, d2 = np.empty(len(points), np.int64), np.empty(len(points), np.int64), np.empty(len(points))
    scale = 2500.0 / max(len(points), 1) / DATA_SIGMA_M**2
    shrink = (plan.gate_last_m / plan.gate_first_m) ** (1.0 / max(plan.iterations - 1, 1))
    gate = plan.gate_first_m
    for iteration in range(plan.iterations):
        R, t = forward(root, local, offsets, table.parents)
        if iteration % 3 == 0:
            _near_links(points, R, t, surface, gate + 0.02, near)
        match_points(points, normals, near, R, t, surface, link, row, d2)
        _normal_equations(points, link, row, d2, R, t, surface, gate, plan.point_share, H, g)
        _project(H, g, R, t, table, scale, A, b)
        _add_priors(PoseState(root, local), predicted, table, plan, A, b)
        _solve(A, b)
        _apply(b, root, local, table)
        gate *= shrink
    return judge_pose(points, normals, PoseState(root, local), offsets, surface, table)


@njit(nogil=True, cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def judge_pose(
    points: Array, normals: Array, state: PoseState, offsets: Array, surface: Surface, table: JointTable
) -> FitArrays:
    """How well a pose explains a cloud, without moving it (arguments as in ``fit_pose``)."""
    R, t = forward(state.root, state.local, offsets, table.parents)
    count = len(points)
    near = np.empty((count, NEAR_LINKS), np.int8)
    _near_links(points, R, t, surface, 0.15, near)
    link, row, d2 = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    match_points(points, normals, near, R, t, surface, link, row, d2)
    assigned, explained = np.zeros(len(R)), np.zeros(len(R))
    score, inliers, square = 0.0, 0, 0.0
    for n in range(count):
        if link[n] < 0:
            score += 1.0
            continue
        score += d2[n] / (d2[n] + INLIER_M**2)
        assigned[link[n]] += 1.0
        if d2[n] < INLIER_M**2:
            explained[link[n]] += 1.0
            inliers += 1
            square += d2[n]
        else:
            link[n] = -1
    share = inliers / count if count else 0.0
    rms = np.sqrt(square / inliers) if inliers else 0.0
    return FitArrays(state, score / count if count else 1.0, share, rms, assigned, explained, link)
