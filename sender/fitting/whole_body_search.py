"""Finding a known person in mid-motion: many starts, each polished by Gauss–Newton, carried on over a few frames.

Whether it is that person at all is judged both ways: how far the cloud lies off the body, and how far the body's
surface, where the cloud should show it, lies off the cloud. One camera does not tell two people apart by the first
alone: a body turns and bends until its visible side covers nearly everybody's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from common.body.skeleton import LINK_COUNT, LINK_INDEX
from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from sender.fitting.articulated_gauss_newton import FitArrays, PoseState, Schedule, forward
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.body_model import BodyModel
from sender.fitting.joint_limits import JointTable
from sender.fitting.limb_search import limbs, search_limb, thinned

Array = NDArray[Any]

HEADINGS = 8
ROUGH = Schedule(10, 0.40, 0.08, 0.3, 6.0, 0.5)
POLISH = Schedule(8, 0.15, 0.06, 0.1, 6.0, 0.5)
KEPT = 3
ROUGH_POINTS, POLISH_POINTS = 250, 1000
CERTAIN_SCORE = 0.06  # above it, a limb may still be in the wrong place
POSES_PER_STEP = 2
BARE_M = 0.05  # scale of the distance from the body's surface to the cloud
BARE_POINTS = 2000
DIRECTIONS = 24
ONE_SIDED = 0.3  # length of the mean normal above which the cloud shows one side
# Largest mismatch of the known person. Measured on two bodies × 11 clips, best of 3 or 4 steps: four cameras 0.14 to
# 0.21 the same, 0.39 and more another person; two cameras 0.14 to 0.26 and 0.44; one camera half of the starts 0.14 to
# 0.25, the others up to 0.7, and 0.30 and more. Who is not recognised is started afresh, which costs seconds.
KNOWN, KNOWN_ONE_SIDED = 0.30, 0.22
# Upper arms raised, elbows bent, thighs raised and knees bent [deg]: hanging, crouching, T-pose, ...
_POSES_DEG = (
    (-75.0, -15.0, 0.0, 0.0),
    (0.0, -10.0, 0.0, 0.0),
    (-40.0, -30.0, 60.0, 90.0),
    (-60.0, -110.0, 0.0, 0.0),
    (70.0, -20.0, 0.0, 0.0),
    (-40.0, -30.0, 0.0, 0.0),
    (0.0, -10.0, 100.0, 120.0),
    (70.0, -20.0, 40.0, 60.0),
)


class WholeBodySearch:
    """Looks for ``body`` in clouds; ``step`` is called with each frame until its score is good enough."""

    def __init__(self, body: BodyModel, table: JointTable) -> None:
        self._body, self._table = body, table
        self._kept: list[PoseState] = []
        self._tried = 0
        self._limbs = limbs(table)

    def step(self, cloud: PointCloud) -> FitArrays:
        """The best pose so far for ``cloud`` (N points, world); tries two typical poses in every direction and
        the best of the last step again, in some 100 ms."""
        fitter = BodyFitter(self._body, self._table)
        some, half = thinned(cloud, ROUGH_POINTS), thinned(cloud, POLISH_POINTS)
        starts = [*self._kept, *self._starts(cloud)]
        rough = sorted((fitter.fit(some, start, start, ROUGH) for start in starts), key=lambda fit: fit.score)
        polished = [fitter.fit(half, fit.pose, fit.pose, POLISH) for fit in rough[:KEPT]]
        polished.sort(key=lambda fit: fit.score)
        self._kept = [fit.pose for fit in polished]
        best = fitter.judge(cloud, self._kept[0])
        for limb in self._limbs if best.score > CERTAIN_SCORE else ():
            pose = search_limb(limb, best, cloud, fitter, ())
            best = fitter.fit(cloud, pose, pose, POLISH) if pose is not best.pose else best
        self._kept[0] = best.pose
        return best

    def recognises(self, fit: FitArrays, cloud: PointCloud) -> bool:
        """Whether ``cloud`` (N points, world), fitted by ``step``, shows this body and not somebody else's."""
        one_sided = np.linalg.norm(cloud.normals.mean(axis=0)) > ONE_SIDED
        return self.mismatch(fit, cloud) < (KNOWN_ONE_SIDED if one_sided else KNOWN)

    def mismatch(self, fit: FitArrays, cloud: PointCloud) -> float:
        """Mean robust distance of the cloud to the body plus that of the body's surface to the cloud, 0..2; surface
        that faces where the cloud has few normals was seen by no camera and counts less."""
        surface, offsets = self._body.surface(0), self._body.skeleton.offsets.astype(np.float64)
        R, t = forward(fit.pose.root, fit.pose.local, offsets, self._table.parents)
        ends = np.append(surface.first_point[1:], len(surface.points))
        link = np.repeat(np.arange(LINK_COUNT), ends - surface.first_point)
        rows = np.arange(0, len(link), max(len(link) // BARE_POINTS, 1))
        points = np.einsum("nij,nj->ni", R[link[rows]], surface.points[rows]) + t[link[rows]]
        ours = _direction(np.einsum("nij,nj->ni", R[link[rows]], surface.normals[rows]))
        seen = np.bincount(_direction(cloud.normals), minlength=DIRECTIONS) / len(cloud)
        there = np.bincount(ours, minlength=DIRECTIONS) / len(rows)
        ratio = seen / np.maximum(there, 1e-9)
        usual = np.percentile(ratio[there > 0.5 / DIRECTIONS], 75)
        weight = (np.clip(ratio / max(usual, 1e-9), 0.0, 1.0) ** 2)[ours]
        d2 = cKDTree(cloud.positions).query(points)[0] ** 2
        return fit.score + float(weight @ (d2 / (d2 + BARE_M**2)) / max(weight.sum(), 1e-9))

    def _starts(self, cloud: PointCloud) -> list[PoseState]:
        """The next few typical poses in every direction, the head under the cloud's top."""
        middle = np.median(cloud.positions, axis=0).astype(np.float64)
        top = float(np.percentile(cloud.positions[:, 1], 99.5))
        head = LINK_INDEX["head"]
        starts = []
        for _ in range(POSES_PER_STEP):
            local = _typical_pose(*_POSES_DEG[self._tried % len(_POSES_DEG)])
            self._tried += 1
            for heading in np.arange(HEADINGS) * 360.0 / HEADINGS:
                turned = local.copy()
                turned[0] = _rotation(1, heading)
                R, t = forward(np.zeros(3), turned, self._body.skeleton.offsets.astype(np.float64), self._table.parents)
                crown = t[head, 1] + (R[head] @ self._body.skeleton.tips[head])[1]
                starts.append(PoseState(np.array([middle[0], top - crown, middle[2]]), turned))
        return starts


def _direction(normals: Array) -> Array:
    """Which of ``DIRECTIONS`` each normal (N, 3) points to: eight around, each downwards, level and upwards."""
    around = np.floor((np.arctan2(normals[:, 0], normals[:, 2]) / np.pi + 1.0) * 4.0).astype(np.int64) % 8
    rise = (normals[:, 1] > 0.5).astype(np.int64) - (normals[:, 1] < -0.5) + 1
    level: Array = 3 * around + rise
    return level


def _typical_pose(raised: float, bent: float, thigh: float, knee: float) -> Array:
    local = np.tile(np.eye(3), (LINK_COUNT, 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        local[LINK_INDEX[f"{side}_upper_arm"]] = _rotation(2, sign * raised)
        local[LINK_INDEX[f"{side}_forearm"]] = _rotation(1, sign * bent)
        local[LINK_INDEX[f"{side}_thigh"]] = _rotation(0, -thigh)
        local[LINK_INDEX[f"{side}_shin"]] = _rotation(0, knee)
    return local


def _rotation(axis: int, degrees: float) -> Array:
    matrix: Array = quaternion.to_matrix(quaternion.from_rotation_vector(np.eye(3)[axis] * np.radians(degrees)))
    return matrix
