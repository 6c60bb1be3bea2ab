"""Finding lost limbs, or a lost body, again with particles, a few per frame (algorithms.md §4, last use).

Gauss–Newton follows only what its points still find. When a limb stays lost, particles spread around where it was last
seen, where it is thought to be, and over all it can reach; each frame is one layer: the particles are weighed on the
points nobody else explains, the heaviest are kept (deterministic selection, Rao §5.1) and spread again, closer. The
best of each layer are polished by Gauss–Newton and taken only if they explain the cloud clearly better.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from sender.fitting.articulated_gauss_newton import FitArrays, PoseState, Schedule, forward
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.joint_limits import JointTable
from sender.fitting.limb_search import (
    CLEARLY_BETTER,
    RETRY,
    RETRY_POINTS,
    SCORED_POINTS,
    Limb,
    free_rows,
    nearby_poses,
    score_poses,
    thinned,
    with_limb,
)
from sender.fitting.surface_matching import tints

Array = NDArray[Any]

LAYERS = (1.0, 0.4, 0.16)  # shares of the joints' spread that the noise of each layer has
LIMB_PARTICLES, LIMB_ANYWHERE, LIMB_KEPT, LIMB_POLISHED = 240, 100, 24, 2
WIDEST_RAD = 0.8  # spread of the noise of an axis that is hardly limited
BODY_PARTICLES, BODY_KEPT, BODY_POINTS = 6, 3, 250
BODY_STEPS = 3.0  # the noise of body particles, in steps of 1/30 s of every joint
BODY_SHIFT_M = 0.06
BODY_PLAN = Schedule(4, 0.20, 0.08, 0.1, 6.0, 1.0)


class LimbRecovery:
    """One limb's search, carried on from frame to frame by ``step`` until it says it has ``ended``."""

    def __init__(self, limb: Limb, last_good: PoseState, seed: int) -> None:
        self.limb = limb
        self._last_good = last_good
        self._random = np.random.default_rng(seed)
        self._layer = -1  # before the particles: the limb only turned or bent, the most common loss
        self._kept = np.empty((0, 3, 3, 3))

    @property
    def ended(self) -> bool:
        """Whether all layers were tried."""
        return self._layer >= len(LAYERS)

    def step(self, fit: FitArrays, cloud: PointCloud, fitter: BodyFitter) -> PoseState | None:
        """One layer on ``cloud`` (N points, world), whose best pose so far is ``fit``, judged on it: a clearly better
        pose or None; ``fit.owner`` tells of these N points which are explained."""
        R, t = forward(fit.pose.root, fit.pose.local, fitter.offsets, fitter.table.parents)
        rows = free_rows(self.limb, fit, t, fitter.offsets, cloud)
        if len(rows) < 10:
            self._layer = len(LAYERS)
            return None
        rows = rows[:: max(len(rows) // SCORED_POINTS, 1)]
        poses = self._spread(fit.pose, fitter.table)
        costs = score_poses(
            cloud.positions[rows], cloud.normals[rows], tints(cloud.colours[rows]), R, t, self.limb.links, poses,
            fitter.offsets, fitter.surface, fitter.table.parents,
        )  # fmt: skip
        self._kept = heaviest = poses[np.argsort(costs, kind="stable")[:LIMB_KEPT]]
        self._layer += 1
        return _polished(self.limb, heaviest[:LIMB_POLISHED], fit, cloud, fitter)

    def _spread(self, now: PoseState, table: JointTable) -> Array:
        """This layer's particles (K, 3, 3, 3): local rotations of the limb's links."""
        links = self.limb.links
        known = np.stack([state.local[links] for state in (self._last_good, now)])
        if self._layer == -1:
            turned = [nearby_poses(self.limb, state.local, table) for state in (self._last_good, now)]
            return np.concatenate([known, *turned])
        anywhere = self.limb.poses[self._random.choice(len(self.limb.poses), LIMB_ANYWHERE, replace=False)]
        kept = np.repeat(known, LIMB_KEPT // 2, axis=0) if self._layer == 0 else self._kept
        seeds = np.concatenate([kept, anywhere])
        each = np.resize(np.arange(len(seeds)), LIMB_PARTICLES)  # every survivor the same number of times
        sigma = LAYERS[self._layer] * np.minimum(table.spread[links], WIDEST_RAD)
        noise = self._random.normal(size=(LIMB_PARTICLES, 3, 3)) * sigma
        noise[: len(kept)] = 0.0  # the seeds themselves stay in the race
        turns = quaternion.to_matrix(quaternion.from_rotation_vector(noise))
        out: Array = seeds[each] @ turns
        return out


def _polished(limb: Limb, poses: Array, fit: FitArrays, cloud: PointCloud, fitter: BodyFitter) -> PoseState | None:
    """The best of ``poses`` (K, 3, 3, 3) after Gauss–Newton, if it explains the cloud clearly better than ``fit``.

    Few points are fitted but all are judged: any pose looks better on just the points it was fitted to.
    """
    some = thinned(cloud, RETRY_POINTS)
    best, best_score = None, CLEARLY_BETTER * fit.score
    for pose in poses:
        start = with_limb(fit.pose, limb, pose)
        retry = fitter.judge(cloud, fitter.move(some, start, start, RETRY))
        if retry.score < best_score:
            best, best_score = retry.pose, retry.score
    return best


class BodyRecovery:
    """Whole-body particles for as long as tracking is bad: a few per frame, the heaviest carried on."""

    def __init__(self, last_good: PoseState, seed: int) -> None:
        self._kept: list[PoseState] = [last_good]
        self._random = np.random.default_rng(seed)

    def step(self, now: PoseState, cloud: PointCloud, fitter: BodyFitter) -> PoseState:
        """The heaviest of this frame's particles; ``now``: the pose tracking has come to."""
        some = thinned(cloud, BODY_POINTS)
        seeds = [now, *(PoseState(now.root + 0.0, kept.local) for kept in self._kept)]
        starts = seeds + [self._moved(seeds[k % len(seeds)], fitter.table) for k in range(BODY_PARTICLES - len(seeds))]
        fits = sorted((fitter.fit(some, start, start, BODY_PLAN) for start in starts), key=lambda fit: fit.score)
        self._kept = [fit.pose for fit in fits[:BODY_KEPT]]
        return self._kept[0]

    def _moved(self, seed: PoseState, table: JointTable) -> PoseState:
        noise = self._random.normal(size=table.step.shape) * BODY_STEPS * table.step
        turns = quaternion.to_matrix(quaternion.from_rotation_vector(noise))
        return PoseState(seed.root + self._random.normal(size=3) * BODY_SHIFT_M, seed.local @ turns)
