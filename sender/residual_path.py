"""The third layer: every frame's points → residual packets, at the level that bandwidth allows (Lien §5.2).

Behind the fast path as candidate poses are, on a thread of its own; a frame it has no time for is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from common.geometry.camera_model import Camera
from common.runtime.stage_timer import StageTimer
from common.wire.residual_packet import decode_residual_header
from common.wire.residual_video import frame_count, require_video
from sender.config import ResidualStreamSettings
from sender.pipeline import StreamIdentity, TrackedFrame
from sender.reconstruction.foreground_points import PointSampler
from sender.residual_encoder import LevelControl, ResidualEncoder, ResidualFrame, ResidualSettings

VOXEL_M = 0.012  # of the points: a cell of the full maps
SMOOTHING_NS = 1_000_000_000  # of the budget: each change of level costs a key
INTERVAL_MEMORY = 0.1  # weight of the newest interval between two frames
LONGEST_INTERVAL_NS = 500_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """A packet. ``sequence`` is its number, ``key`` that of the key it needs: its own if it is one. ``level`` [%]."""

    sequence: int
    key: int
    data: bytes
    level: float


class ResidualPath:
    """``process`` is one thread's own; ``note_budget`` and ``request_key`` may be called from another.

    Raises:
        VideoUnavailable: frames are to be coded as video, and PyAV is not installed.
    """

    def __init__(
        self,
        identity: StreamIdentity,
        cameras: Sequence[Camera],
        frame_rate_hz: float,
        settings: ResidualStreamSettings,
        timer: StageTimer,
    ) -> None:
        self._sampler = PointSampler(cameras, settings.points, voxel_m=VOXEL_M)
        if settings.video_frames:
            require_video()
        coding = ResidualSettings(points=settings.points, video_frames=settings.video_frames)
        self._encoder = ResidualEncoder(identity.person, identity.epoch, coding)
        self._control = LevelControl()
        self._timer = timer
        self._budget_bytes_s = 0.0
        self._interval_ns = 1e9 / frame_rate_hz
        self._last_ns: int | None = None
        self._smoothed = 0.0
        self._key_wanted = False
        self._together = True

    def note_budget(self, bytes_per_s: float, for_points: bool = True) -> None:
        """What residuals may take. ``for_points``: those of every frame are wanted; a few, for a live surface, do not
        go in groups, which they would take too long to fill."""
        self._budget_bytes_s = bytes_per_s
        self._together = for_points

    def request_key(self) -> None:
        """Somebody has none."""
        self._key_wanted = True

    def process(self, tracked: TrackedFrame) -> Residual | None:
        """The packet of a frame or of the group it completes; None where nobody is seen, the level is 0 and the model
        is out, or the group is not complete."""
        if not tracked.views or tracked.skeleton is None or tracked.T_world_link is None:
            return None
        level = self._control.level(self._budget(tracked.capture_ns) * self._interval_ns / 1e9)
        if self._key_wanted:
            self._key_wanted = False
            self._encoder.request_key()
        with self._timer.stage("residual points"):
            cloud = self._sampler.points(tracked.views)
        with self._timer.stage("residual maps"):
            frame = ResidualFrame(
                tracked.skeleton,
                tracked.body_revision,
                tracked.T_world_link,
                tracked.sequence,
                tracked.capture_ns,
                cloud,
            )
            data = self._encoder.encode(frame, level, self._together)
        if data is None:
            return None
        header = decode_residual_header(data)
        frames = frame_count(data)
        self._control.coded(header.level, len(data) / frames, frames)
        return Residual(header.sequence, header.reference, data, header.level)

    def _budget(self, capture_ns: int) -> float:
        """The smoothed budget; takes note of how often frames come."""
        passed_ns = None if self._last_ns is None else capture_ns - self._last_ns
        self._last_ns = capture_ns
        if passed_ns is None or not 0 < passed_ns < LONGEST_INTERVAL_NS:  # the first frame, or the first after a pause
            self._smoothed = self._budget_bytes_s
            return self._smoothed
        self._interval_ns += INTERVAL_MEMORY * (passed_ns - self._interval_ns)
        self._smoothed += (self._budget_bytes_s - self._smoothed) * min(passed_ns / SMOOTHING_NS, 1.0)
        return self._smoothed
