"""Where a person is expected next, and when one that is not seen well counts as lost: what all trackers share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sender.fitting.articulated_gauss_newton import PoseState
from sender.fitting.joint_limits import turned_on

FRAME_NS = 1e9 / 30.0
FARTHEST = 3.0  # times the last step: what came after a pause is not extrapolated further


def predicted_poses(
    now: PoseState,
    before: PoseState | None,
    times_ns: tuple[int, int],
    capture_ns: int,
    shares: Sequence[float],
    twist_axis: NDArray[Any],
) -> list[PoseState]:
    """The pose ``now`` moved on at each of ``shares`` of its velocity, scaled to the time passed.

    ``times_ns``: of ``now`` and of the pose ``before``. Twists (about ``twist_axis`` (L,)) stay: a straight limb does
    not show its twist, so its velocity is noise. Without a velocity there is one pose: ``now``.
    """
    past_ns = times_ns[0] - times_ns[1]
    if before is None or past_ns <= 0:
        return [now]
    ahead = np.clip((capture_ns - times_ns[0]) / past_ns, 0.0, FARTHEST) * np.array(shares)
    turns = turned_on(before.local, now.local, ahead, twist_axis)
    roots = now.root + ahead[:, None] * (now.root - before.root)
    return [PoseState(root, local) for root, local in zip(roots, turns, strict=True)]


class LossTimer:
    """Says a person is lost once they were not seen well for ``lost_s``."""

    def __init__(self, lost_s: float) -> None:
        self._lost_s = lost_s
        self._good_ns = 0

    def seen_well(self, capture_ns: int) -> None:
        """The person was where the pose has them."""
        self._good_ns = capture_ns

    def lost(self, capture_ns: int) -> bool:
        """Whether it was too long ago."""
        return capture_ns - self._good_ns > self._lost_s * 1e9
