"""Which pose to animate for a skeleton: the search by distortion score, and what is kept (DISPOSE §5.3–5.4, §8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from common.body.distortion_score import START_THRESHOLD, SessionThreshold


class Poses(Protocol):
    """What is searched: a ``PoseRepository``."""

    def __contains__(self, pose_id: int) -> bool: ...
    def by_use(self) -> list[int]: ...
    def scores(
        self, pose_ids: list[int], T_world_link: NDArray[np.float32], limit: float = 0.0, best: int = 0
    ) -> NDArray[np.float32]: ...


@dataclass(frozen=True, slots=True)
class SelectionSettings:
    """``search``: stop at the first σ below the session's threshold, or look at all poses. ``hold``: keep the pose on
    screen until its σ passes the threshold (the paper). ``hysteresis``: keep it while another's σ is not lower by this
    share. ``blended``: a picture is the mean of so many of the least distorted poses; 1: of the chosen one alone (the
    paper). ``memory_frames``: of the threshold. A frame is withheld when its best σ exceeds ``withhold_factor`` × the
    threshold (0: never), at most ``withhold_frames`` in a row: longer is not a tracker's slip but a posture of which
    there is no pose."""

    search: Literal["threshold", "exhaustive"] = "exhaustive"
    hold: bool = False
    hysteresis: float = 0.0
    blended: int = 5
    start_threshold: float = START_THRESHOLD
    memory_frames: int = 300
    withhold_factor: float = 6.0
    withhold_frames: int = 15

    def __post_init__(self) -> None:
        if self.search not in ("threshold", "exhaustive"):
            raise ValueError(f"search {self.search!r}: it is threshold or exhaustive")
        if self.blended < 1:
            raise ValueError(f"blended: {self.blended} poses make no picture")


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The chosen pose and how: its σ, the threshold then, how many poses were scored, whether the pose on screen was
    ``held``, and whether σ is so high that the frame should be ``withheld`` and the last good one stay. ``others``: the
    next best of those scored, to blend it with."""

    pose_id: int
    sigma: float
    threshold: float
    scored: int
    held: bool
    withheld: bool
    others: tuple[int, ...] = ()


class PoseSelector:
    """Selects frame by frame for one person; learns the session's threshold on the way."""

    def __init__(self, settings: SelectionSettings | None = None) -> None:
        self._settings = settings or SelectionSettings()
        self._on_screen: int | None = None
        self._withheld_frames = 0
        self.threshold = SessionThreshold(self._settings.start_threshold, self._settings.memory_frames)

    def select(self, poses: Poses, T_world_link: NDArray[np.float32]) -> Selection | None:
        """Choose among ``poses`` for the skeleton's links (L, 4, 4); None without any pose."""
        ids = poses.by_use()
        if not ids:
            self._on_screen = None
            return None
        limit = self.threshold.value
        on_screen = self._on_screen if self._on_screen in ids else None
        if on_screen is not None:  # first in line
            ids = [on_screen, *(pose_id for pose_id in ids if pose_id != on_screen)]
        order, sigma, scored, held = self._search(poses, ids, T_world_link, limit, on_screen)
        pose_id, others = order[0], tuple(order[1 : self._settings.blended])
        withheld = self._withhold(sigma, limit)
        self.threshold.follow(sigma)
        if not withheld:
            self._on_screen = pose_id
        return Selection(pose_id, sigma, limit, scored, held, withheld, others)

    def _search(
        self, poses: Poses, ids: list[int], T_world_link: NDArray[np.float32], limit: float, on_screen: int | None
    ) -> tuple[list[int], float, int, bool]:
        """The pose and after it the others scored, best first; its σ, how many were scored, and whether it is the one
        on screen though another might be better."""
        settings = self._settings
        if settings.hold and on_screen is not None:
            sigma = float(poses.scores(ids[:1], T_world_link)[0])
            if sigma < limit:
                return [on_screen], sigma, 1, True
        stop_below = limit if settings.search == "threshold" else 0.0
        sigmas = poses.scores(ids, T_world_link, stop_below, settings.blended)
        best = int(np.argmin(sigmas))
        kept = on_screen is not None and sigmas[0] * (1 - settings.hysteresis) <= sigmas[best]
        chosen = 0 if kept else best
        order = [ids[chosen], *(ids[n] for n in np.argsort(sigmas, kind="stable") if n != chosen)]
        return order, float(sigmas[chosen]), len(sigmas), kept and best > 0

    def _withhold(self, sigma: float, limit: float) -> bool:
        """DISPOSE §8, once the threshold knows the session."""
        factor = self._settings.withhold_factor
        known = self.threshold.frames >= self._settings.withhold_frames
        high = factor > 0 and known and sigma > factor * limit
        self._withheld_frames = self._withheld_frames + 1 if high else 0
        return high and self._withheld_frames <= self._settings.withhold_frames
