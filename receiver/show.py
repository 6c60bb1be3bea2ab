"""One run of a receiver over an open session: skeletons and candidate poses in, a moving person out.

The newest skeleton goes to the animation thread (newest wins), whose result the loop shows. What takes longer,
candidate poses and residual maps, is made ready beside it (``PoseMaker``, ``MapMaker``).
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from common.body.skeleton import Skeleton
from common.runtime.clock import MonotonicClock
from common.runtime.compute_worker import ComputeWorker
from common.runtime.daemon import Daemon, DaemonError
from common.runtime.metrics import Health
from common.runtime.run_statistics import RunStatistics, write_statistics
from common.runtime.session_recording import RecordingError
from common.runtime.stage_timer import StageTimer
from common.runtime.steady_ticks import steadily
from common.transport.zenoh_session import ZenohSession
from common.wire.receiver_report import SPARES_POSES, WANTS_LIVE, WANTS_RESIDUALS
from common.wire.skeleton_packet import SkeletonPacket
from receiver.channels_in import Handlers, ReceiverChannels
from receiver.config import ReceiverSettings, ViewSettings
from receiver.jitter_buffer import JitterBuffer
from receiver.map_maker import MapMaker
from receiver.pipeline import AnimationPath, MapPath, NewMaps, Shown, SkeletonToShow
from receiver.pose_maker import PoseMaker
from receiver.receiver_figures import ReceiverFigures
from receiver.session_log import SessionLog
from receiver.show_log import ShowLog
from receiver.stream_state import StreamState
from receiver.viewer.headless_screen import HeadlessScreen
from receiver.viewer.window_process import run_window

if TYPE_CHECKING:
    from receiver.viewer.web_viewer import WebViewer

log = logging.getLogger(__name__)

REPORT_PERIOD_S = 0.05
STATUS_PERIOD_S = 0.25
CLOCK_PERIOD_S = 1.0
CLOCK_QUICK_PERIOD_S = 0.1  # until the offset is known
BODY_PERIOD_S = 0.1


class Show:
    """One run with one open session."""

    def __init__(
        self,
        settings: ReceiverSettings,
        name: str,
        session: ZenohSession,
        clock: MonotonicClock,
        rehearsed: Future[None],
    ) -> None:
        self._settings = settings
        self._clock = clock
        self._health = Health()
        self._timer = StageTimer(clock)
        self._counts: Counter[str] = Counter()
        self._session_log = _open_session_log(settings)
        self._channels = ReceiverChannels(
            session,
            settings.site,
            settings.person,
            name,
            secrets.randbits(64),
            secrets.randbits(32),
            clock,
            self._session_log.add if self._session_log else lambda *_: None,
        )
        self._state = StreamState(clock)
        self._animation_path = AnimationPath(settings.repository, self._timer, clock)
        self._animation = ComputeWorker("animation", self._animation_path.show, self._on_shown, rehearsed.result)
        self._poses = PoseMaker(settings.person, settings.repository.score_form, self._timer, self._on_mesh)
        self._appeared = asyncio.Event()
        self._newest: SkeletonToShow | None = None
        smoothness = settings.view.smoothness
        self._jitter = JitterBuffer(smoothness) if smoothness > 0 else None  # without it the newest wins
        self._log = _open_show_log(settings.shown_log)
        self.viewer = _open_viewer(settings.view, self._timer)
        maps = MapPath(settings.person, self._timer)
        self._maps = MapMaker(maps, self._channels.stream.bodies, lambda: self.viewer.wants_points, self._on_maps)
        self._figures = ReceiverFigures(
            settings,
            self._timer,
            RunStatistics(self._timer),
            self._channels,
            self._state,
            self._animation,
            self._poses,
            self._maps,
            self._jitter,
            self._counts,
        )
        self.metrics = self._figures.metrics()
        session.add_metrics(self.metrics)

    async def run(self, daemon: Daemon, rehearsed_all: Future[None]) -> None:
        """Receive and show until cancelled, or until the window is closed where there is one.

        HTTP comes last: what serves it takes as long to load as many kernels, and nobody sees a picture there sooner.
        """
        self._channels.open(
            Handlers(
                self._on_skeleton, self._on_pose, self._on_body, self._on_epoch, self._on_presence, self._maps.submit
            )
        )
        lasting: list[Coroutine[Any, Any, None]] = [
            self._animation.run(),
            self._poses.run(),
            self._maps.run(),
            steadily(REPORT_PERIOD_S, self._report),
            steadily(STATUS_PERIOD_S, self._tell_status),
            steadily(1 / self._settings.view.display_hz, self._tick, self._on_missed_ticks),
            self._keep_time(),
            self._channels.keep_session(),
            self._keep_body(),
            self._tell_what_is_here(),
        ]
        if isinstance(self.viewer, HeadlessScreen):
            lasting.append(self.viewer.run())
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(part) for part in lasting]
            await self._animation.wait_ready()
            async with self._served() as port:
                await asyncio.wrap_future(rehearsed_all)
                daemon.announce_ready()
                if self._settings.view.window:
                    await run_window(_page_address(self._settings.http.host, port))
                    for task in tasks:
                        task.cancel()
                await asyncio.wait(tasks)

    @asynccontextmanager
    async def _served(self) -> AsyncIterator[int]:
        served = await asyncio.to_thread(_load_served)
        what = self._settings.http, self.metrics, self._health
        page = () if isinstance(self.viewer, HeadlessScreen) else ("the page", self.viewer.add_routes)
        async with served(*what, *page) as port:
            yield port

    def close(self) -> None:
        """Hear nothing more, and write out what is buffered."""
        self._channels.close()
        self._poses.close()
        self._maps.close()
        for kept in (self._log, self._session_log):
            if kept is not None:
                kept.close()
        if self._settings.stats_file is not None:
            write_statistics(self._settings.stats_file, self._run_figures())

    def _on_skeleton(self, packet: SkeletonPacket, body: Skeleton, data: bytes) -> None:
        self._state.skeleton()
        self._record("skeleton", data)
        if self._jitter is None:
            self._animate(packet, body)
        else:
            self._jitter.push(packet, body, self._clock.now_ns())

    def _animate(self, packet: SkeletonPacket, body: Skeleton) -> None:
        self._newest = SkeletonToShow(packet, body, self._poses.meshes)
        self._animation.submit(self._newest)

    def _on_body(self, message: bytes) -> None:
        self._record("body", message)

    def _on_epoch(self) -> None:
        log.info("the sender has started anew")
        self.viewer.show_points(None)
        self._appeared.set()

    def _on_presence(self, there: bool) -> None:
        self._state.presence(there)
        if there:
            self._appeared.set()

    def _on_pose(self, message: bytes) -> None:
        self._record("pose", message)
        self._poses.submit(message)

    def _on_mesh(self) -> None:
        if self._state.first_body_ns is None and self._newest is not None:
            self._animation.submit(self._newest)  # the first sight waits for no other skeleton

    def _on_maps(self, new: NewMaps) -> None:
        self._animation_path.live.note_maps(new.maps if self.viewer.wants_live else None)
        if new.points is not None:
            self.viewer.show_points(new.points)

    async def _tell_what_is_here(self) -> None:
        """Whenever a sender appears: a pose that is here need not be sent (again)."""
        while True:
            await self._appeared.wait()
            self._appeared.clear()
            while not self._appeared.is_set():
                offered = await self._channels.ask_repository(*self._poses.held)
                if offered is not None:
                    log.info("of the sender's %d poses %d are here", len(offered), len(self._poses.held[1]))
                    break
                await asyncio.sleep(BODY_PERIOD_S)

    def _on_shown(self, shown: Shown) -> None:
        """On the loop: the animated mesh is ready."""
        now_ns = self._clock.now_ns()
        for pose_id in shown.removed:
            self.viewer.remove_pose(pose_id)
        for mesh in shown.added:
            self.viewer.add_pose(mesh)
        self._counts += shown.counts
        latency_ns = self._channels.age_ns(shown.frame.capture_ns, now_ns)
        frame = shown.frame if latency_ns is None else replace(shown.frame, age_ms=latency_ns / 1e6)
        self.viewer.show(frame)
        if frame.withheld:  # it is on screen already; the viewer marks it
            self._counts["withheld"] += 1
            return
        if latency_ns is not None:
            self._timer.add("capture to shown", latency_ns)
        self._state.shown(frame, shown.repository_poses)
        sigma = None if frame.pose_id is None else frame.sigma
        self._record("frame", [shown.epoch, frame.sequence, frame.pose_id, sigma, latency_ns])

    def _tick(self) -> None:
        """A display tick: what is on screen now, and how old; and what should be next where the pace is ours."""
        frame = self._state.frame
        age_ns = None if frame is None else self._channels.age_ns(frame.capture_ns, self._clock.now_ns())
        if age_ns is not None:
            self._timer.add("pose age at tick", age_ns)
        self._record("tick", [None if frame is None else frame.sequence, age_ns])
        if self._jitter is not None and (due := self._jitter.play(self._clock.now_ns())) is not None:
            self._animate(due.packet, due.body)
        if isinstance(self.viewer, HeadlessScreen):
            self.viewer.tick()

    def _on_missed_ticks(self, count: int) -> None:
        self._counts["tick missed"] += count

    def _report(self) -> None:
        wants = WANTS_RESIDUALS * self.viewer.wants_points | WANTS_LIVE * self.viewer.wants_live
        poses = self._state.repository_poses
        # One is enough where nobody looks, and until the first sight: more would take this machine's time from it.
        if not self.viewer.wants_poses if poses > 0 else self._poses.in_hand:
            wants |= SPARES_POSES
        self._channels.send_report(poses, wants)

    def _tell_status(self) -> None:
        frame = self._state.frame
        age_ns = None if frame is None else self._channels.age_ns(frame.capture_ns, self._clock.now_ns())
        subscribers = self._channels.subscribers
        status = self._state.status(
            age_ms=None if age_ns is None else age_ns / 1e6,
            skeleton_bytes=subscribers["skeleton"].arrived_bytes,
            bulk_bytes=subscribers["bulk"].arrived_bytes,
            foreign_skeletons=self._channels.stream.skeletons.counts["old_epoch"],
            skeleton_divisor=self._channels.skeleton_divisor,
        )
        self._health.ready, self._health.reason = self._state.receiving, status.connection.value
        self.viewer.set_status(status)

    async def _keep_time(self) -> None:
        while True:
            await self._channels.ask_time()
            await asyncio.sleep(CLOCK_PERIOD_S if self._channels.clock_offset.known else CLOCK_QUICK_PERIOD_S)

    async def _keep_body(self) -> None:
        """Ask for the sizes that newly arrived skeletons refer to, when they were published before we came."""
        while True:
            await asyncio.sleep(BODY_PERIOD_S)
            if self._channels.stream.lacks_body:
                await self._channels.ask_body()

    def _record(self, kind: str, payload: bytes | list[Any]) -> None:
        if self._log is not None:
            self._log.add(kind, self._clock.now_ns(), payload)

    def _run_figures(self) -> dict[str, Any]:
        """Everything worth keeping of the run."""
        return self._figures.of_the_run(
            self.viewer.frames_rendered if isinstance(self.viewer, HeadlessScreen) else None
        )


def _open_viewer(view: ViewSettings, timer: StageTimer) -> HeadlessScreen | WebViewer:
    if view.headless:
        return HeadlessScreen(timer, skinning=view.skinning, mode=view.mode)
    from receiver.viewer.web_viewer import WebViewer  # aiohttp takes a while: not for who shows no page

    return WebViewer(allowed_hosts=view.allowed_hosts, skinning=view.skinning, mode=view.mode)


def _load_served() -> Callable[..., AbstractAsyncContextManager[int]]:
    from common.runtime.http_app import served

    return served


def _open_show_log(file: Path | None) -> ShowLog | None:
    try:
        return ShowLog(file) if file else None
    except OSError as error:
        raise DaemonError(f"shown_log {file}: {error.strerror}") from error


def _open_session_log(settings: ReceiverSettings) -> SessionLog | None:
    try:
        return SessionLog(settings.session_file, settings.site, settings.person) if settings.session_file else None
    except RecordingError as error:
        raise DaemonError(f"session_file: {error}") from error


def _page_address(host: str, port: int) -> str:
    """Where this host itself reaches the page."""
    here = {"0.0.0.0": "127.0.0.1", "": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{here}]:{port}/" if ":" in here else f"http://{here}:{port}/"
