"""The one interface of all pose trackers: a cloud in, a pose and how it went out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from common.body.skeleton import LINK_COUNT, Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.geometry.point_cloud import PointCloud
from sender.fitting.body_model import BodyModel

MINIMUM_POINTS = 40  # fewer are nobody


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """One frame's fit. ``inliers``: share of the cloud's points near the fitted surface, 0..1. ``rms_m``: RMS
    point-to-surface distance of the inliers [m]. ``confidence``: 0..1, the fit as a whole."""

    skeleton: Skeleton
    pose: SkeletonPose
    converged: bool
    iterations: int
    inliers: float
    rms_m: float
    confidence: float


class Tracker(Protocol):
    """Follows one person. ``track`` returns None while no person has been found yet (``status`` says why).
    ``start_from`` begins with sizes and pose known from elsewhere and the cloud they belong to. ``body``: the person's
    surface as learned so far, for a tracker that learns one: worth saving for a restart."""

    @property
    def status(self) -> str: ...
    @property
    def body(self) -> BodyModel | None: ...
    def start_from(self, skeleton: Skeleton, pose: SkeletonPose, cloud: PointCloud, capture_ns: int) -> FitResult: ...
    def track(self, cloud: PointCloud, capture_ns: int) -> FitResult | None: ...


def untrusted(last: FitResult) -> FitResult:
    """The last pose when nothing was seen of it: no joint is to be trusted."""
    pose = SkeletonPose(last.pose.root_position, last.pose.rotations, np.zeros(LINK_COUNT, np.float32))
    return FitResult(last.skeleton, pose, False, 0, 0.0, 0.0, 0.0)
