"""How sure a fit is of every link: what the link explains now against what it usually explains."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX, SIDES
from sender.fitting.articulated_gauss_newton import FitArrays

Array = NDArray[Any]

SEEN_POINTS = 200.0  # with fewer explained points no pose is certain
FORGETTING = 0.02  # per frame, of the usual share when a link shows less of itself, and of the usual score
FIRST_FRAMES = 10
NOISIEST = 0.22  # a score that is worse is not noise
NOISY = 0.12  # usual score of clouds whose points scatter by more than 2 cm
GOOD_RATIO, BAD_RATIO, LOST_RATIO = 1.15, 1.3, 1.6  # to the usual score
_FOLLOWS = {"neck": "head"} | {
    f"{s}_{a}": f"{s}_{b}" for s in SIDES for a, b in (("fingers", "hand"), ("toes", "foot"))
}


class FitConfidence:
    """Follows the share of the cloud that each link explains (``usual``, (L,))."""

    def __init__(self) -> None:
        self.usual = np.zeros(LINK_COUNT)

    def update(self, fit: FitArrays, count: int) -> Array:
        """Confidence (L,) float32 0..1 of each link in a ``fit`` judged on ``count`` points."""
        share = fit.explained / max(count, 1)
        self.usual = np.where(share > self.usual, share, self.usual + FORGETTING * (share - self.usual))
        seen = fit.explained / np.maximum(fit.assigned, 1.0)
        enough = np.clip(fit.explained / np.maximum(0.3 * self.usual * count, 6.0), 0.0, 1.0)
        confidence = np.clip(seen * enough, 0.0, 1.0)
        for link, leader in _FOLLOWS.items():  # too few points of their own to judge by
            confidence[LINK_INDEX[link]] = confidence[LINK_INDEX[leader]]
        return confidence.astype(np.float32)


class ScoreScale:
    """Which scores are good and which mean lost, for clouds as noisy as this person's are.

    ``good``, ``lost``: for clean clouds. The first frames after the start, when the pose is surely right, show what
    score noise alone causes; later good frames correct it slowly.
    """

    def __init__(self, good: float, lost: float) -> None:
        self._good, self._lost = good, lost
        self._usual, self._frames = 0.0, 0

    @property
    def noisy(self) -> bool:
        """Whether points scatter so much that a fit has to look further."""
        return self._usual > NOISY

    @property
    def good(self) -> float:
        """Mean robust cost below which a pose is trusted."""
        return max(self._good, GOOD_RATIO * self._usual)

    @property
    def bad(self) -> float:
        """Mean robust cost above which the whole body is looked for."""
        return max(BAD_RATIO * self._good, BAD_RATIO * self._usual)

    @property
    def lost(self) -> float:
        """Mean robust cost above which the person counts as lost."""
        return max(self._lost, LOST_RATIO * self._usual)

    def update(self, score: float) -> None:
        """One frame's score."""
        self._frames += 1
        if self._frames <= FIRST_FRAMES or score < self.good:
            share = max(1.0 / self._frames, FORGETTING)
            self._usual += share * (min(score, NOISIEST) - self._usual)

    def confidence(self, fit: FitArrays) -> float:
        """0..1 of a fit as a whole: 0 when lost."""
        sure = np.clip((self.lost - fit.score) / self.lost * 1.25, 0.0, 1.0)
        return float(sure * min(fit.explained.sum() / SEEN_POINTS, 1.0))
