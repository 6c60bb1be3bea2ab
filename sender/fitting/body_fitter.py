"""Gauss–Newton bound to one person: the body's surface, sizes and joint table in one hand."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.geometry.point_cloud import PointCloud
from sender.fitting.articulated_gauss_newton import FitArrays, PoseState, Schedule, fit_pose, judge_pose
from sender.fitting.body_model import BodyModel
from sender.fitting.joint_limits import JointTable
from sender.fitting.surface_matching import tints

Array = NDArray[Any]


class BodyFitter:
    """Fits poses of ``body`` as its surface is now; grids that are out of date stay so.

    ``offsets`` (L, 3) float64 [m]: joints in their parents' frames.
    """

    def __init__(self, body: BodyModel, table: JointTable) -> None:
        self.offsets: Array = body.skeleton.offsets.astype(np.float64)
        self.surface = body.surface(0)
        self.table = table

    def move(self, cloud: PointCloud, start: PoseState, predicted: PoseState, plan: Schedule) -> PoseState:
        """``fit_pose`` of this body."""
        return fit_pose(
            cloud.positions, cloud.normals, tints(cloud.colours), start, predicted, self.offsets, self.surface,
            self.table, plan,
        )  # fmt: skip

    def judge(self, cloud: PointCloud, state: PoseState) -> FitArrays:
        """``judge_pose`` of this body."""
        return judge_pose(
            cloud.positions, cloud.normals, tints(cloud.colours), state, self.offsets, self.surface,
            self.table.parents,
        )  # fmt: skip

    def fit(self, cloud: PointCloud, start: PoseState, predicted: PoseState, plan: Schedule) -> FitArrays:
        """Moved, then judged on the same points."""
        return self.judge(cloud, self.move(cloud, start, predicted, plan))
