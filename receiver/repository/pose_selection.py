"""Which pose to animate for a skeleton: the search by distortion score, and the hold (DISPOSE §5.3–5.4, §8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from common.body.body_regions import default_region_weights
from common.body.distortion_score import START_THRESHOLD, SessionThreshold, distortion_score
from common.body.rigged_mesh import RiggedMesh


@dataclass(frozen=True, slots=True)
class SelectionSettings:
    """``search``: stop at the first σ below the session's threshold, or look at all poses. ``hold``: keep the pose on
    screen until its σ passes the threshold. ``memory_frames``: of the threshold. A frame is withheld when its best σ
    exceeds ``withhold_factor`` × the threshold, at most ``withhold_frames`` in a row: longer is not a tracker's slip
    but a posture of which there is no pose."""

    search: Literal["threshold", "exhaustive"] = "threshold"
    hold: bool = True
    start_threshold: float = START_THRESHOLD
    memory_frames: int = 300
    withhold_factor: float = 6.0
    withhold_frames: int = 15

    def __post_init__(self) -> None:
        if self.search not in ("threshold", "exhaustive"):
            raise ValueError(f"search {self.search!r}: it is threshold or exhaustive")


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The chosen pose and how: its σ, the threshold then, how many poses were scored, whether the pose on screen was
    ``held``, and whether σ is so high that the frame should be ``withheld`` and the last good one stay."""

    mesh: RiggedMesh
    sigma: float
    threshold: float
    scored: int
    held: bool
    withheld: bool


class PoseSelector:
    """Selects frame by frame for one person; learns the session's threshold on the way."""

    def __init__(
        self, settings: SelectionSettings | None = None, region_weights: NDArray[np.float32] | None = None
    ) -> None:
        self._settings = settings or SelectionSettings()
        self._weights = default_region_weights() if region_weights is None else region_weights
        self._on_screen: int | None = None
        self._withheld_frames = 0
        self.threshold = SessionThreshold(self._settings.start_threshold, self._settings.memory_frames)

    def select(self, poses: Sequence[RiggedMesh], T_world_link: NDArray[np.float32]) -> Selection | None:
        """Choose among ``poses``, most used first, for the skeleton's links (L, 4, 4); None without any pose."""
        if not poses:
            self._on_screen = None
            return None
        limit = self.threshold.value
        on_screen = next((pose for pose in poses if pose.pose_id == self._on_screen), None)
        if on_screen is not None and self._settings.hold:  # first in line: it is kept if it is good enough
            poses = [on_screen, *(pose for pose in poses if pose is not on_screen)]
        mesh, sigma, scored, early = self._search(poses, T_world_link, limit, on_screen)
        held = self._settings.hold and early and mesh is on_screen
        withheld = self._withhold(sigma, limit)
        self.threshold.follow(sigma)
        self._on_screen = mesh.pose_id
        return Selection(mesh, sigma, limit, scored, held, withheld)

    def _search(
        self, poses: Sequence[RiggedMesh], T_world_link: NDArray[np.float32], limit: float, on_screen: RiggedMesh | None
    ) -> tuple[RiggedMesh, float, int, bool]:
        """The pose, its σ, how many were scored, and whether the search stopped early."""
        best, best_sigma = poses[0], float("inf")
        for scored, pose in enumerate(poses, start=1):
            sigma = distortion_score(pose, T_world_link, self._weights)
            if sigma < best_sigma:
                best, best_sigma = pose, sigma
            held = self._settings.hold and pose is on_screen
            if sigma < limit and (held or self._settings.search == "threshold"):
                return pose, sigma, scored, True
        return best, best_sigma, len(poses), False

    def _withhold(self, sigma: float, limit: float) -> bool:
        """DISPOSE §8, once the threshold knows the session."""
        known = self.threshold.frames >= self._settings.withhold_frames
        high = known and sigma > self._settings.withhold_factor * limit
        self._withheld_frames = self._withheld_frames + 1 if high else 0
        return high and self._withheld_frames <= self._settings.withhold_frames
