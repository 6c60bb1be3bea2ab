"""How far, and how willingly, every joint of the link tree turns.

A joint's rotation relative to its parent is read as three angles along the axes of the link's rest frame: the twist
about the bone and the two components of the swing that is left (a rotation vector). The table gives for each angle the
range a healthy adult reaches, widened: limits that are too narrow cost far more than limits that are too wide
(±50° feet put the toes 18 cm off). Values are for the left side; the right side is its mirror image in x.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_NAMES, LINK_PARENTS, SIDES

Array = NDArray[Any]

LIMIT_SIGMA = 0.06  # rad beyond a joint limit
ROOT_STEP_M = 0.10  # standard deviation of the change of the root's position in 1/30 s
X, Y = 0, 1  # twist axes: arms lie along x at rest, everything else roughly along y

# link: twist axis; then lowest and highest angles, spread about rest, and change from frame to frame, all in degrees.
# A spread of 0 locks the axis: fingers and toes are too small for a depth camera at 2.5 m to show how they turn.
_TABLE: dict[str, tuple[int, tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "pelvis": (Y, (-400, -400, -400), (400, 400, 400), (400, 400, 400), (20, 20, 20)),
    "lower_spine": (Y, (-40, -50, -40), (70, 50, 40), (15, 15, 15), (8, 8, 8)),
    "upper_spine": (Y, (-40, -50, -40), (70, 50, 40), (15, 15, 15), (8, 8, 8)),
    "neck": (Y, (-50, -50, -45), (60, 50, 45), (15, 15, 15), (8, 8, 8)),
    "head": (Y, (-50, -60, -45), (50, 60, 45), (20, 25, 20), (10, 10, 10)),
    "clavicle": (X, (-10, -35, -20), (10, 35, 50), (3, 10, 10), (2, 6, 6)),
    "upper_arm": (X, (-120, -155, -110), (120, 70, 120), (90, 150, 150), (10, 30, 30)),
    "forearm": (X, (-60, -165, -20), (60, 10, 20), (15, 150, 5), (6, 30, 4)),
    "hand": (X, (-90, -50, -90), (90, 50, 90), (45, 60, 75), (8, 12, 12)),
    "fingers": (X, (0, 0, 0), (0, 0, 0), (0, 0, 0), (1, 1, 1)),
    "thigh": (Y, (-150, -70, -60), (70, 70, 100), (120, 40, 90), (25, 8, 20)),
    "shin": (Y, (-10, -30, -15), (170, 30, 15), (150, 10, 5), (25, 5, 4)),
    "foot": (Y, (-65, -50, -50), (65, 50, 50), (25, 15, 15), (12, 8, 8)),
    "toes": (Y, (0, 0, 0), (0, 0, 0), (0, 0, 0), (1, 1, 1)),
}


class JointTable(NamedTuple):
    """The table as arrays for the kernels (L links).

    ``parents`` (L,) int64; ``ancestor`` (L, L) bool, [a, l] = a is l or above it; ``twist_axis`` (L,) int64;
    ``low, high, spread, step`` (L, 3) float64 [rad]: range, standard deviation about rest, and that of the change in
    1/30 s; ``dof_link, dof_axis`` (D,) int64: the D free joint axes, without the six of the root.
    """

    parents: Array
    ancestor: Array
    twist_axis: Array
    low: Array
    high: Array
    spread: Array
    step: Array
    dof_link: Array
    dof_axis: Array


def joint_table() -> JointTable:
    """The human joint table for ``LINK_NAMES``."""
    rows = [_row(name) for name in LINK_NAMES]
    low, high, spread, step = (np.radians(np.array([row[k] for row in rows], float)) for k in (1, 2, 3, 4))
    free = [(link, axis) for link in range(1, LINK_COUNT) for axis in range(3) if spread[link, axis] > 0]
    return JointTable(
        parents=np.array(LINK_PARENTS, np.int64),
        ancestor=_ancestors(),
        twist_axis=np.array([row[0] for row in rows], np.int64),
        low=low,
        high=high,
        spread=spread,
        step=step,
        dof_link=np.array([link for link, _ in free], np.int64),
        dof_axis=np.array([axis for _, axis in free], np.int64),
    )


def _row(name: str) -> tuple[int, Array, Array, Array, Array]:
    side, _, part = name.partition("_")
    twist, low, high, spread, step = _TABLE[part if side in SIDES else name]
    lo, hi = np.array(low, float), np.array(high, float)
    if side == "right":  # mirrored in x: turns about y and z change their sign
        lo[1:], hi[1:] = -hi[1:].copy(), -lo[1:].copy()
    return twist, lo, hi, np.array(spread, float), np.array(step, float)


def _ancestors() -> Array:
    above = np.eye(LINK_COUNT, dtype=np.bool_)
    for link in range(1, LINK_COUNT):
        above[:, link] |= above[:, LINK_PARENTS[link]]
    return above


@njit(nogil=True, cache=True, error_model="numpy")
def add_priors(
    root: Array,
    local: Array,
    predicted_root: Array,
    predicted_local: Array,
    table: JointTable,
    step_scale: float,
    damping: float,
    A: Array,
    b: Array,
) -> None:
    """Adds to the normal equations A (6+D, 6+D), b (6+D,) what holds every axis near the prediction, near rest, and
    within its limits (the root only near the prediction); ``root`` (3,) [m], ``local`` (L, 3, 3): the pose now."""
    off, angles, turned = np.empty(3), np.empty(3), np.empty(3)
    M = np.empty((3, 3))
    last = -1
    k = 1.0 / (ROOT_STEP_M * step_scale) ** 2
    for i in range(3):
        A[3 + i, 3 + i] += k + damping * 10
        b[3 + i] += k * (predicted_root[i] - root[i])
        A[i, i] += 1.0 / (table.step[0, i] * step_scale) ** 2 + damping
    for d in range(len(table.dof_link)):
        link, axis, row = table.dof_link[d], table.dof_axis[d], 6 + d
        if link != last:
            M[:] = 0.0
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        M[i, j] += local[link, k, i] * predicted_local[link, k, j]
            rotation_log(M, off)  # from the state to the prediction, in the link's frame
            swing_twist_angles(local[link], table.twist_axis[link], angles)
            last = link
            _to_link_axes(angles, table.twist_axis[link], turned)
        k = 1.0 / (table.step[link, axis] * step_scale) ** 2
        A[row, row] += k + damping
        b[row] += k * off[axis]
        k = 1.0 / table.spread[link, axis] ** 2
        A[row, row] += k
        b[row] -= k * turned[axis]
        beyond = max(angles[axis] - table.high[link, axis], 0.0) + min(angles[axis] - table.low[link, axis], 0.0)
        if beyond != 0.0:
            k = 1.0 / LIMIT_SIGMA**2
            _push_back(A, b, row, d, table, link, axis, angles[table.twist_axis[link]], k, beyond)


@njit(nogil=True, cache=True, error_model="numpy")
def _to_link_axes(angles: Array, axis: int, turned: Array) -> None:
    """Swing components as the turning link's own axes see them: turned back by the twist."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(angles[axis]), np.sin(angles[axis])
    turned[axis] = angles[axis]
    turned[i], turned[j] = c * angles[i] + s * angles[j], c * angles[j] - s * angles[i]


@njit(nogil=True, cache=True, error_model="numpy")
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


@njit(nogil=True, cache=True, error_model="numpy")
def rotation_log(M: Array, v: Array) -> None:
    """Writes the rotation vector (3,) [rad] of M (3, 3) into ``v``; near a half turn the axis is only approximate."""
    x, y, z = M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]
    s = np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(s, M[0, 0] + M[1, 1] + M[2, 2] - 1.0)
    f = angle / s if s > 1e-9 else 0.5
    v[0], v[1], v[2] = f * x, f * y, f * z


@njit(nogil=True, cache=True, error_model="numpy")
def rotation_exp(v: Array, M: Array) -> None:
    """Writes the rotation matrix (3, 3) of the rotation vector ``v`` (3,) [rad] into M (Rodrigues)."""
    angle = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    f = np.sin(angle) / angle if angle > 1e-9 else 1.0
    h = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-9 else 0.5
    c = np.cos(angle)
    M[0, 0], M[0, 1], M[0, 2] = c + h * v[0] * v[0], h * v[0] * v[1] - f * v[2], h * v[0] * v[2] + f * v[1]
    M[1, 0], M[1, 1], M[1, 2] = h * v[0] * v[1] + f * v[2], c + h * v[1] * v[1], h * v[1] * v[2] - f * v[0]
    M[2, 0], M[2, 1], M[2, 2] = h * v[0] * v[2] - f * v[1], h * v[1] * v[2] + f * v[0], c + h * v[2] * v[2]


@njit(nogil=True, cache=True, error_model="numpy")
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


@njit(nogil=True, cache=True, error_model="numpy")
def turned_on(before: Array, now: Array, shares: Array, twist_axis: Array) -> Array:
    """Local rotations (K, L, 3, 3) when every link goes on turning by each of ``shares`` (K,) of its turn from
    ``before`` to ``now`` (L, 3, 3) about its parent, without the twist; the root keeps all three axes."""
    out = np.empty((len(shares), *now.shape))
    M, v = np.empty((3, 3)), np.empty(3)
    for link in range(len(now)):
        for k in range(len(shares)):
            _multiply(before[link].T, now[link], M)
            rotation_log(M, v)
            if link > 0:
                v[twist_axis[link]] = 0.0
            rotation_exp(v * shares[k], M)
            _multiply(now[link], M, out[k, link])
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _multiply(P: Array, Q: Array, out: Array) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = P[i, 0] * Q[0, j] + P[i, 1] * Q[1, j] + P[i, 2] * Q[2, j]
