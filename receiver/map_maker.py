"""Residual packets into maps, beside the loop: on a thread of its own, since a mesh takes as long as ten frames."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

from common.body.skeleton import Skeleton
from common.wire.header import WireError
from common.wire.residual_packet import needed_packets
from receiver.pipeline import MapPath, NewMaps

log = logging.getLogger(__name__)

WAITING = 8


class MapMaker:
    """``bodies(epoch)``: sizes by revision; ``wants_points()``: whether somebody is shown points; ``show``: called on
    the loop with the newest maps, or one after another with those of a group until there are newer ones. ``made``: how
    many packets became maps; ``counts``: those that did not, by cause."""

    def __init__(
        self,
        path: MapPath,
        bodies: Callable[[int], Mapping[int, Skeleton]],
        wants_points: Callable[[], bool],
        show: Callable[[NewMaps], None],
    ) -> None:
        self.made = 0
        self._path = path
        self._bodies = bodies
        self._wants_points = wants_points
        self._show = show
        self._counts: Counter[str] = Counter()
        self._packets: asyncio.Queue[bytes] = asyncio.Queue(WAITING)
        self._thread = ThreadPoolExecutor(1, "maps")
        self._playing: asyncio.Task[None] | None = None

    @property
    def counts(self) -> Counter[str]:
        return self._counts + self._path.counts

    def submit(self, packet: bytes) -> None:
        """A packet is complete; when too many wait for decoding the oldest goes."""
        if self._packets.full():
            self._packets.get_nowait()
            self._counts["waiting too long"] += 1
        self._packets.put_nowait(packet)

    async def run(self) -> None:
        """Work until cancelled; of the packets that wait, only what the newest needs."""
        while True:
            waiting = [await self._packets.get()]
            while not self._packets.empty():
                waiting.append(self._packets.get_nowait())
            needed = needed_packets(waiting)
            self._counts["overtaken"] += len(waiting) - len(needed)
            for packet in needed:
                await self._make(packet)

    async def _make(self, packet: bytes) -> None:
        loop = asyncio.get_running_loop()
        try:
            found = await loop.run_in_executor(
                self._thread, self._path.take, packet, self._bodies, self._wants_points()
            )
        except WireError as error:
            self._counts["refused"] += 1
            log.warning("a residual packet is refused: %s", error)
            return
        if found:
            self.made += 1
            self._stop_playing()
            self._show(found[0])
            self._playing = asyncio.create_task(self._play(found)) if len(found) > 1 else None

    async def _play(self, group: Sequence[NewMaps]) -> None:
        """All but the first of a group's maps, at the pace at which they were captured."""
        for before, new in pairwise(group):
            await asyncio.sleep((new.maps.header.capture_ns - before.maps.header.capture_ns) / 1e9)
            self._show(new)

    def _stop_playing(self) -> None:
        if self._playing is not None:
            self._playing.cancel()

    def close(self) -> None:
        """No more work."""
        self._stop_playing()
        self._thread.shutdown(wait=False, cancel_futures=True)
