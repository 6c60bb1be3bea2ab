"""Finding a known person in mid-motion: many starts, each polished by Gauss–Newton, carried on over a few frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX
from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from sender.fitting.articulated_gauss_newton import FitArrays, PoseState, Schedule, fit_pose, forward, judge_pose
from sender.fitting.body_model import BodyModel
from sender.fitting.joint_limits import JointTable

Array = NDArray[Any]

HEADINGS = 8
ROUGH = Schedule(10, 0.40, 0.08, 0.3, 6.0, 0.5)
POLISH = Schedule(8, 0.15, 0.06, 0.1, 6.0, 0.5)
KEPT = 3
_ARMS_DEG = ((-75.0, -15.0), (-40.0, -30.0), (0.0, -10.0), (-60.0, -110.0))  # upper arm raised, elbow bent


class WholeBodySearch:
    """Looks for ``body`` in clouds; ``step`` is called with each frame until its score is good enough."""

    def __init__(self, body: BodyModel, table: JointTable) -> None:
        self._body, self._table = body, table
        self._kept: list[PoseState] = []

    def step(self, cloud: PointCloud) -> FitArrays:
        """The best pose so far for ``cloud`` (N points, world); costs about 100 ms."""
        some = _thinned(cloud, 250)
        offsets = self._body.skeleton.offsets.astype(np.float64)
        surface = self._body.surface()
        rough = [
            fit_pose(some.positions, some.normals, start, start, offsets, surface, self._table, ROUGH)
            for start in [*self._kept, *self._starts(cloud)]
        ]
        rough.sort(key=lambda fit: fit.score)
        half = _thinned(cloud, 1000)
        polished = [
            fit_pose(half.positions, half.normals, fit.pose, fit.pose, offsets, surface, self._table, POLISH)
            for fit in rough[:KEPT]
        ]
        polished.sort(key=lambda fit: fit.score)
        self._kept = [fit.pose for fit in polished]
        return judge_pose(cloud.positions, cloud.normals, self._kept[0], offsets, surface, self._table)

    def _starts(self, cloud: PointCloud) -> list[PoseState]:
        """Standing upright under the cloud's top, in every direction, with the arms in a few places."""
        middle = np.median(cloud.positions, axis=0).astype(np.float64)
        R, t = forward(np.zeros(3), np.tile(np.eye(3), (LINK_COUNT, 1, 1)), self._offsets(), self._table.parents)
        head = t[LINK_INDEX["head"], 1] + float(self._body.skeleton.tips[LINK_INDEX["head"], 1])
        top = float(np.percentile(cloud.positions[:, 1], 99.5))
        root = np.array([middle[0], top - head, middle[2]])
        starts = []
        for raised, bent in _ARMS_DEG:
            local = np.tile(np.eye(3), (LINK_COUNT, 1, 1))
            for side, sign in (("left", 1.0), ("right", -1.0)):
                local[LINK_INDEX[f"{side}_upper_arm"]] = _rotation(2, sign * raised)
                local[LINK_INDEX[f"{side}_forearm"]] = _rotation(1, sign * bent)
            for heading in np.arange(HEADINGS) * 360.0 / HEADINGS:
                turned = local.copy()
                turned[0] = _rotation(1, heading)
                starts.append(PoseState(root.copy(), turned))
        return starts

    def _offsets(self) -> Array:
        return self._body.skeleton.offsets.astype(np.float64)


def _rotation(axis: int, degrees: float) -> Array:
    matrix: Array = quaternion.to_matrix(quaternion.from_rotation_vector(np.eye(3)[axis] * np.radians(degrees)))
    return matrix


def _thinned(cloud: PointCloud, count: int) -> PointCloud:
    step = max(len(cloud) // count, 1)
    return PointCloud(cloud.positions[::step].copy(), cloud.normals[::step].copy(), cloud.colours[::step].copy())
