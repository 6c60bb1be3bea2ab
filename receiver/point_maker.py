"""Residual packets into points, beside the loop: on a thread of its own, since a mesh takes as long as ten frames."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

from common.body.link_points import LinkPoints
from common.body.skeleton import Skeleton
from common.wire.header import WireError
from common.wire.residual_packet import needed_packets
from receiver.pipeline import PointPath

log = logging.getLogger(__name__)

WAITING = 8


class PointMaker:
    """``bodies(epoch)``: sizes by revision; ``show``: called on the loop with the newest points. ``made``: how many
    packets became points; ``counts``: those that did not, by cause."""

    def __init__(
        self,
        path: PointPath,
        bodies: Callable[[int], Mapping[int, Skeleton]],
        show: Callable[[LinkPoints], None],
    ) -> None:
        self.made = 0
        self._path = path
        self._bodies = bodies
        self._show = show
        self._counts: Counter[str] = Counter()
        self._packets: asyncio.Queue[bytes] = asyncio.Queue(WAITING)
        self._thread = ThreadPoolExecutor(1, "points")

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
            points = await loop.run_in_executor(self._thread, self._path.take, packet, self._bodies)
        except WireError as error:
            self._counts["refused"] += 1
            log.warning("a residual packet is refused: %s", error)
            return
        if points is not None:
            self.made += 1
            self._show(points)

    def close(self) -> None:
        """No more work."""
        self._thread.shutdown(wait=False, cancel_futures=True)
