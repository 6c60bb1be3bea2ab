"""One run of a sender over one open source: cameras in, skeletons and candidate poses out.

The capture thread feeds the fitting thread (newest set wins), whose result the loop publishes at once. The loop hands
some frames on to the candidate thread, and what that finds to the mesh scheduler. Nothing queues.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, suppress
from pathlib import Path
from typing import Any

from common.runtime.clock import MonotonicClock
from common.runtime.compute_worker import ComputeWorker
from common.runtime.config_file import dump_settings
from common.runtime.daemon import Daemon, DaemonError
from common.runtime.metrics import Health, Metrics
from common.runtime.run_statistics import RunStatistics, write_statistics
from common.runtime.stage_timer import StageTimer
from common.transport.zenoh_session import ZenohSession
from common.wire.residual_video import VideoUnavailable
from sender.body_store import BodyStore
from sender.candidate_poses.candidate_pace import CandidatePace
from sender.candidate_poses.mesh_scheduler import MeshScheduler, SendRecord
from sender.capture.capture_thread import CaptureThread
from sender.capture.frame_set import CaptureError, FrameSet, FrameSource
from sender.capture.open_source import open_source
from sender.capture.virtual_rig import VirtualRig
from sender.channels_out import SenderChannels
from sender.config import SenderSettings
from sender.fitting.body_model import BodyModel
from sender.fitting.open_tracker import ignored_settings, open_tracker
from sender.fitting.particle_weights_opencl import OpenClUnavailable
from sender.open_path import open_skeleton_path, open_synchronizer, outside_tracker
from sender.pipeline import CandidatePath, Candidates, StreamIdentity, TrackedFrame
from sender.receiver_links import ReceiverLinks
from sender.rehearsal import rehearse_candidates, rehearse_residuals, rehearse_start
from sender.residual_path import Residual, ResidualPath
from sender.self_view import SelfView
from sender.send_log import SendLog

log = logging.getLogger(__name__)

FIRST_SAVE_NS = 3_000_000_000  # after the first skeleton: by then the body has been seen from all sides
SAVE_EVERY_NS = 30_000_000_000
LIVE_INTERVAL_NS = 120_000_000  # of residual maps that only bring meshes alive: few and fine, as they age little
HTTP_WAITS_S = 3.0  # at most, for the first pose: what serves it takes as long to load as many kernels
LAST_WORDS_S = 0.5  # after the last frame of a recording, for what is still on its way


async def run_stream(
    settings: SenderSettings, session: ZenohSession, daemon: Daemon, self_view: SelfView | None
) -> None:
    """Capture and send until the source ends.

    Raises:
        DaemonError: a camera, port or file that cannot be used; the message says which.
    """
    store = BodyStore(settings.state_folder, settings.site, settings.person)
    body = store.load()
    try:
        source = await asyncio.to_thread(open_source, settings.capture)
        try:
            stream = Stream(settings, source, session, store, body, self_view)
            try:
                await stream.run(daemon)
            finally:
                stream.close()
        finally:
            await asyncio.to_thread(source.close)
    except CaptureError as error:
        raise DaemonError(str(error)) from error
    except VideoUnavailable as error:
        raise DaemonError(f"[residuals] video_frames: {error}") from error
    except OpenClUnavailable as error:
        raise DaemonError(f'[tracking] weights = "opencl": {error}') from error


class Stream:
    """One run over one open source."""

    def __init__(
        self,
        settings: SenderSettings,
        source: FrameSource,
        session: ZenohSession,
        store: BodyStore,
        body: BodyModel | None,
        self_view: SelfView | None,
    ) -> None:
        self._settings = settings
        self._source = source
        self._store = store
        self._clock = clock = MonotonicClock()
        self._health = Health()
        self._self_view = self_view
        self._timer = StageTimer(clock)
        self._statistics = RunStatistics(self._timer)
        identity = StreamIdentity(settings.person, secrets.randbits(32))
        for sentence in ignored_settings(settings.tracking.tracker, body, settings.tracking.weights):
            log.warning("tracker: %s", sentence)
        self._tracker = open_tracker(settings.tracking.tracker, body, settings.tracking.weights)
        self._outside = outside_tracker(source)
        self._skeletons = open_skeleton_path(
            identity, source, settings.tracking, self._tracker, self._outside, self._timer, clock
        )
        self._candidates = CandidatePath(identity, settings.poses, self._timer)
        self._residuals = ResidualPath(identity, source.cameras, source.frame_rate_hz, settings.residuals, self._timer)
        self._scheduler = MeshScheduler()
        self._send_log = _open_send_log(settings.poses.send_log)
        self._channels = SenderChannels(session, settings.site, settings.person, clock)
        self._links = ReceiverLinks(
            identity.epoch,
            self._scheduler,
            self._channels.bulk_publisher,
            self._on_sent,
            clock,
            settings.residuals.share,
        )
        hurried = settings.capture.source != "recording" or settings.capture.realtime
        self._at_once = hurried and body is not None
        fitting, candidates, residuals = (
            None if self._at_once else rehearse
            for rehearse in (rehearse_start, rehearse_candidates, rehearse_residuals)
        )
        self._fitting = ComputeWorker("fitting", self._fit, self._on_tracked, fitting)
        self._meshing = ComputeWorker(
            "candidates", self._make_candidate, self._on_candidates, candidates, background=True
        )
        # Not with the candidates: one of those takes as long as ten frames, and old maps are of no use.
        self._mapping = ComputeWorker(
            "residuals", self._residuals.process, self._on_residual, residuals, background=True
        )
        self._first_pose = asyncio.Event()
        self._synchronizer = open_synchronizer(source, settings.capture.patience_ms)
        deliver = self._fitting.submit if hurried else self._fitting.submit_in_turn
        self._capture = CaptureThread(source, self._synchronizer, deliver, clock)
        self._last_status = ""
        self._next_save_ns: int | None = None
        self._candidate_work_ns = 0
        self._pace = CandidatePace(int(settings.poses.interval_ms * 1e6), settings.poses.busy_share)
        self._published = 0
        self._nobody = 0
        self._poses_sent = 0
        self._residual_level = 0.0
        self._mapped_ns = 0
        self._skeleton_bytes_max = 0
        self._candidate_bytes: list[int] = []
        self.metrics = self._make_metrics()
        session.add_metrics(self.metrics)

    def close(self) -> None:
        """Write out what is buffered."""
        self._send_log.close()
        if self._settings.stats_file is not None:
            write_statistics(self._settings.stats_file, self._run_figures())

    async def run(self, daemon: Daemon) -> None:
        """Capture, fit, publish until the source ends.

        The first frames of somebody unknown are worth as much as any: they wait until all kernels are there. Where the
        person is known somebody may be waiting for the picture: the first frames load what they need, and HTTP waits.
        """
        self._channels.open(self._links.on_report, self._links.on_repository, self.metrics.text)
        async with asyncio.TaskGroup() as group:
            lasting = [
                group.create_task(part.run()) for part in (self._fitting, self._meshing, self._mapping, self._links)
            ]
            await asyncio.gather(*(worker.wait_ready() for worker in (self._fitting, self._meshing, self._mapping)))
            capturing = group.create_task(self._capture.run())
            self._health.ready, self._health.reason = True, "capturing"
            with suppress(TimeoutError):
                async with asyncio.timeout(HTTP_WAITS_S if self._at_once else 0):
                    await self._first_pose.wait()
            served = await asyncio.to_thread(_load_served)
            async with served(self._settings.http, self.metrics, self._health):
                daemon.announce_ready()
                if self._self_view is not None:
                    lasting.append(group.create_task(self._self_view.run()))
                await capturing
                await asyncio.sleep(LAST_WORDS_S)
            for task in lasting:
                task.cancel()

    def _fit(self, frames: FrameSet) -> TrackedFrame:
        """On the fitting thread. The body is saved from here, since only this thread may read the tracker."""
        tracked = self._skeletons.process(frames)
        if tracked.packet is not None:
            if self._next_save_ns is None:
                self._next_save_ns = frames.capture_ns + FIRST_SAVE_NS
            if frames.capture_ns >= self._next_save_ns and self._tracker.body is not None:
                self._next_save_ns = frames.capture_ns + SAVE_EVERY_NS
                with self._timer.stage("body file"):
                    self._store.save(self._tracker.body.to_bytes())
        return tracked

    def _on_tracked(self, tracked: TrackedFrame) -> None:
        """On the loop, for every frame: publish, and hand some frames on."""
        self._tell_status()
        if tracked.body is not None:
            self._channels.publish_body(tracked.body)
        if tracked.packet is None:
            self._nobody += 1
            return
        self._channels.publish_skeleton(tracked.packet, tracked.sequence)
        self._published += 1
        self._skeleton_bytes_max = max(self._skeleton_bytes_max, len(tracked.packet))
        self._timer.add("capture to publish", self._clock.now_ns() - tracked.capture_ns)
        if self._settings.poses.enabled:
            self._candidates.remember(tracked)
            now_ns = self._clock.now_ns()
            if self._pace.due(tracked.capture_ns, now_ns) and self._candidates.may_become_one(tracked):
                self._pace.begin(tracked.capture_ns, now_ns)
                self._candidates.note_budget(self._scheduler.budget_bytes)
                self._meshing.submit(tracked)
        if self._settings.residuals.mode == "auto":
            self._map_residuals(tracked)

    def _map_residuals(self, tracked: TrackedFrame) -> None:
        """If anybody wants them, at the level their link allows."""
        bytes_per_s = self._links.residual_bytes_s()
        seldom = not self._links.wants_points and tracked.capture_ns - self._mapped_ns < LIVE_INTERVAL_NS
        if bytes_per_s is None or seldom:
            return
        self._mapped_ns = tracked.capture_ns
        self._residuals.note_budget(bytes_per_s, self._links.wants_points)
        if self._links.lacks_residual_key:
            self._residuals.request_key()
        self._mapping.submit(tracked)

    def _on_residual(self, residual: Residual | None) -> None:
        """On the loop: the newest residual packet."""
        if residual is not None:
            self._residual_level = residual.level
            self._links.offer_residual(residual)

    def _make_candidate(self, tracked: TrackedFrame) -> Candidates:
        """On the candidate thread, which gives way to all others: what counts is the time it had, not what passed."""
        before_ns = time.thread_time_ns()
        found = self._candidates.process(tracked)
        self._candidate_work_ns = time.thread_time_ns() - before_ns
        return found

    def _on_candidates(self, found: Candidates) -> None:
        """On the loop: what may be sent now."""
        self._first_pose.set()
        self._pace.done(self._candidate_work_ns)
        self._scheduler.offer(found.pose_id, found.encoded, found.capture_ns, found.worth, found.preview)
        self._candidate_bytes.append(len(found.encoded))
        self._links.wake()

    def _on_sent(self, record: SendRecord) -> None:
        """On the loop: a pose is on its way to a receiver."""
        self._poses_sent += 1
        # The self view's link has no bandwidth worth a thought: what goes there must not thin out what others get.
        for_others = self._self_view is None or record.receiver_id != self._self_view.name
        if for_others and not record.preview:
            self._candidates.note_sent(record.pose_id, record.retain_threshold)
        self._send_log.add(record)

    def _tell_status(self) -> None:
        status = (self._outside or self._tracker).status
        what = status.partition(":")[0]  # figures behind the colon change with every frame
        if what != self._last_status:
            self._last_status = what
            log.info("tracker: %s", status)

    def _make_metrics(self) -> Metrics:
        metrics = Metrics()
        metrics.stages(self._timer)
        metrics.counter("frames_captured_total", "Frames read, all cameras", lambda: self._capture.frames)
        metrics.counter("frame_sets_total", "Synchronised sets", lambda: self._capture.sets)
        metrics.counter("skeletons_published_total", "Skeleton packets published", lambda: self._published)
        metrics.counter("candidate_poses_sent_total", "Deliveries begun", lambda: self._poses_sent)
        metrics.counter("candidate_poses_delivered_total", "Arrived whole", lambda: self._links.delivered_poses)
        metrics.counter("candidate_poses_given_up_total", "On their way no more", lambda: self._links.given_up_poses)
        metrics.gauge("candidate_poses_under_way", "Begun, and not yet arrived", lambda: self._links.poses_under_way)
        residuals = self._links.residual_counts
        metrics.counter("residual_packets_sent_total", "Deliveries", lambda: residuals()["sent"])
        metrics.counter("residual_bytes_total", "Of residual packets sent", lambda: residuals()["bytes"])
        metrics.gauge("residual_level", "Of the newest residual packet [%]", lambda: self._residual_level)
        metrics.counter("dropped_total", "What was dropped, by cause", self._dropped)
        metrics.gauge("receivers", "Receivers there are", lambda: len(self._links.links))
        about = "The receiver that takes fewest skeletons takes 1 in so many, since its path carries no more"
        metrics.gauge("skeleton_divisor", about, lambda: self._links.skeleton_divisor)
        return metrics

    def _dropped(self) -> dict[str, float]:
        late = self._synchronizer.counters
        reports = self._channels.reports
        return {
            "fitting busy": self._fitting.dropped,
            "nobody in view": self._nobody,
            "candidates busy": self._meshing.dropped,
            "residuals busy": self._mapping.dropped,
            "residual stale": self._links.residual_counts()["dropped"],
            "camera missing": late.missing,
            "frame late": late.late,
            "frame duplicate": late.duplicate,
            "frame rejected": late.rejected,
            "frame lost by reader": getattr(self._source, "lost", 0) + getattr(self._source, "dropped", 0),
            "receiver refused": self._links.counts["refused"],
            **({f"report {cause}": count for cause, count in reports.counts.items()} if reports else {}),
        }

    def _run_figures(self) -> dict[str, Any]:
        """Everything worth keeping of the run."""
        sizes = self._candidate_bytes
        rig = self._source if isinstance(self._source, VirtualRig) else None
        rig_elapsed_s = (self._clock.now_ns() - rig.epoch_ns) / 1e9 if rig else 0.0
        return self._statistics.figures() | {
            "settings": dump_settings(self._settings),
            "frames_captured": self._capture.sets,
            "camera_frames": self._capture.frames,
            "skeletons_published": self._published,
            "skeleton_bytes_max": self._skeleton_bytes_max,
            "candidate_poses_considered": len(sizes),
            "candidate_poses_sent": self._poses_sent,
            "sends": self._send_log.figures(),
            "candidate_poses_delivered": self._links.delivered_poses,
            "candidate_pose_bytes_mean": sum(sizes) / len(sizes) if sizes else 0,
            "residuals": dict(self._links.residual_counts()) | {"level": self._residual_level},
            "receivers": dict(self._links.counts),
            "dropped": self._dropped(),
            "source_epoch_ns": getattr(self._source, "epoch_ns", None),
            "rig_cpu_share": rig.status.get("cpu_s", 0.0) / max(rig_elapsed_s, 1e-3) if rig else None,
            "rig": rig.status if rig else None,
        }


def _load_served() -> Callable[..., AbstractAsyncContextManager[int]]:
    from common.runtime.http_app import served  # aiohttp takes a while

    return served


def _open_send_log(file: Path | None) -> SendLog:
    try:
        return SendLog(file)
    except OSError as error:
        raise DaemonError(f"[poses] send_log: {error}") from error
