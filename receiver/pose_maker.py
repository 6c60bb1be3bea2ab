"""Candidate poses into meshes, beside the loop: one after the other on a thread of its own, so that a mesh never holds
up a skeleton."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from common.body.body_regions import ScoreForm
from common.runtime.stage_timer import StageTimer
from common.runtime.threads import into_background
from common.wire.header import WireError
from common.wire.repository_list import REPOSITORY_LIST_MAX_POSES
from receiver.pipeline import ReceivedPose, mesh_of

log = logging.getLogger(__name__)

MESHES_WAITING = 8


class PoseMaker:
    """``made()``: called on the loop when another is in ``meshes``, where they wait for the next skeleton. ``held``:
    the sender's run, and the bytes of its poses taken in, by id. ``received``, ``meshed``: how many poses; ``counts``:
    what was dropped, by cause."""

    def __init__(self, person: int, score_form: ScoreForm, timer: StageTimer, made: Callable[[], None]) -> None:
        self.counts: Counter[str] = Counter()
        self.meshes: deque[ReceivedPose] = deque()
        self.held: tuple[int, dict[int, int]] = (-1, {})
        self._person = person
        self._score_form: ScoreForm = score_form
        self._timer = timer
        self._made = made
        self.received = self.meshed = 0
        self._messages: asyncio.Queue[bytes] = asyncio.Queue(MESHES_WAITING)
        self._thread = ThreadPoolExecutor(1, "mesher")

    @property
    def in_hand(self) -> bool:
        """A pose waits to be meshed or shown, or is being meshed."""
        done = self.meshed + self.counts["pose refused"] + self.counts["pose waiting too long"]
        return self.received > done or bool(self.meshes)

    def submit(self, message: bytes) -> None:
        """A pose is complete; when too many wait for meshing the oldest goes."""
        self.received += 1
        if self._messages.full():
            self._messages.get_nowait()
            self.counts["pose waiting too long"] += 1
        self._messages.put_nowait(message)

    async def run(self) -> None:
        """Work until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            message = await self._messages.get()
            try:
                with self._timer.stage("mesh"):
                    mesh = await loop.run_in_executor(self._thread, mesh_of, message, self._person, self._score_form)
            except WireError as error:
                self.counts["pose refused"] += 1
                log.warning("a candidate pose is refused: %s", error)
                continue
            self.meshed += 1
            if self.meshed == 1:  # somebody waits for the first sight; every later mesh gives way to what is shown
                await loop.run_in_executor(self._thread, into_background)
            while len(self.meshes) >= MESHES_WAITING:  # no skeletons come: nobody takes them
                self.meshes.popleft()
                self.counts["mesh waiting too long"] += 1
            self.meshes.append(mesh)
            self._note_held(mesh.epoch, mesh.mesh.pose_id, len(message))
            self._made()

    def close(self) -> None:
        """No more work."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _note_held(self, epoch: int, pose_id: int, size: int) -> None:
        if epoch != self.held[0]:
            self.held = epoch, {}
        held = self.held[1]
        held[pose_id] = size
        if len(held) > REPOSITORY_LIST_MAX_POSES:
            del held[next(iter(held))]
