"""The annealed particle filter on a whole body, in a hierarchy (beyond Rao & Hodges, whose trackers follow one limb).

All angles at once would need far more particles than 81. Torso and head are searched first, the limbs carried along
stiffly; then each limb on the torso found, with the points that nothing else explains. The weight is two-sided, so no
limb hides in the torso. The same weights say how sure a joint is: how many of its points are lost when it turns.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_PARENTS, SIDES, Skeleton
from common.geometry.point_cloud import PointCloud
from common.geometry.rigid_transform import rigid_transform
from sender.fitting.annealed_particle_filter import AnnealingSettings, anneal
from sender.fitting.articulated_gauss_newton import PoseState, forward
from sender.fitting.ellipsoid_body import TORSO, EllipsoidBody, arm_links, ellipsoid_body, link_transforms, quadrics
from sender.fitting.joint_limits import JointTable
from sender.fitting.particle_weights import ParticleWeights
from sender.fitting.whole_body_ellipsoids import Ellipsoids
from sender.fitting.whole_body_fit import judge_ellipsoids

Array = NDArray[Any]
Floats = NDArray[np.float64]

PARTS: tuple[tuple[str, ...], ...] = (
    TORSO,
    *(arm_links(side) for side in SIDES),
    *(tuple(f"{side}_{part}" for part in ("thigh", "shin", "foot")) for side in SIDES),
)
SKIN_SCALE = 1.15  # points on the skin lie on the ellipsoids: a little larger, they lie inside
MOVE_SIGMA_M = 0.01
STEP_SHARE = 0.5  # of the joint table's steps, which are priors and wide
DOUBT_RAD = 1.0  # noise of a limb that is lost
EXPECTED = 0.5  # of the share an ellipsoid usually holds, which it should hold at least
REACH_MARGIN_M = 0.25
TURN_RAD, CERTAIN_LOSS = 0.35, 0.3  # a joint is certain when a turn by so much loses this share of what it moves
FEW = 12  # points: with fewer there is nothing to weigh


class Part:
    """One step of the hierarchy: links that particles turn, and all ellipsoids that these carry.

    ``rows`` (E',): the ellipsoids among all; ``carriers`` (E',): the turning link at or above each.
    """

    def __init__(self, names: tuple[str, ...], skeleton: Skeleton, ellipsoids: Ellipsoids) -> None:
        self.body = ellipsoid_body(skeleton, names)
        self._ellipsoids = ellipsoids
        carriers = np.array([_carrier(int(link), self.body.links) for link in ellipsoids.links])
        self.rows = np.flatnonzero(carriers >= 0)
        self.carriers = carriers[self.rows]
        self.reach_m = float(np.linalg.norm(skeleton.tips[self.body.links], axis=1).sum()) + REACH_MARGIN_M

    @property
    def first(self) -> int:
        """The link nearest to the root."""
        return int(self.body.links[0])

    def at(self, pose: PoseState, R: Array, t: Array, scale: float) -> tuple[EllipsoidBody, Array]:
        """The limb with all angles 0 in ``pose`` (link frames ``R, t``), semi-axes times ``scale``, and the (4, 4)
        transform that carries it. A particle then says how each joint turns from there, far from the half turn at
        which angles are singular."""
        links, at = self._ellipsoids.links[self.rows], self.carriers
        turned = np.swapaxes(R[at], 1, 2)
        centres = np.einsum("eij,ej->ei", R[links], self._ellipsoids.centres[self.rows]) + t[links] - t[at]
        first_of = {int(link): row for row, link in enumerate(self.body.links)}
        offsets: Floats = self.body.offsets
        T_world_parent: Array = np.eye(4)
        if self.first == 0:
            offsets = offsets.copy()
            offsets[0] = pose.root
        else:
            up = LINK_PARENTS[self.first]
            T_world_parent = rigid_transform(R[up], t[up])
        body = replace(
            self.body,
            offsets=offsets,
            zero=np.ascontiguousarray(pose.local[self.body.links]),
            low=np.full(self.body.dof_count, -np.inf),  # limits are the polish's: these angles start elsewhere
            high=np.full(self.body.dof_count, np.inf),
            ellipsoid_link=np.array([first_of[int(link)] for link in at]),
            centres=np.einsum("eij,ej->ei", turned, centres),
            directions=turned @ R[links] @ self._ellipsoids.directions[self.rows],
            axes=scale * self._ellipsoids.axes[self.rows],
        )
        return body, T_world_parent.astype(np.float64)


class WholeBodyParticles:
    """Particles of one person's body. ``weights``: on which device they are weighed."""

    def __init__(
        self,
        skeleton: Skeleton,
        ellipsoids: Ellipsoids,
        table: JointTable,
        weights: ParticleWeights,
        settings: AnnealingSettings,
    ) -> None:
        self._ellipsoids, self._table = ellipsoids, table
        self._offsets = skeleton.offsets.astype(np.float64)
        self._weights, self._settings = weights, settings
        self._parts = [Part(names, skeleton, ellipsoids) for names in PARTS if LINK_INDEX[names[0]] in ellipsoids.links]
        self._random = np.random.default_rng(0)

    def search(
        self, cloud: PointCloud, pose: PoseState, usual: Array, confidence: Array, step_scale: float
    ) -> PoseState:
        """The pose found around ``pose``; ``usual`` (E,): share of the cloud each ellipsoid usually explains;
        ``confidence`` (L,): of each link so far, limbs in doubt are searched further away; ``step_scale``: how many
        1/30 s the motion may have taken."""
        owner = np.full(len(cloud), -1)
        for part in self._parts:
            R, t = forward(pose.root, pose.local, self._offsets, self._table.parents)
            points = self._claimable(part, cloud, owner, t)
            if len(points) < FEW:
                continue
            body, T_world_parent = part.at(pose, R, t, _scale(cloud))
            expected = EXPECTED * usual[part.rows] * len(cloud) / len(points)
            expected = (expected / max(float(expected.sum()), 1.0)).astype(np.float32)
            weigh = partial(self._weigh, body, T_world_parent, points, expected)
            stay = np.zeros(body.dof_count)
            sigma = self._sigma(body, confidence) * step_scale
            found = anneal(stay, sigma, weigh, self._settings, self._random)
            last = found.layers[-1]
            ends = np.stack([stay, found.pose, last.particles[last.selected[0]]])
            pose = _moved(pose, body, T_world_parent, ends[np.argmax(weigh(ends))])
            if part.first == 0:
                owner = self._owners(cloud, pose)
        return pose

    def certainty(self, cloud: PointCloud, pose: PoseState) -> Array:
        """How surely each link's joint is held (L,), 0..1: what share of the points of all it moves is lost when it
        turns about its least certain axis across the bone; 0 for links without a free angle."""
        certain = np.zeros(LINK_COUNT)
        owner = self._owners(cloud, pose)
        R, t = forward(pose.root, pose.local, self._offsets, self._table.parents)
        for part in self._parts:
            points = self._claimable(part, cloud, owner, t)
            if len(points) < FEW:
                continue
            body, T_world_parent = part.at(pose, R, t, _scale(cloud))
            turning = np.flatnonzero(body.dof_axis < 3)
            turns = np.zeros((1 + 2 * len(turning), body.dof_count))
            turns[1 + np.arange(len(turning)), turning] = TURN_RAD
            turns[1 + len(turning) + np.arange(len(turning)), turning] = -TURN_RAD
            claimed = len(points) * self._weigh(
                body, T_world_parent, points, np.zeros(len(part.rows), np.float32), turns
            )
            loss = claimed[0] - np.maximum(*claimed[1:].reshape(2, -1))
            for row, link in enumerate(body.links):
                swings = (body.dof_link[turning] == row) & (body.dof_axis[turning] != body.twist_axis[row])
                if swings.any():
                    moves = self._table.ancestor[link, self._ellipsoids.links]
                    own = np.isin(owner, np.flatnonzero(moves)).sum()
                    certain[link] = np.clip(loss[swings].min() / max(CERTAIN_LOSS * own, 1.0), 0.0, 1.0)
        return certain

    def _owners(self, cloud: PointCloud, pose: PoseState) -> Array:
        return judge_ellipsoids(
            cloud.positions, cloud.normals, pose, self._offsets, self._ellipsoids, self._table.parents
        ).owner

    def _claimable(self, part: Part, cloud: PointCloud, owner: Array, t: Array) -> Array:
        """Points (N', 3) that no other part explains and that this one could reach."""
        if part.first == 0:
            return cloud.positions
        near = np.linalg.norm(cloud.positions - t[part.first].astype(np.float32), axis=1) < part.reach_m
        return np.ascontiguousarray(cloud.positions[near & ((owner < 0) | np.isin(owner, part.rows))])

    def _sigma(self, body: EllipsoidBody, confidence: Array) -> Floats:
        """Noise (D,) of the top layer [rad, m]: the motion's, and more for a limb that is not held."""
        turning = body.dof_axis < 3
        links = body.links[body.dof_link[turning]]
        sigma = np.full(body.dof_count, MOVE_SIGMA_M)
        sigma[turning] = STEP_SHARE * self._table.step[links, body.dof_axis[turning]]
        if body.links[0] > 0:
            sigma[turning] += DOUBT_RAD * (1.0 - confidence[links].min()) ** 2
        return sigma

    def _weigh(self, body: EllipsoidBody, T: Array, points: Array, expected: Array, particles: Floats) -> Array:
        return self._weights(points, quadrics(body, particles, T), expected)


def _carrier(link: int, moving: Array) -> int:
    """The nearest link at or above ``link`` that is one of ``moving``; -1: there is none."""
    while link >= 0 and link not in moving:
        link = LINK_PARENTS[link]
    return link


def _scale(cloud: PointCloud) -> float:
    return SKIN_SCALE if cloud.normals.any() else 1.0


def _moved(pose: PoseState, body: EllipsoidBody, T_world_parent: Array, particle: Floats) -> PoseState:
    """``pose`` with the joints of ``body`` turned as the ``particle`` (D,) says."""
    T = link_transforms(body, particle[None], T_world_parent)[0]
    root, local = pose.root, pose.local.copy()
    for row, link in enumerate(body.links):
        up = body.parents[row]
        R_parent = T_world_parent[:3, :3] if up < 0 else T[up, :, :3]
        local[link] = R_parent.T @ T[row, :, :3]
        if link == 0:
            root = T[row, :, 3].copy()
    return PoseState(root, local)
