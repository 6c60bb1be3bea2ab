"""What the receiver knows of its stream now, and the rates a person wants to see beside the picture."""

from __future__ import annotations

import logging
import math
from collections import deque

from common.body.body_regions import REGION_NAMES
from common.runtime.clock import Clock
from receiver.viewer.viewer import ConnectionState, ShownFrame, ViewerStatus

log = logging.getLogger(__name__)

LOST_AFTER_NS = 1_000_000_000  # without a skeleton
RATE_SPAN_NS = 2_000_000_000
RIVAL_SKELETONS = 15  # of another run within that span: more than what was on its way when a sender restarted


class StreamState:
    """Fed by the daemon's loop; ``status`` sums it up for the viewer."""

    def __init__(self, clock: Clock) -> None:
        self.frame: ShownFrame | None = None
        self.frames_shown = 0
        self.repository_poses = 0
        self.first_body_ns: int | None = None  # when the first mesh was shown
        self._clock = clock
        self._sender_present = False
        self._skeleton_ns: int | None = None
        self._skeletons = 0
        # time, skeletons, skeleton bytes, bulk bytes, skeletons of other runs
        self._history: deque[tuple[int, int, int, int, int]] = deque()
        self._rival = False

    def presence(self, there: bool) -> None:
        """The sender appeared or disappeared."""
        self._sender_present = there

    def skeleton(self) -> None:
        """A skeleton to show arrived."""
        self._skeletons += 1
        self._skeleton_ns = self._clock.now_ns()

    def shown(self, frame: ShownFrame, repository_poses: int) -> None:
        """A frame went to the viewer."""
        self.frame = frame
        self.frames_shown += 1
        self.repository_poses = repository_poses
        if self.first_body_ns is None and frame.pose_id is not None:
            self.first_body_ns = self._clock.now_ns()

    @property
    def receiving(self) -> bool:
        return self._skeleton_ns is not None and self._clock.now_ns() - self._skeleton_ns < LOST_AFTER_NS

    def status(
        self,
        age_ms: float | None,
        skeleton_bytes: int,
        bulk_bytes: int,
        foreign_skeletons: int = 0,
        skeleton_divisor: int = 1,
    ) -> ViewerStatus:
        """The figures now. ``skeleton_bytes``, ``bulk_bytes`` and ``foreign_skeletons``, which are of a run of the
        sender that is over for us: arrived in all so far; 1 in ``skeleton_divisor`` skeletons is taken. Rates cover two
        seconds."""
        now_ns = self._clock.now_ns()
        self._history.append((now_ns, self._skeletons, skeleton_bytes, bulk_bytes, foreign_skeletons))
        while now_ns - self._history[0][0] > RATE_SPAN_NS:
            self._history.popleft()
        then_ns, skeletons, then_skeleton_bytes, then_bulk_bytes, then_foreign = self._history[0]
        self._note_rival(foreign_skeletons - then_foreign)
        span_s = max((now_ns - then_ns) / 1e9, 1e-3)
        connection, detail = self._connection(skeleton_divisor)
        frame = self.frame
        has_pose = frame is not None and frame.pose_id is not None
        return ViewerStatus(
            connection=connection,
            detail=detail,
            frame_rate_hz=(self._skeletons - skeletons) / span_s,
            pose_age_ms=age_ms,
            skeleton_bps=8 * (skeleton_bytes - then_skeleton_bytes) / span_s,
            bulk_bps=8 * (bulk_bytes - then_bulk_bytes) / span_s,
            repository_poses=self.repository_poses,
            chosen_pose=frame.pose_id if frame is not None else None,
            sigma=frame.sigma if frame is not None and has_pose else None,
            region_sigma=self.region_sigma,
        )

    @property
    def live(self) -> float:
        """How much the mesh on screen follows maps, 0..1."""
        return 0.0 if self.frame is None else self.frame.live

    @property
    def region_sigma(self) -> dict[str, float]:
        """σ_r of the pose on screen by region, without those that were not seen."""
        if self.frame is None or self.frame.region_sigma is None:
            return {}
        named = zip(REGION_NAMES, self.frame.region_sigma.tolist(), strict=True)
        return {name: sigma for name, sigma in named if math.isfinite(sigma)}

    def _note_rival(self, foreign_skeletons: int) -> None:
        rival, self._rival = self._rival, foreign_skeletons >= RIVAL_SKELETONS
        if self._rival and not rival:
            log.warning("two senders use this site's and person's name: the one that came last is shown")

    def _connection(self, skeleton_divisor: int) -> tuple[ConnectionState, str]:
        if self.receiving and self._rival:
            return ConnectionState.RECEIVING, "two senders use this name, and the one that came last is shown"
        if self.receiving and skeleton_divisor > 1:
            return ConnectionState.RECEIVING, f"1 in {skeleton_divisor} skeletons, since the path carries no more"
        if self.receiving:
            waiting = self.frame is None or self.frame.pose_id is None
            return ConnectionState.RECEIVING, "skeleton only, the first mesh is on its way" if waiting else ""
        if self._sender_present:
            return ConnectionState.WAITING, "the sender is there, but nobody is in view yet"
        if self._skeleton_ns is None:
            return ConnectionState.WAITING, ""
        return ConnectionState.LOST, "The sender has left, or cannot be reached. This page waits for it."
