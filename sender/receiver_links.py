"""Who is receiving: one bulk window and one bulk sender for each, fed by the one mesh scheduler."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass

from common.runtime.clock import Clock
from common.transport.bulk_sender import PERIOD_NS, BulkMessage, BulkSender
from common.transport.bulk_window import BulkWindow
from common.transport.channel_publisher import ChannelPublisher
from common.transport.channel_subscriber import Arrival
from common.transport.channels import receiver_of
from common.wire.receiver_report import decode_report
from sender.candidate_poses.mesh_scheduler import MeshScheduler, SendRecord
from sender.outgoing_bulk import OutgoingBulk

log = logging.getLogger(__name__)

RECEIVERS_MAX = 16  # anyone who may write reports could claim any number of names
GONE_AFTER_NS = 5_000_000_000
LOOK_EVERY_S = 0.5


@dataclass(slots=True)
class ReceiverLink:
    """One run of one receiver. ``publisher`` carries its own bulk key."""

    name: str
    receiver_epoch: int
    publisher: ChannelPublisher
    bulk: BulkSender
    task: asyncio.Task[None]
    heard_ns: int


class ReceiverLinks:
    """Opens a link with a receiver's first report and closes it when reports stop. ``counts``: opened, closed, refused.

    ``open_publisher(name)`` gives the publisher of a receiver's bulk channel; ``on_sent`` is told of every send.
    """

    def __init__(
        self,
        epoch: int,
        scheduler: MeshScheduler,
        open_publisher: Callable[[str], ChannelPublisher],
        on_sent: Callable[[SendRecord], None],
        clock: Clock,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.delivered_poses = 0
        self._epoch = epoch
        self._scheduler = scheduler
        self._open_publisher = open_publisher
        self._on_sent = on_sent
        self._clock = clock
        self._links: dict[str, ReceiverLink] = {}
        self._group: asyncio.TaskGroup | None = None

    @property
    def links(self) -> tuple[ReceiverLink, ...]:
        """The receivers there are now."""
        return tuple(self._links.values())

    async def run(self) -> None:
        """Serve all links until cancelled; raises what one of them raised."""
        try:
            async with asyncio.TaskGroup() as group:
                self._group = group
                while True:
                    await asyncio.sleep(LOOK_EVERY_S)
                    self._close_silent()
        finally:
            self._group = None  # reports go on while the session closes, and open nothing

    def _close_silent(self) -> None:
        now_ns = self._clock.now_ns()
        for link in self.links:
            if now_ns - link.heard_ns > GONE_AFTER_NS:
                self._close(link, "no reports any more")

    def wake(self) -> None:
        """The scheduler has something new."""
        for link in self._links.values():
            link.bulk.wake()

    def on_report(self, arrival: Arrival) -> None:
        """A report arrived.

        Raises:
            WireError: it is malformed.
        """
        report = decode_report(arrival.payload)
        name = receiver_of(arrival.key)
        link = self._links.get(name)
        if link is not None and link.receiver_epoch != report.receiver_epoch:
            self._close(link, "restarted")
            link = None
        if link is None:
            link = self._open(name, report.receiver_epoch)
        if link is not None:
            link.heard_ns = arrival.arrival_ns
            link.bulk.on_report(report)

    def _open(self, name: str, receiver_epoch: int) -> ReceiverLink | None:
        if self._group is None or len(self._links) >= RECEIVERS_MAX:
            self.counts["refused"] += 1
            return None
        publisher = self._open_publisher(name)
        self._scheduler.receiver_joined(name, receiver_epoch)

        choice = OutgoingBulk(name, self._scheduler, self._on_sent)

        def next_message(budget_bytes: int) -> BulkMessage | None:
            chosen = choice.next_message(budget_bytes * 1_000_000_000 // PERIOD_NS, self._clock.now_ns())
            return None if chosen is None else BulkMessage(*chosen)

        def delivered(message: Hashable) -> None:
            self.delivered_poses += 1
            log.debug("%s delivered to %s", message, name)

        bulk = BulkSender(publisher, BulkWindow(self._epoch), self._epoch, next_message, delivered, self._clock)
        task = self._group.create_task(bulk.run(), name=f"bulk to {name}")
        link = ReceiverLink(name, receiver_epoch, publisher, bulk, task, self._clock.now_ns())
        self._links[name] = link
        self.counts["opened"] += 1
        log.info("receiver %s joined", name)
        return link

    def _close(self, link: ReceiverLink, why: str) -> None:
        del self._links[link.name]
        link.task.cancel()
        link.publisher.close()
        self._scheduler.receiver_left(link.name)
        self.counts["closed"] += 1
        log.info("receiver %s left: %s", link.name, why)
