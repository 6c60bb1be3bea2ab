"""The body model goes on learning while tracking is good: surface never seen before, and joint centres.

The work is dealt out over the frames, so that no frame waits long: a cloud is learned by some of the links, in another
frame one link's grid is renewed, in another the joint centres are observed.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.geometry.point_cloud import PointCloud
from sender.fitting.articulated_gauss_newton import FitArrays
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.body_model import BodyModel
from sender.fitting.joint_centres import JointCentres
from sender.fitting.joint_limits import JointTable

Array = NDArray[Any]

LEARN_TURNS = 3  # a cloud's points are learned for every third link, then for the next third of another cloud
CERTAIN = 0.8  # confidence of a link from which its surface is learned
OBSERVED_PER_STEP = 8
LEAST_MOVE_M = 0.002  # joint centres that are nearly right stay: sizes change rarely, and stop changing


class BodyLearning:
    """What one body still learns. ``building_until_ns``: until then its surface has hardly been seen, and all points
    teach it; later only those that it does not explain. ``start_sigma_m``: of the joint centres it started with."""

    def __init__(self, body: BodyModel, table: JointTable, building_until_ns: int, start_sigma_m: float) -> None:
        self._body, self._table = body, table
        self._building_until_ns = building_until_ns
        self._centres = JointCentres(start_sigma_m)
        self._frames = 0

    def building(self, capture_ns: int) -> bool:
        """Whether the surface has hardly been seen yet."""
        return capture_ns < self._building_until_ns

    def frame(self, fit: FitArrays, pose: SkeletonPose, cloud: PointCloud, judged: PointCloud, capture_ns: int) -> None:
        """The share of the work for one frame that fits well; ``judged``: the points of ``fit.owner``."""
        self._frames += 1
        building = self.building(capture_ns)
        if self._frames % 2 == 1:
            if building or self._frames % 4 == 1:
                self._body.surface(1)
            else:
                self._observe(judged, fit)
        elif building:
            T_world_link = forward_kinematics(self._body.skeleton, pose)
            self._body.add(cloud, T_world_link, self._frames // 2 % LEARN_TURNS, LEARN_TURNS)
        elif self._frames % 4 == 2:
            new = fit.owner < 0
            unseen = PointCloud(judged.positions[new], judged.normals[new], judged.colours[new])
            T_world_link = forward_kinematics(self._body.skeleton, pose)
            self._body.add_unseen(unseen, T_world_link, pose.confidence >= CERTAIN)

    def _observe(self, cloud: PointCloud, fit: FitArrays) -> None:
        self._centres.observe(cloud, fit.pose, BodyFitter(self._body, self._table))
        if self._centres.observed % OBSERVED_PER_STEP == 0:
            correction = self._centres.correction(LEAST_MOVE_M)
            if correction is not None:
                self._body.move_joints(*correction)
