"""Limbs as ellipsoids that joint angles move (Rao & Hodges §5, Fig. 2 a): the model the particle filters fit.

Legs: 10 degrees of freedom, 6 ellipsoids. An arm: 4 and 2. Torso with head: 12 and 4, among them the root's position;
the whole body, hands on stiff wrists: 30 and 16.
The transform of the link that carries the limb is given (pelvis for legs, clavicle for an arm, the world for a torso).
A link turns by ``zero · swing · twist``: the twist about its bone, the swing a rotation vector across it; a hinge is a
joint with only one of the three angles free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, LINK_NAMES, LINK_PARENTS, SIDES, Skeleton
from common.geometry import quaternion
from sender.fitting.joint_limits import joint_table, rotation_exp, swing_twist_angles

Array = NDArray[Any]
Floats = NDArray[np.float64]

X, Y, Z = 0, 1, 2
_TURNS, _MOVES = (0, 1, 2), (3, 4, 5)  # angles about the link's axes; the joint's shift along its parent's axes

# part: the axes that are free, and the axis the bone lies along
_JOINTS: dict[str, tuple[tuple[int, ...], int]] = {
    "pelvis": ((*_TURNS, *_MOVES), Y),
    "lower_spine": ((), Y),
    "upper_spine": (_TURNS, Y),
    "neck": ((), Y),
    "head": (_TURNS, Y),
    "clavicle": ((), X),
    "upper_arm": (_TURNS, X),
    "forearm": ((Y,), X),
    "hand": ((), X),
    "thigh": (_TURNS, Y),
    "shin": ((X,), Y),
    "foot": ((X,), Y),
}
# A swing vector is singular half a turn away from its zero; this is where the left arm points at zero, so that the
# singular direction lies behind the other shoulder.
_LEFT_ARM_ZERO = np.array([0.5, -0.7, 0.5])
_LIMITS = joint_table()
_ENDS = {"hand": "fingers", "foot": "toes"}  # one ellipsoid for both
_WITHOUT_ELLIPSOID = ("neck", "clavicle")

LEGS = tuple(f"{side}_{part}" for side in SIDES for part in ("thigh", "shin", "foot"))
TORSO = ("pelvis", "lower_spine", "upper_spine", "neck", "head")


def arm_links(side: str) -> tuple[str, ...]:
    """The links of the "left" or "right" arm."""
    return f"{side}_upper_arm", f"{side}_forearm"


def _whole_arm(side: str) -> tuple[str, ...]:
    return f"{side}_clavicle", *arm_links(side), f"{side}_hand"


WHOLE_BODY = (*TORSO, *_whole_arm("left"), *_whole_arm("right"), *LEGS)


@dataclass(frozen=True, slots=True, eq=False)
class EllipsoidBody:
    """K links, D degrees of freedom, E ellipsoids; arrays float64 and int64.

    ``links`` (K,): index into ``LINK_NAMES``; ``parents`` (K,): row of the parent link, before it, or -1 where the
    transform given from outside carries it. ``offsets`` (K, 3) [m]: joint in the parent's frame. ``zero`` (K, 3, 3):
    rotation relative to the parent when all angles are 0. ``twist_axis`` (K,).
    ``dof_link, dof_axis`` (D,): row and axis of each degree of freedom: 0..2 an angle [rad] as in ``joint_limits``,
    3..5 a shift of the joint along its parent's axes [m]. ``low, high`` (D,): limits, infinite where none is set.
    ``ellipsoid_link`` (E,): row of the link each ellipsoid is fixed to; ``centres`` (E, 3) [m] and ``directions``
    (E, 3, 3) (columns: the principal directions) in the link's frame; ``axes`` (E, 3) [m]: the semi-axes.
    """

    links: Array
    parents: Array
    offsets: Floats
    zero: Floats
    twist_axis: Array
    dof_link: Array
    dof_axis: Array
    low: Floats
    high: Floats
    ellipsoid_link: Array
    centres: Floats
    directions: Floats
    axes: Floats

    @property
    def dof_count(self) -> int:
        """D, the dimension of a particle."""
        return len(self.dof_link)

    def dof_names(self) -> tuple[str, ...]:
        """Names like ``left_thigh.x`` (an angle) or ``pelvis.move_x``, in the order of a particle."""
        kinds = ("x", "y", "z", "move_x", "move_y", "move_z")
        return tuple(
            f"{LINK_NAMES[self.links[k]]}.{kinds[axis]}" for k, axis in zip(self.dof_link, self.dof_axis, strict=True)
        )

    def scaled(self, factor: float) -> EllipsoidBody:
        """The same body with all semi-axes times ``factor``."""
        return replace(self, axes=self.axes * factor)


def ellipsoid_body(skeleton: Skeleton, names: tuple[str, ...]) -> EllipsoidBody:
    """The links ``names`` (``LEGS``, ``arm_links(side)``, ``TORSO``, ``WHOLE_BODY``, or any with parents first) with
    an ellipsoid each, as long and as thick as the skeleton says.

    Raises:
        KeyError: a link that has no ellipsoid model.
    """
    links = [LINK_INDEX[name] for name in names]
    parts = [name.partition("_")[2] if name.startswith(SIDES) else name for name in names]
    free = [(row, axis) for row, part in enumerate(parts) for axis in _JOINTS[part][0]]
    carrying = [row for row, part in enumerate(parts) if part not in _WITHOUT_ELLIPSOID]
    shapes = [_ellipsoid(skeleton, links[row]) for row in carrying]
    return EllipsoidBody(
        links=np.array(links),
        parents=np.array([links.index(LINK_PARENTS[k]) if LINK_PARENTS[k] in links else -1 for k in links]),
        offsets=skeleton.offsets[links].astype(np.float64),
        zero=np.stack([_zero(name) for name in names]),
        twist_axis=np.array([_JOINTS[part][1] for part in parts]),
        dof_link=np.array([row for row, _ in free]),
        dof_axis=np.array([axis for _, axis in free]),
        low=np.array([_limits(names[row], axis)[0] for row, axis in free]),
        high=np.array([_limits(names[row], axis)[1] for row, axis in free]),
        ellipsoid_link=np.array(carrying),
        centres=np.stack([centre for centre, _, _ in shapes]),
        directions=np.stack([directions for _, directions, _ in shapes]),
        axes=np.stack([axes for _, _, axes in shapes]),
    )


def _limits(name: str, axis: int) -> tuple[float, float]:
    """As in ``joint_limits``, for hinges and for the twist of an arm: there a joint bent the wrong way, or half a turn
    of twist, is another posture with nearly the same score."""
    hinge = len(_JOINTS[name.partition("_")[2]][0]) == 1 if name.startswith(SIDES) else False
    if hinge or (name.endswith("upper_arm") and axis == X):
        link = LINK_INDEX[name]
        return float(_LIMITS.low[link, axis]), float(_LIMITS.high[link, axis])
    return -np.inf, np.inf


def _zero(name: str) -> Floats:
    if not name.endswith("upper_arm"):
        return np.eye(3)
    mirror = np.array([1.0 if name.startswith("left") else -1.0, 1.0, 1.0])
    return np.asarray(quaternion.to_matrix(quaternion.shortest_arc(np.eye(3)[0] * mirror, _LEFT_ARM_ZERO * mirror)))


def _ellipsoid(skeleton: Skeleton, link: int) -> tuple[Floats, Floats, Floats]:
    """Centre, directions and semi-axes in the link's frame; the second direction lies along the bone."""
    start, end = np.zeros(3), skeleton.tips[link].astype(np.float64)
    radius = float(skeleton.radii[link])
    side, _, part = LINK_NAMES[link].partition("_")
    if part in _ENDS:
        end = end + skeleton.tips[LINK_INDEX[f"{side}_{_ENDS[part]}"]]
    if part == "foot":
        start = np.array([0.0, end[1], -radius])  # the heel
    length = float(np.linalg.norm(end - start))
    directions = quaternion.to_matrix(quaternion.shortest_arc(np.array([0.0, 1.0, 0.0]), end - start))
    return (start + end) / 2, np.asarray(directions), np.array([radius, length / 2 + radius / 2, radius])


def link_transforms(body: EllipsoidBody, particles: Floats, T_world_parent: Floats) -> Floats:
    """``T_world_link`` (P, K, 3, 4) of ``particles`` (P, D) [rad, m], the limb carried by ``T_world_parent`` (4, 4)."""
    out = np.empty((len(particles), len(body.links), 3, 4))
    _link_transforms(
        np.ascontiguousarray(particles, np.float64),
        np.ascontiguousarray(T_world_parent, np.float64),
        body.parents, body.offsets, body.zero, body.twist_axis, body.dof_link, body.dof_axis, out,
    )  # fmt: skip
    return out


def quadrics(body: EllipsoidBody, particles: Floats, T_world_parent: Floats) -> NDArray[np.float32]:
    """The ellipsoids of ``particles`` (P, D) as (P, E, 3, 4) float32: the affine map from the world [m] to the frame in
    which the ellipsoid is the unit ball, so that p is inside where |Q [p, 1]|² ≤ 1."""
    T = link_transforms(body, particles, T_world_parent)
    out = np.empty((len(particles), len(body.axes), 3, 4), np.float32)
    _quadrics(T, body.ellipsoid_link, body.centres, body.directions, body.axes, out)
    return out


def particle_of(body: EllipsoidBody, T_world_link: Floats, T_world_parent: Floats) -> Floats:
    """The degrees of freedom (D,) [rad, m] of links at ``T_world_link`` (K, 4, 4), the limb carried by
    ``T_world_parent`` (4, 4); what the joints cannot do is left out (a hinge takes its own share of the turn)."""
    values = np.zeros((len(body.links), 6))
    for row, parent in enumerate(body.parents):
        T_up = T_world_parent if parent < 0 else T_world_link[parent]
        turn = body.zero[row].T @ T_up[:3, :3].T @ T_world_link[row, :3, :3]
        swing_twist_angles(np.ascontiguousarray(turn), body.twist_axis[row], values[row, :3])
        values[row, 3:] = T_up[:3, :3].T @ (T_world_link[row, :3, 3] - T_up[:3, 3]) - body.offsets[row]
    return np.asarray(values[body.dof_link, body.dof_axis])


@njit(nogil=True, cache=True, error_model="numpy")
def _link_transforms(
    particles: Array,
    T_parent: Array,
    parents: Array,
    offsets: Array,
    zero: Array,
    twist_axis: Array,
    dof_link: Array,
    dof_axis: Array,
    out: Array,
) -> None:
    count = len(parents)
    values = np.zeros((count, 6))
    v, swing, twist, turn, local = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for p in range(len(particles)):
        for d in range(len(dof_link)):
            values[dof_link[d], dof_axis[d]] = particles[p, d]
        for k in range(count):
            axis = twist_axis[k]
            v[:] = values[k, :3]
            v[axis] = 0.0
            rotation_exp(v, swing)
            v[:] = 0.0
            v[axis] = values[k, axis]
            rotation_exp(v, twist)
            _multiply(swing, twist, turn)
            _multiply(zero[k], turn, local)
            up = T_parent[:3] if parents[k] < 0 else out[p, parents[k]]
            for i in range(3):
                out[p, k, i, 3] = up[i, 3]
                for j in range(3):
                    out[p, k, i, 3] += up[i, j] * (offsets[k, j] + values[k, 3 + j])
                    out[p, k, i, j] = up[i, 0] * local[0, j] + up[i, 1] * local[1, j] + up[i, 2] * local[2, j]


@njit(nogil=True, cache=True, error_model="numpy")
def _quadrics(T: Array, ellipsoid_link: Array, centres: Array, directions: Array, axes: Array, out: Array) -> None:
    R = np.empty((3, 3))
    for p in range(len(T)):
        for e in range(len(axes)):
            up = T[p, ellipsoid_link[e]]
            _multiply(up[:, :3], directions[e], R)
            for j in range(3):
                centre = up[j, 3] + up[j, 0] * centres[e, 0] + up[j, 1] * centres[e, 1] + up[j, 2] * centres[e, 2]
                for i in range(3):
                    out[p, e, i, j] = R[j, i] / axes[e, i]
                    if j == 0:
                        out[p, e, i, 3] = 0.0
                    out[p, e, i, 3] -= R[j, i] / axes[e, i] * centre


@njit(nogil=True, cache=True, error_model="numpy")
def _multiply(P: Array, Q: Array, out: Array) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = P[i, 0] * Q[0, j] + P[i, 1] * Q[1, j] + P[i, 2] * Q[2, j]
