"""What the receiver counts: for ``/metrics`` while it runs, and for the statistics file at its end."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from common.runtime.compute_worker import ComputeWorker
from common.runtime.config_file import dump_settings
from common.runtime.metrics import Metrics
from common.runtime.run_statistics import RunStatistics
from common.runtime.stage_timer import StageTimer
from receiver.channels_in import ReceiverChannels
from receiver.config import ReceiverSettings
from receiver.jitter_buffer import JitterBuffer
from receiver.map_maker import MapMaker
from receiver.pipeline import Shown, SkeletonToShow
from receiver.pose_maker import PoseMaker
from receiver.stream_state import StreamState

_JUDGED = ("stale", "duplicate", "old_epoch", "far_future", "lost", "not taken")


@dataclass(frozen=True, slots=True, eq=False)
class ReceiverFigures:
    """Reads the counts of the receiver's parts when asked; ``counts``: the daemon's own drops, by cause."""

    settings: ReceiverSettings
    timer: StageTimer
    statistics: RunStatistics
    channels: ReceiverChannels
    state: StreamState
    animation: ComputeWorker[SkeletonToShow, Shown]
    poses: PoseMaker
    maps: MapMaker
    jitter: JitterBuffer | None
    counts: Counter[str]

    def metrics(self) -> Metrics:
        """What ``/metrics`` shows."""
        metrics, state, channels = Metrics(), self.state, self.channels
        metrics.stages(self.timer)
        skeletons = channels.stream.skeletons.counts
        metrics.counter("skeletons_received_total", "Skeletons that were the newest", lambda: skeletons["accepted"])
        metrics.counter("skeletons_lost_total", "Gaps in the sequence", lambda: skeletons["lost"])
        about = "1 in so many skeletons is taken, since the path carries no more"
        metrics.gauge("skeleton_divisor", about, lambda: channels.skeleton_divisor)
        metrics.counter("arrived_total", "Messages, by channel", self._arrivals, "channel")
        poses = self.poses
        metrics.counter("candidate_poses_received_total", "Arrived whole", lambda: poses.received)
        metrics.counter("candidate_poses_meshed_total", "Ready to be shown", lambda: poses.meshed)
        metrics.counter("frames_shown_total", "Frames given to the viewer", lambda: state.frames_shown)
        metrics.counter("maps_decoded_total", "Residual packets that showed something newer", lambda: self.maps.made)
        metrics.gauge("live_surface", "How much the mesh on screen follows residual maps, 0 to 1", lambda: state.live)
        metrics.counter("dropped_total", "What was dropped, by cause", self.dropped)
        metrics.gauge("repository_poses", "Candidate poses held", lambda: state.repository_poses)
        metrics.gauge("offered_poses", "Poses the sender held when it was last asked", lambda: channels.offered_poses)
        jitter = self.jitter
        if jitter is not None:
            about = "How much later than at the soonest skeletons are shown"
            metrics.gauge("jitter_delay_ms", about, lambda: jitter.delay_ns / 1e6)
            metrics.counter("played_total", "Display ticks by where their pose came from", lambda: jitter.counts)
        about = "Distortion of each region of the mesh on screen (DISPOSE Eq. 1)"
        metrics.gauge("region_sigma", about, lambda: state.region_sigma, "region")
        return metrics

    def dropped(self) -> dict[str, float]:
        """What was dropped, by cause."""
        channels = self.channels
        refused = {
            f"{name} {cause}": count
            for name, subscriber in channels.subscribers.items()
            for cause, count in subscriber.counts.items()
        }
        return {
            "animation busy": self.animation.dropped,
            "skeleton not fresh": channels.freshness.stale,
            **{f"skeleton {cause}": channels.stream.skeletons.counts[cause] for cause in _JUDGED},
            **refused,
            **{f"chunk {cause}": count for cause, count in channels.stream.assembler.counts.items()},
            **{f"residual {cause}": count for cause, count in self.maps.counts.items()},
            **channels.counts,
            **channels.stream.counts,
            **(self.counts + self.poses.counts),
        }

    def _arrivals(self) -> dict[str, float]:
        return {name: subscriber.arrivals for name, subscriber in self.channels.subscribers.items()}

    def of_the_run(self, frames_rendered: int | None) -> dict[str, Any]:
        """Everything worth keeping of the run; ``frames_rendered``: None where all that is shown is."""
        shown, subscribers = self.state.frames_shown, self.channels.subscribers
        return self.statistics.figures() | {
            "settings": dump_settings(self.settings),
            "skeletons_received": self.channels.stream.skeletons.counts["accepted"],
            "frames_shown": shown,
            "frames_rendered": shown if frames_rendered is None else frames_rendered,
            "time_to_first_body_s": self._time_to_first_body_s(),
            "repository_poses": self.state.repository_poses,
            "skeleton_bytes": subscribers["skeleton"].arrived_bytes if subscribers else 0,
            "bulk_bytes": subscribers["bulk"].arrived_bytes if subscribers else 0,
            "dropped": self.dropped(),
        }

    def _time_to_first_body_s(self) -> float | None:
        """From the very first skeleton's arrival to the first mesh shown."""
        begin_ns, end_ns = self.channels.first_skeleton_ns, self.state.first_body_ns
        return None if begin_ns is None or end_ns is None else (end_ns - begin_ns) / 1e9
