"""Finding an arm or a leg again after it jumped (algorithms.md §8: limb re-search).

Gauss–Newton follows a limb only as far as its points still find it. When a limb no longer explains what lies around it,
a fixed set of its poses (every direction of its first bone, turned about it, bent more or less) is scored on the points
that the rest of the body does not explain; the best few go back to Gauss–Newton.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, SIDES
from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from sender.fitting.articulated_gauss_newton import (
    INLIER_M,
    FitArrays,
    PoseState,
    Schedule,
    forward,
)
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.joint_limits import JointTable
from sender.fitting.surface_matching import Surface, all_near, match_points, tints

Array = NDArray[Any]

_SWINGS, _TWISTS, _BENDS = 6, 5, 4  # samples per angle range
SCORED_POINTS, RETRY_POINTS, RETRIES = 50, 600, 3
RETRY = Schedule(5, 0.12, 0.06, 0.1, 3.0, 1.0)
CLEARLY_BETTER = 0.96  # of the score without the retry
_HINGE = {"forearm": 1, "shin": 0}  # axis about which the middle joint bends


class Limb(NamedTuple):
    """``links`` (3,) int64: first, middle and end link; ``poses`` (K, 3, 3, 3) float64: local rotations to try."""

    links: Array
    poses: Array


def limbs(table: JointTable) -> tuple[Limb, ...]:
    """The four limbs with all poses worth trying."""
    chains = (("upper_arm", "forearm", "hand"), ("thigh", "shin", "foot"))
    return tuple(_limb([f"{side}_{part}" for part in chain], table) for side in SIDES for chain in chains)


def _limb(names: list[str], table: JointTable) -> Limb:
    links = np.array([LINK_INDEX[name] for name in names])
    first, middle = links[0], links[1]
    twist_axis = int(table.twist_axis[first])
    swing_axes = [axis for axis in range(3) if axis != twist_axis]
    hinge = _HINGE[names[1].partition("_")[2]]
    bends = np.linspace(table.low[middle, hinge], table.high[middle, hinge], _BENDS + 1)
    bends = bends[1:] if bends[0] < 0 and abs(bends[0]) > abs(bends[-1]) else bends[:-1]  # a fully closed hinge is rare
    ranges = [np.linspace(table.low[first, axis], table.high[first, axis], _SWINGS) for axis in swing_axes]
    grid = np.stack(np.meshgrid(*ranges, indexing="ij"), -1).reshape(-1, 2)
    grid = grid[np.hypot(*grid.T) < 2.6]  # beyond, the same direction is reached the other way round
    twists = np.linspace(table.low[first, twist_axis], table.high[first, twist_axis], _TWISTS)
    poses = []
    for swing in grid:
        swing_vector = np.zeros(3)
        swing_vector[swing_axes] = swing
        for twist in twists:
            upper = quaternion.multiply(quaternion.from_rotation_vector(swing_vector), _turn(twist_axis, twist))
            poses += [(upper, _turn(hinge, bend), quaternion.IDENTITY) for bend in bends]
    return Limb(links, quaternion.to_matrix(np.array(poses)))


def _turn(axis: int, angle: float) -> Array:
    return quaternion.from_rotation_vector(np.eye(3)[axis] * angle)


def nearby_poses(limb: Limb, local: Array, table: JointTable) -> Array:
    """Poses (K, 3, 3, 3) that keep the first bone's direction of ``local`` (L, 3, 3) and try every turn and bend."""
    first = local[limb.links[0]]
    twist_axis = int(table.twist_axis[limb.links[0]])
    turns = quaternion.to_matrix(np.stack([_turn(twist_axis, a) for a in np.radians(np.arange(-160, 161, 20))]))
    bends = np.unique(limb.poses[:, 1].round(6), axis=0)
    out = np.empty((len(turns), len(bends), 3, 3, 3))
    out[:, :, 0] = (first @ turns)[:, None]
    out[:, :, 1] = bends
    out[:, :, 2] = np.eye(3)
    return out.reshape(-1, 3, 3, 3)


def search_limb(
    limb: Limb, fit: FitArrays, cloud: PointCloud, fitter: BodyFitter, also: tuple[PoseState, ...]
) -> PoseState:
    """The best of ``fit`` and its retries with the limb turned, as it is in ``also``, or anywhere; ``fit.pose`` itself
    when nothing explains the cloud clearly better. ``fit`` was judged on this ``cloud``, and so are the retries, which
    are fitted to fewer points: any pose looks better on just the points it was fitted to."""
    R, t = forward(fit.pose.root, fit.pose.local, fitter.offsets, fitter.table.parents)
    rows = free_rows(limb, fit, t, fitter.offsets, cloud)
    if len(rows) < 10:
        return fit.pose
    rows = rows[:: max(len(rows) // SCORED_POINTS, 1)]
    states = (fit.pose, *also)
    known = [state.local[limb.links][None] for state in states]
    turned = [nearby_poses(limb, state.local, fitter.table) for state in states]
    poses = np.concatenate([*known, *turned, limb.poses])
    costs = score_poses(
        cloud.positions[rows], cloud.normals[rows], tints(cloud.colours[rows]), R, t, limb.links, poses, fitter.offsets,
        fitter.surface, fitter.table.parents,
    )  # fmt: skip
    some = thinned(cloud, RETRY_POINTS)
    best, best_score = fit.pose, CLEARLY_BETTER * fit.score
    for k in np.argsort(costs, kind="stable")[:RETRIES]:
        start = with_limb(fit.pose, limb, poses[k])
        retry = fitter.judge(cloud, fitter.move(some, start, start, RETRY))
        if retry.score < best_score:
            best, best_score = retry.pose, retry.score
    return best


def within_reach(limb: Limb, joints: Array, offsets: Array, cloud: PointCloud) -> Array:
    """Points (N,) bool that the limb could touch; ``joints, offsets`` (L, 3) [m]."""
    reach = np.linalg.norm(offsets[limb.links[1:]], axis=1).sum() + 0.25
    near: Array = np.linalg.norm(cloud.positions - joints[limb.links[0]].astype(np.float32), axis=1) < reach
    return near


def free_rows(limb: Limb, fit: FitArrays, joints: Array, offsets: Array, cloud: PointCloud) -> Array:
    """Rows of the points within the limb's reach that the rest of the body does not explain."""
    free = (fit.owner < 0) | np.isin(fit.owner, limb.links)
    return np.flatnonzero(within_reach(limb, joints, offsets, cloud) & free)


def with_limb(state: PoseState, limb: Limb, pose: Array) -> PoseState:
    """``state`` with the limb's links at the local rotations ``pose`` (3, 3, 3)."""
    local = state.local.copy()
    local[limb.links] = pose
    return PoseState(state.root, local)


def thinned(cloud: PointCloud, count: int) -> PointCloud:
    """Every n-th point, so that about ``count`` (at most twice as many) remain."""
    step = max(len(cloud) // count, 1)
    if step == 1:
        return cloud
    return PointCloud(cloud.positions[::step].copy(), cloud.normals[::step].copy(), cloud.colours[::step].copy())


@njit(nogil=True, cache=True, error_model="numpy")
def score_poses(
    points: Array,
    normals: Array,
    tinted: Array,
    R: Array,
    t: Array,
    links: Array,
    poses: Array,
    offsets: Array,
    surface: Surface,
    parents: Array,
) -> Array:
    """Mean robust cost (K,) 0..1 of ``points, normals`` (N, 3) [m, world], ``tinted`` (N, 2), against one limb in each
    of ``poses`` (K, 3, 3, 3); ``R, t``: the body's link rotations (L, 3, 3) and joints (L, 3), overwritten for
    ``links``."""
    cost = np.zeros(len(poses))
    first, members = all_near(len(points), links, len(R))
    hit, row, d2 = np.empty(len(points), np.int64), np.empty(len(points), np.int64), np.empty(len(points))
    for k in range(len(poses)):
        for c in range(len(links)):
            link, up = links[c], parents[links[c]]
            for i in range(3):
                t[link, i] = t[up, i]
                for j in range(3):
                    t[link, i] += R[up, i, j] * offsets[link, j]
                    R[link, i, j] = 0.0
                    for m in range(3):
                        R[link, i, j] += R[up, i, m] * poses[k, c, m, j]
        match_points(points, normals, tinted, first, members, R, t, surface, hit, row, d2)
        for n in range(len(points)):
            cost[k] += d2[n] / (d2[n] + INLIER_M**2) if hit[n] >= 0 else 1.0
        cost[k] /= max(len(points), 1)
    return cost
