"""Where the joints are, learned from motion: a joint centre is where the motions of both its links agree.

The automatic start takes bone lengths from one posture, in which an elbow may lie anywhere along the arm. When the
arm bends, a wrong centre shows: the points no longer fit the surface, however the pose is chosen. Every observed
frame is linearised in the pose and in two displacements per joint, one in the frame of the parent and one in that of
the link itself; the pose is eliminated (Schur complement) and what remains is summed over frames. This is the
least-squares form of symmetrical centre-of-rotation estimation (SCoRE; Ehrig et al. 2006), on points instead of
markers, for all joints at once, and regularised to the sizes the person started with.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_NAMES, SIDES
from common.geometry.point_cloud import PointCloud
from sender.fitting.articulated_gauss_newton import (
    DATA_SIGMA_M,
    PoseState,
    axis_twists,
    forward,
    normal_equations,
    project,
)
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.joint_limits import JointTable, add_priors
from sender.fitting.surface_matching import Surface, match_points, near_links, tints

Array = NDArray[Any]

GATE_M, POINT_SHARE = 0.06, 0.1
SIDES_SIGMA_M = 0.01  # of the difference between a displacement and its mirror image on the other side
FRAME_WEIGHT = 0.4  # neighbouring frames repeat each other's errors
LOOSE_STEPS = 10.0  # the motion prior hardly holds the poses: they must not explain by themselves what sizes explain
MEMORY_FRAMES = 300.0
LARGEST_STEP_M = 0.015

_FIXED = {LINK_INDEX["pelvis"]} | {LINK_INDEX[f"{side}_{tip}"] for side in SIDES for tip in ("fingers", "toes")}
JOINTS = np.array([link for link in range(LINK_COUNT) if link not in _FIXED])


class JointCentres:
    """What the frames seen so far say about the joint centres of one body.

    ``start_sigma_m``: of the centres it started with; ``observed``: frames so far. The unknowns are the displacement of
    each of ``JOINTS`` [m] in its parent's frame, then in its own link's frame.
    """

    def __init__(self, start_sigma_m: float) -> None:
        size = 6 * len(JOINTS)
        self._information = np.zeros((size, size))
        self._pull = np.zeros(size)
        self._moved = np.zeros(size)  # away from the start, so far
        self._hold = _start_information(start_sigma_m)
        self.observed = 0

    def observe(self, cloud: PointCloud, state: PoseState, fitter: BodyFitter) -> None:
        """Adds what ``cloud`` (N points, world) says; ``state``: its fitted pose."""
        A, b = _linearised(
            cloud.positions, cloud.normals, tints(cloud.colours), state, fitter.offsets, fitter.surface, fitter.table,
            JOINTS,
        )  # fmt: skip
        pose = len(b) - len(self._pull)
        through_pose = np.linalg.solve(A[:pose, :pose], np.column_stack([A[:pose, pose:], b[:pose]]))
        self._information *= 1.0 - 1.0 / MEMORY_FRAMES
        self._pull *= 1.0 - 1.0 / MEMORY_FRAMES
        self._information += FRAME_WEIGHT * (A[pose:, pose:] - A[pose:, :pose] @ through_pose[:, :-1])
        self._pull += FRAME_WEIGHT * (b[pose:] - A[pose:, :pose] @ through_pose[:, -1])
        self.observed += 1

    def correction(self, least_m: float) -> tuple[Array, Array] | None:
        """Displacements (L, 3), (L, 3) float64 [m] of every joint in its parent's frame and in its own, at most
        ``LARGEST_STEP_M``; they count as made. None while the largest is under ``least_m``."""
        step = np.linalg.solve(self._information + self._hold, self._pull - self._hold @ self._moved)
        largest = float(np.abs(step).max())
        if largest < least_m:
            return None
        step *= min(1.0, LARGEST_STEP_M / largest)
        self._pull -= self._information @ step
        self._moved += step
        in_parent, in_link = np.zeros((2, LINK_COUNT, 3))
        in_parent[JOINTS], in_link[JOINTS] = step.reshape(2, -1, 3)
        return in_parent, in_link


def _start_information(sigma_m: float) -> Array:
    """What is known before any frame (K, K): displacements are small, and much the same on both sides."""
    size = 3 * len(JOINTS)
    mirrored = np.zeros((size, size))
    names = [LINK_NAMES[link] for link in JOINTS]
    for n, name in enumerate(names):
        side, _, part = name.partition("_")
        twin = names.index(f"{SIDES[1 - SIDES.index(side)]}_{part}") if side in SIDES else n
        mirrored[3 * n : 3 * n + 3, 3 * twin : 3 * twin + 3] = np.diag([-1.0, 1.0, 1.0])
    difference = np.eye(size) - mirrored
    one = np.eye(size) / sigma_m**2 + difference.T @ difference / (2.0 * SIDES_SIGMA_M**2)
    return np.kron(np.eye(2), one)


@njit(nogil=True, cache=True, error_model="numpy")
def _linearised(
    points: Array,
    normals: Array,
    tinted: Array,
    state: PoseState,
    offsets: Array,
    surface: Surface,
    table: JointTable,
    joints: Array,
) -> tuple[Array, Array]:
    """Normal equations A (K, K), b (K,) of one cloud: pose axes first, then the displacements of ``joints``."""
    R, t = forward(state.root, state.local, offsets, table.parents)
    count, pose = len(points), 6 + len(table.dof_link)
    link, row, d2 = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    first, members = near_links(points, R, t, surface, GATE_M)
    match_points(points, normals, tinted, first, members, R, t, surface, link, row, d2)
    H, g = np.empty((len(R), 6, 6)), np.empty((len(R), 6))
    normal_equations(points, link, row, d2, R, t, surface, GATE_M, POINT_SHARE, H, g)
    size = pose + 6 * len(joints)
    S, moved = np.zeros((size, 6)), np.empty(size, np.int64)
    axis_twists(R, t, table, S, moved)
    for n in range(len(joints)):
        before, after = pose + 3 * n, pose + 3 * (len(joints) + n)
        for axis in range(3):
            moved[before + axis] = moved[after + axis] = joints[n]
            for i in range(3):
                S[before + axis, 3 + i] = R[table.parents[joints[n]], i, axis]
                S[after + axis, 3 + i] = -R[joints[n], i, axis]
    A, b = np.empty((size, size)), np.empty(size)
    project(H, g, S, moved, table, 2500.0 / max(count, 1) / DATA_SIGMA_M**2, A, b)
    add_priors(state.root, state.local, state.root, state.local, table, LOOSE_STEPS, 1.0, A, b)
    return A, b
