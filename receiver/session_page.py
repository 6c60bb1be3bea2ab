"""``telepose-receive decode SESSION --page``: a session played in the browser page, at its own pace, again and again.

One thread plays ahead, so that a mesh never holds up a skeleton; the loop shows what it found when it is due.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

from common.body.link_points import LinkPoints
from common.runtime.clock import MonotonicClock
from common.runtime.daemon import Daemon, DaemonError
from common.runtime.http_app import served
from common.runtime.metrics import Health, Metrics
from common.runtime.session_recording import RecordingError, SessionReader
from common.transport.channels import SCHEMA
from receiver.config import ReceiverSettings
from receiver.decode import DecodeError, check_played, faults, person_of
from receiver.pipeline import Shown
from receiver.session_player import SILENCE_NS, SessionPlayer, put_on
from receiver.stream_state import StreamState
from receiver.viewer.viewer import ViewMode
from receiver.viewer.web_viewer import WebViewer

log = logging.getLogger(__name__)

AHEAD = 60  # skeletons played ahead: two seconds
PAUSE_S = 1.0  # before it begins anew
STATUS_EVERY_NS = 250_000_000
LATE_NS = 500_000_000  # behind by more, the rest is shown so much later


@dataclass(frozen=True, slots=True, eq=False)
class _Due:
    """What to show at ``time_ns`` of the session, and the bytes of it up to there."""

    time_ns: int
    shown: Shown | LinkPoints
    skeleton_bytes: int
    bulk_bytes: int


class SessionPage:
    """Serves the page and plays the session on it until it is stopped, or once if ``once``."""

    def __init__(self, settings: ReceiverSettings, session: Path, once: bool = False) -> None:
        self._settings = settings
        self._session = session
        self._once = once
        self._clock = MonotonicClock()
        view = settings.view
        self._viewer = WebViewer(allowed_hosts=view.allowed_hosts, skinning=view.skinning, mode=view.mode)
        self._thread = ThreadPoolExecutor(1, "player")
        self._poses: set[int] = set()

    async def run(self, daemon: Daemon) -> None:
        """The main coroutine.

        Raises:
            DaemonError: the session cannot be played, or the port not be had.
        """
        health = Health(ready=True, reason="playing")
        try:
            async with served(self._settings.http, Metrics(), health, "the page", self._viewer.add_routes):
                daemon.announce_ready()
                told = False
                while not (told and self._once):
                    await self._play(tell_faults=not told)
                    told = True
                    await asyncio.sleep(PAUSE_S)
        except (RecordingError, DecodeError) as error:
            raise DaemonError(str(error)) from error
        finally:
            self._thread.shutdown(wait=False, cancel_futures=True)

    async def _play(self, tell_faults: bool) -> None:
        """The session once, from an empty repository on."""
        for pose_id in self._poses:
            self._viewer.remove_pose(pose_id)
        self._poses.clear()
        self._viewer.show_points(None)
        reader = SessionReader(self._session, SCHEMA)
        player = SessionPlayer(self._settings.repository, person_of(reader), get_args(ViewMode))
        ahead: asyncio.Queue[_Due | None] = asyncio.Queue(AHEAD)
        async with asyncio.TaskGroup() as group:
            group.create_task(self._play_ahead(_due(reader, player), ahead))
            await self._show(ahead)
        check_played(reader, player)
        if tell_faults:
            for sentence in faults(reader, player):
                log.warning("%s", sentence)

    async def _play_ahead(self, due: Iterator[_Due], ahead: asyncio.Queue[_Due | None]) -> None:
        loop = asyncio.get_running_loop()
        found: _Due | None = await loop.run_in_executor(self._thread, next, due, None)
        while found is not None:
            await ahead.put(found)
            found = await loop.run_in_executor(self._thread, next, due, None)
        await ahead.put(None)

    async def _show(self, ahead: asyncio.Queue[_Due | None]) -> None:
        begin_ns: int | None = None  # when the session's time 0 was, on our clock
        state = StreamState(self._clock)
        status_ns = 0
        while (due := await ahead.get()) is not None:
            now_ns = self._clock.now_ns()
            wait_ns = 0 if begin_ns is None else begin_ns + due.time_ns - now_ns
            if begin_ns is None or not -LATE_NS < wait_ns < SILENCE_NS:
                begin_ns, wait_ns = now_ns - due.time_ns, 0
            await asyncio.sleep(max(wait_ns, 0) / 1e9)
            if isinstance(due.shown, LinkPoints):
                self._viewer.show_points(due.shown)
                continue
            now_ns = self._clock.now_ns()
            age_ms = (now_ns - begin_ns - due.time_ns) / 1e6
            frame = replace(due.shown.frame, age_ms=age_ms)
            self._poses |= {mesh.pose_id for mesh in due.shown.added}
            put_on(self._viewer, replace(due.shown, frame=frame))
            state.skeleton()
            state.shown(frame, due.shown.repository_poses)
            if now_ns - status_ns > STATUS_EVERY_NS:
                status_ns = now_ns
                self._viewer.set_status(state.status(age_ms, due.skeleton_bytes, due.bulk_bytes))


def _due(reader: SessionReader, player: SessionPlayer) -> Iterator[_Due]:
    for message in reader.messages():
        for shown in player.take(message):
            yield _Due(message.time_ns, shown, player.payload_bytes["skeleton"], player.payload_bytes["bulk"])
