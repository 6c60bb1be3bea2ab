"""Who is receiving: one bulk window and one bulk sender for each, fed by the one mesh scheduler and, where the
receiver wants them, with residual packets."""

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
from common.transport.channel_query import Question
from common.transport.channel_subscriber import Arrival
from common.transport.channels import receiver_of
from common.wire.receiver_report import SPARES_POSES, WANTS_LIVE, WANTS_RESIDUALS, decode_report
from common.wire.repository_list import RepositoryList, decode_repository_list, encode_repository_list
from sender.candidate_poses.mesh_scheduler import MeshScheduler, SendRecord
from sender.outgoing_bulk import Outgoing, OutgoingBulk, pose_name, poses_in
from sender.residual_path import Residual

log = logging.getLogger(__name__)

RECEIVERS_MAX = 16  # anyone who may write reports could claim any number of names
GONE_AFTER_NS = 5_000_000_000
LIST_WITHIN_NS = 2_000_000_000  # after the first report of a receiver that has poses of this run
LOOK_EVERY_S = 0.5


@dataclass(slots=True)
class ReceiverLink:
    """One run of one receiver. ``publisher`` carries its own bulk key. ``list_due_ns``: nothing is sent before, or
    before the receiver told what it has. ``away``: its reports have stopped. ``skeleton_divisor``: it takes 1 skeleton
    in so many."""

    name: str
    receiver_epoch: int
    publisher: ChannelPublisher
    choice: OutgoingBulk
    bulk: BulkSender
    task: asyncio.Task[None]
    heard_ns: int
    list_due_ns: int = 0
    away: bool = False
    skeleton_divisor: int = 1


class ReceiverLinks:
    """Opens a link with a receiver's first report, and keeps it when reports stop: a receiver that comes back goes on
    where it was, half-sent poses included. Those away make room for others, the one silent longest first.
    ``counts``: opened, closed, refused, away, back, superseded.

    ``open_publisher(name)`` gives the publisher of a receiver's bulk channel; ``on_sent`` is told of every pose
    sent; ``residual_share``: as ``OutgoingBulk``'s share.
    """

    def __init__(
        self,
        epoch: int,
        scheduler: MeshScheduler,
        open_publisher: Callable[[str], ChannelPublisher],
        on_sent: Callable[[SendRecord], None],
        clock: Clock,
        residual_share: float = 0.5,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.delivered_poses = 0
        self.given_up_poses = 0  # superseded, or their receiver left
        self._residual_counts: Counter[str] = Counter()  # of links that are closed
        self._epoch = epoch
        self._scheduler = scheduler
        self._open_publisher = open_publisher
        self._on_sent = on_sent
        self._residual_share = residual_share
        self._clock = clock
        self._links: dict[str, ReceiverLink] = {}
        self._group: asyncio.TaskGroup | None = None

    @property
    def links(self) -> tuple[ReceiverLink, ...]:
        """The receivers there are now."""
        return tuple(link for link in self._links.values() if not link.away)

    @property
    def skeleton_divisor(self) -> int:
        """The greatest of the receivers there are now."""
        return max((link.skeleton_divisor for link in self.links), default=1)

    @property
    def poses_under_way(self) -> int:
        """Candidate poses begun and not yet arrived, to all receivers."""
        return sum(_poses_under_way(link) for link in self._links.values())

    async def run(self) -> None:
        """Serve all links until cancelled; raises what one of them raised."""
        try:
            async with asyncio.TaskGroup() as group:
                self._group = group
                while True:
                    await asyncio.sleep(LOOK_EVERY_S)
                    self._note_silent()
        finally:
            self._group = None  # reports go on while the session closes, and open nothing

    def _note_silent(self) -> None:
        now_ns = self._clock.now_ns()
        for link in self.links:
            if now_ns - link.heard_ns > GONE_AFTER_NS:
                link.away = True
                self.counts["away"] += 1
                log.info("receiver %s is away: no reports any more", link.name)

    def wake(self) -> None:
        """The scheduler has something new, which may be better than what is on its way."""
        for link in self._links.values():
            for pose_id in self._scheduler.superseded(link.name, poses_in(link.bulk.under_way)):
                self.given_up_poses += link.bulk.cancel(pose_name(pose_id))
                self.counts["superseded"] += 1
                log.debug("pose %d is on its way to %s no more: superseded", pose_id, link.name)
            link.bulk.wake()

    def residual_bytes_s(self) -> float | None:
        """What residual packets may take, on the thinnest link to a receiver that wants them (as points if any do: the
        others leave some out); None: nobody does."""
        now_ns = self._clock.now_ns()
        wanting = [link for link in self.links if link.choice.wants_residuals]
        wanting = [link for link in wanting if link.choice.for_points] or wanting
        allowed = (link.choice.residual_bytes_s(link.bulk.window.allowed_bytes_s, now_ns) for link in wanting)
        return min(allowed, default=None)

    @property
    def wants_points(self) -> bool:
        """Somebody has a use for the residual packet of every frame."""
        return any(link.choice.wants_residuals and link.choice.for_points for link in self.links)

    @property
    def lacks_residual_key(self) -> bool:
        """Somebody who wants residual packets can use none before a key."""
        return any(link.choice.needs_key for link in self.links)

    def offer_residual(self, residual: Residual) -> None:
        """The newest residual packet, for whoever wants it."""
        for link in self.links:
            link.choice.offer(residual)
            link.bulk.wake()

    def residual_counts(self) -> Counter[str]:
        """Residual packets and bytes sent, packets dropped, of all links so far."""
        return sum((link.choice.counts for link in self._links.values()), self._residual_counts)

    def on_report(self, arrival: Arrival) -> None:
        """A report arrived.

        Raises:
            WireError: it is malformed.
        """
        report = decode_report(arrival.payload)
        known = self._links.get(receiver_of(arrival.key))
        link = self._link(receiver_of(arrival.key), report.receiver_epoch)
        if link is None:
            return
        if link is not known and report.sender_epoch == self._epoch and report.repository_poses > 0:
            link.list_due_ns = arrival.arrival_ns + LIST_WITHIN_NS
        if link.away:
            link.away = False
            self.counts["back"] += 1
            log.info("receiver %s is back", link.name)
        link.heard_ns = arrival.arrival_ns
        points, live = bool(report.wants & WANTS_RESIDUALS), bool(report.wants & WANTS_LIVE)
        poses = not report.wants & SPARES_POSES
        link.choice.want(points, live, poses, link.bulk.window.allowed_bytes_s)
        link.skeleton_divisor = report.skeleton_divisor
        link.bulk.window.trickle = report.skeleton_divisor > 1  # its path does not even carry the skeletons
        link.bulk.on_report(report)

    def on_repository(self, question: Question) -> bytes:
        """A receiver tells what it has; the answer is what there is here.

        Raises:
            WireError: it is malformed.
        """
        told = decode_repository_list(question.payload)
        link = self._link(receiver_of(question.key), told.receiver_epoch)
        if link is not None:
            link.list_due_ns = 0
            if told.sender_epoch == self._epoch:
                self._scheduler.receiver_joined(link.name, told.receiver_epoch, told.poses)
            link.bulk.wake()
        return encode_repository_list(RepositoryList(self._epoch, told.receiver_epoch, self._scheduler.holding))

    def _link(self, name: str, receiver_epoch: int) -> ReceiverLink | None:
        """The link to this run of a receiver, opened if need be; None when there are too many."""
        link = self._links.get(name)
        if link is not None and link.receiver_epoch != receiver_epoch:
            self._close(link, "restarted")
            link = None
        return link or self._open(name, receiver_epoch)

    def _open(self, name: str, receiver_epoch: int) -> ReceiverLink | None:
        if len(self._links) >= RECEIVERS_MAX:
            self._make_room(name)
        if self._group is None or len(self._links) >= RECEIVERS_MAX:
            self.counts["refused"] += 1
            return None
        publisher = self._open_publisher(name)
        self._scheduler.receiver_joined(name, receiver_epoch)

        choice = OutgoingBulk(name, self._scheduler, self._on_sent, self._residual_share)

        def next_message(budget_bytes: int) -> BulkMessage | None:
            now_ns = self._clock.now_ns()
            if now_ns < self._links[name].list_due_ns:
                return next_urgent()
            return _message(choice.next_message(budget_bytes * 1_000_000_000 // PERIOD_NS, now_ns))

        def next_urgent() -> BulkMessage | None:
            return _message(choice.next_urgent())

        def delivered(message: Hashable) -> None:
            self.delivered_poses += _is_pose(message)
            log.debug("%s delivered to %s", message, name)

        window = BulkWindow(self._epoch)
        bulk = BulkSender(publisher, window, self._epoch, next_message, delivered, self._clock, next_urgent)
        task = self._group.create_task(bulk.run(), name=f"bulk to {name}")
        link = ReceiverLink(name, receiver_epoch, publisher, choice, bulk, task, self._clock.now_ns())
        self._links[name] = link
        self.counts["opened"] += 1
        log.info("receiver %s joined", name)
        return link

    def _make_room(self, newcomer: str) -> None:
        """Close the link that is silent longest; if none is, one of the site that has most, so that none shuts others
        out."""
        silent = [link for link in self._links.values() if link.away]
        if silent:
            self._close(min(silent, key=lambda link: link.heard_ns), "away, and another needs its place")
            return
        sites = Counter(_site(name) for name in self._links)
        most, count = sites.most_common(1)[0]
        if count > sites[_site(newcomer)] + 1:
            link = next(link for link in reversed(self._links.values()) if _site(link.name) == most)
            self._close(link, f"site {most} has {count}, and another site's receiver needs its place")

    def _close(self, link: ReceiverLink, why: str) -> None:
        del self._links[link.name]
        self.given_up_poses += _poses_under_way(link)
        link.task.cancel()
        link.publisher.close()
        self._scheduler.receiver_left(link.name)
        self._residual_counts += link.choice.counts
        self.counts["closed"] += 1
        log.info("receiver %s left: %s", link.name, why)


def _message(chosen: Outgoing | None) -> BulkMessage | None:
    if chosen is None:
        return None
    return BulkMessage(chosen.name, chosen.payload, chosen.supersedes, chosen.urgent)


def _poses_under_way(link: ReceiverLink) -> int:
    return sum(_is_pose(name) for name in link.bulk.under_way)


def _is_pose(name: Hashable) -> bool:
    return isinstance(name, tuple) and name[0] == "pose"


def _site(receiver: str) -> str:
    """What names the receivers of one certificate have in common."""
    return receiver.partition(".")[0]
