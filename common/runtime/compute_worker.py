"""One compute thread beside the loop: the latest input wins, results come back on the loop, failures end ``run``."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from common.runtime.latest_value import Closed, LatestValue
from common.runtime.threads import into_background

Input = TypeVar("Input")
Output = TypeVar("Output")
log = logging.getLogger(__name__)

STOP_WITHIN_S = 1.0  # how long a stop waits for the job under way; the daemon's own deadline is longer


class ComputeWorker(Generic[Input, Output]):
    """Runs ``job`` on a thread of its own, for inputs given by ``submit``, and calls ``deliver`` on the loop.

    Its life is the coroutine ``run``: put it into a task group. ``run`` starts the thread, calls ``warm_up`` there
    (compiling kernels, say), and raises what ``job`` or ``warm_up`` raised; cancelling it stops the thread.
    ``background``: after its first job it gives way to whatever else this machine has to do. At most one input waits,
    and at most one result is on its way to the loop.
    """

    def __init__(
        self,
        name: str,
        job: Callable[[Input], Output],
        deliver: Callable[[Output], None],
        warm_up: Callable[[], object] | None = None,
        background: bool = False,
    ) -> None:
        self._name = name
        self._job = job
        self._deliver = deliver
        self._warm_up = warm_up
        self._background = background
        self._inputs: LatestValue[Input] = LatestValue()
        self._loop_is_free = threading.Event()
        self._loop_is_free.set()
        self._ready = asyncio.Event()

    @property
    def dropped(self) -> int:
        """How many inputs were replaced by later ones before the job came to them."""
        return self._inputs.dropped

    def submit(self, value: Input) -> None:
        """Hand in the next input, from any thread; an input still waiting is dropped and counted."""
        self._inputs.put(value)

    def submit_in_turn(self, value: Input) -> None:
        """Hand in the next input from a thread that can wait until the one before was taken; nothing is dropped."""
        self._inputs.put_in_turn(value)

    async def wait_ready(self) -> None:
        """Return once the warm-up is done. If that failed, ``run`` raises and this waits until it is cancelled."""
        await self._ready.wait()

    async def run(self) -> None:
        """Work until cancelled. Raises whatever the job, the warm-up or ``deliver`` raised."""
        loop = asyncio.get_running_loop()
        ended: asyncio.Future[BaseException | None] = loop.create_future()
        # A daemon thread: a job that hangs must not keep the process alive past its deadline.
        thread = threading.Thread(target=self._work, args=(loop, ended), name=self._name, daemon=True)
        thread.start()
        try:
            failure = await asyncio.shield(ended)
        finally:
            self._inputs.close()
            self._loop_is_free.set()
            if not ended.done():
                await asyncio.wait([ended], timeout=STOP_WITHIN_S)
            if not ended.done():
                log.warning("%s: the job under way did not end within %s s, left behind", self._name, STOP_WITHIN_S)
        if failure is not None:
            raise failure

    def _work(self, loop: asyncio.AbstractEventLoop, ended: asyncio.Future[BaseException | None]) -> None:
        failure: BaseException | None = None
        try:
            if self._warm_up is not None:
                self._warm_up()
            loop.call_soon_threadsafe(self._ready.set)
            while True:
                result = self._job(self._inputs.wait())
                if self._background:  # from the second on: for the first somebody waits
                    into_background()
                self._loop_is_free.wait()
                self._loop_is_free.clear()
                loop.call_soon_threadsafe(self._hand_over, result, ended)
        except Closed:
            pass
        except BaseException as error:  # it goes to the owner, who awaits run()
            failure = error
        try:
            loop.call_soon_threadsafe(_end, ended, failure)
        except RuntimeError:  # the loop has closed: nobody waits any more
            log.warning("%s: ended after its loop: %r", self._name, failure)

    def _hand_over(self, result: Output, ended: asyncio.Future[BaseException | None]) -> None:
        if ended.done() or self._inputs.closed:
            return
        self._loop_is_free.set()
        try:
            self._deliver(result)
        except Exception as error:  # as a failure of the job: the owner hears of it from run()
            _end(ended, error)


def _end(ended: asyncio.Future[BaseException | None], failure: BaseException | None) -> None:
    if not ended.done():
        ended.set_result(failure)
