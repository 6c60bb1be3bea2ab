"""The thread that reads a frame source and forms synchronised sets; a slow reader of sets never holds up a camera."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable

from common.runtime.clock import Clock
from sender.capture.frame_set import EndOfFrames, FrameSet, FrameSource
from sender.capture.synchronizer import Synchronizer

log = logging.getLogger(__name__)

READ_TIMEOUT_S = 0.005  # how often the synchroniser's patience is looked at while no frame comes


class CaptureThread:
    """Reads ``source`` until it ends or ``run`` is cancelled; ``deliver`` is called on the thread with every set."""

    def __init__(
        self, source: FrameSource, synchronizer: Synchronizer, deliver: Callable[[FrameSet], None], clock: Clock
    ) -> None:
        self._source = source
        self._synchronizer = synchronizer
        self._deliver = deliver
        self._clock = clock
        self._stop = threading.Event()
        self.frames = 0
        self.sets = 0

    async def run(self) -> None:
        """Capture until the source has played its last frame (returns), breaks (raises) or the task is cancelled."""
        loop = asyncio.get_running_loop()
        ended: asyncio.Future[BaseException | None] = loop.create_future()
        thread = threading.Thread(target=self._work, args=(loop, ended), name="capture", daemon=True)
        thread.start()
        try:
            failure = await asyncio.shield(ended)
        finally:
            self._stop.set()
            if not ended.done():
                await asyncio.wait([ended], timeout=1.0)
        if failure is not None:
            raise failure

    def _work(self, loop: asyncio.AbstractEventLoop, ended: asyncio.Future[BaseException | None]) -> None:
        failure: BaseException | None = None
        try:
            while not self._stop.is_set():
                self._read_once()
        except EndOfFrames:
            log.info("the source has played its last frame")
        except BaseException as error:  # it goes to the owner, who awaits run()
            failure = error
        try:
            loop.call_soon_threadsafe(_end, ended, failure)
        except RuntimeError:  # the loop has closed: nobody waits any more
            log.warning("capture ended after its loop: %r", failure)

    def _read_once(self) -> None:
        frame = self._source.read(READ_TIMEOUT_S)
        now_ns = self._clock.now_ns()
        sets = self._synchronizer.expire(now_ns)
        if isinstance(frame, FrameSet):  # of skeletons, which their source has synchronised
            sets.append(frame)
        elif frame is not None:
            self.frames += 1
            sets += self._synchronizer.push(frame, now_ns)
        for frame_set in sets:
            self.sets += 1
            self._deliver(frame_set)


def _end(ended: asyncio.Future[BaseException | None], failure: BaseException | None) -> None:
    if not ended.done():
        ended.set_result(failure)
