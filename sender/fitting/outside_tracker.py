"""A sensor's own skeletons in place of our tracker: merged, measured, and turned into a pose of the link tree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.body.skeleton import NAMED_JOINT_LINKS
from sender.capture.outside_skeleton import Instant, Sensor
from sender.fitting.outside_pose import OutsidePose
from sender.fitting.outside_sizes import OutsideSizes
from sender.fitting.skeleton_merging import SEEN, SkeletonMerger
from sender.fitting.tracker import FitResult, untrusted


class OutsideTracker:
    """Follows the person that ``sensors`` see; their skeletons are all of one ``kind`` (key of ``JOINTS_BY_KIND``)."""

    def __init__(self, kind: str, sensors: Sequence[Sensor]) -> None:
        self._merger = SkeletonMerger(kind, sensors)
        self._kind = kind
        self._sizes = OutsideSizes(kind)
        self._people = self._merger.people
        self._last: FitResult | None = None
        self._pose = OutsidePose(kind)
        self.status = "waiting for the sensors' skeletons"

    def track(self, instant: Instant) -> FitResult | None:
        """The person at an instant, from the skeletons of one sensor or more; None before a whole trunk was seen,
        and while it is not, the last pose at confidence 0.

        ``inliers``: share of the joints that a sensor tracks; ``rms_m``: between the joints and the sensors' word.

        Raises:
            ValueError: a skeleton of another kind, or of a sensor there is not.
        """
        merged = self._merger.merge(instant)
        self.status = f"merging sensors' skeletons: {len(instant)} of them"
        if not np.isfinite(merged.joints[self._pose.trunk_rows]).all():
            self.status = "the sensors do not see a whole trunk"
            return None if self._last is None else untrusted(self._last)
        if self._merger.people != self._people:  # another person's sizes are learned from nothing
            self._sizes, self._people = OutsideSizes(self._kind), self._merger.people
        tracked = merged.confidence > SEEN
        skeleton = self._sizes.update(np.where(tracked[:, None], merged.joints, np.nan))
        pose = self._pose.fit(skeleton, merged.joints, merged.confidence)
        self._last = FitResult(
            skeleton=skeleton,
            pose=pose,
            converged=bool(tracked.any()),
            iterations=1,
            inliers=float(tracked.mean()),
            rms_m=merged.spread_m,
            confidence=float(pose.confidence[NAMED_JOINT_LINKS].mean()),
        )
        return self._last
