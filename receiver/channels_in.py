"""What the receiver hears and says: skeletons, bodies and chunks in; reports, questions and presence out.

Decodes and judges what arrives, on the loop, and hands on what is worth showing. Counting is here too, since a report
is made of it.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from common.body.skeleton import Skeleton
from common.runtime.clock import Clock
from common.transport import channels
from common.transport.channel_publisher import ChannelPublisher
from common.transport.channel_query import ask
from common.transport.channel_subscriber import Arrival, ChannelSubscriber
from common.transport.channels import Channel, channel_key
from common.transport.chunks import decode_chunk
from common.transport.clock_exchange import exchange_times
from common.transport.clock_offset import ClockOffset
from common.transport.reception import Reception
from common.transport.split_session import SplitSession
from common.transport.temporal_layers import LAYERS
from common.transport.zenoh_session import ZenohSession
from common.wire.header import WireError
from common.wire.receiver_report import encode_report
from common.wire.repository_list import RepositoryList, decode_repository_list, encode_repository_list
from common.wire.residual_packet import is_residual
from common.wire.skeleton_packet import SkeletonPacket
from receiver.freshness import Freshness
from receiver.incoming_stream import IncomingStream
from receiver.layer_subscription import LayerSubscription

log = logging.getLogger(__name__)

SPLIT_PERIOD_S = 0.25


@dataclass(frozen=True, slots=True)
class Handlers:
    """Called on the loop. ``skeleton(packet, its body, its bytes)``; ``pose(message)``; ``body(message)``; ``epoch()``:
    a new run of the sender has begun; ``presence(there)``; ``residual(message)``."""

    skeleton: Callable[[SkeletonPacket, Skeleton, bytes], None]
    pose: Callable[[bytes], None]
    body: Callable[[bytes], None]
    epoch: Callable[[], None]
    presence: Callable[[bool], None]
    residual: Callable[[bytes], None] = lambda _: None


class ReceiverChannels:
    """One person's incoming stream. ``counts``: answers to questions that were malformed. ``record(key, time_ns,
    payload)`` is told of all that arrives."""

    def __init__(
        self,
        session: ZenohSession,
        site: str,
        person: int,
        name: str,
        receiver_id: int,
        epoch: int,
        clock: Clock,
        record: Callable[[str, int, bytes], None] = lambda *_: None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.clock_offset = ClockOffset()
        self.stream = IncomingStream(person)
        self.subscribers: dict[str, ChannelSubscriber] = {}
        self._session = session
        self._site, self._person, self._name = site, person, name
        self._clock = clock
        self._record = record
        self._epoch = epoch
        self._reception = Reception(receiver_id, epoch)
        self._layers = LayerSubscription()
        self.freshness = Freshness()
        self.first_skeleton_ns: int | None = None  # when the very first one arrived
        self.offered_poses = 0  # how many the sender held when it was last asked
        self._report = ChannelPublisher(session, channels.REPORT, self._key(channels.REPORT, name))
        self._handlers: Handlers | None = None
        self._split = SplitSession()

    def open(self, handlers: Handlers) -> None:
        """Listen, and be seen."""
        self._handlers = handlers
        self._listen(channels.SKELETON, self._key(channels.SKELETON, layer=0), self._on_skeleton)
        for layer in range(1, LAYERS):
            self.subscribers["skeleton"].add(self._key(channels.SKELETON, layer=layer))
        self._listen(channels.BODY, self._key(channels.BODY), self._on_body)
        self._listen(channels.BULK, self._key(channels.BULK, self._name), self._on_chunk)
        self._session.watch_links(
            self._begin_session, lambda link, up: self._split.link(link, up, self._clock.now_ns())
        )
        self._session.declare_presence(self._key(channels.RECEIVER_PRESENCE, self._name))
        self._session.watch_presence(self._key(channels.SENDER_PRESENCE), lambda _, present: handlers.presence(present))

    def close(self) -> None:
        """Hear nothing more: what still arrives while the session closes has nobody to go to."""
        for subscriber in self.subscribers.values():
            subscriber.close()

    def send_report(self, repository_poses: int, wants: int = 0) -> None:
        """Tell the sender's bulk window how things are, and what this receiver has a use for; time also to take more
        skeletons, or fewer."""
        now_ns = self._clock.now_ns()
        self._judge_layers(now_ns)
        revision = self.stream.body_revision
        report = self._reception.report(now_ns, revision, repository_poses, wants, self._layers.carried_divisor)
        self._report.put(encode_report(report))

    async def keep_session(self) -> None:
        """Until cancelled: take another session where this one has come apart, or the sender has not heard what is not
        taken any more: what was on its way on a link that was lost is lost with it."""
        while True:
            await asyncio.sleep(SPLIT_PERIOD_S)
            now_ns = self._clock.now_ns()
            overfull = self._split.lost_any and self._layers.is_overfull(now_ns)
            if overfull or self._split.is_split(now_ns):
                why = "more comes than is taken" if overfull else "links are up, but nothing comes, or no answers"
                log.warning("%s: another session", why)
                await self._session.reopen()
                self._layers.said_anew(self._clock.now_ns(), overfull)

    def _begin_session(self) -> None:
        self._split = SplitSession()

    @property
    def skeleton_divisor(self) -> int:
        """1 in so many skeletons is taken, since the path carries no more."""
        return self._layers.divisor

    def _judge_layers(self, now_ns: int) -> None:
        before = self._layers.layers
        if not self._layers.judge(self.stream.skeletons.counts["lost"], now_ns):
            return
        after, skeletons = self._layers.layers, self.subscribers["skeleton"]
        for layer in range(before, after):
            skeletons.add(self._key(channels.SKELETON, layer=layer))
        for layer in range(after, before):
            skeletons.remove(self._key(channels.SKELETON, layer=layer))
        self.stream.skeletons.take(after)
        why = "carries no more" if after < before else "has room"
        log.warning("1 in %d skeletons is taken: the path %s", self.skeleton_divisor, why)

    async def ask_time(self) -> None:
        """One exchange of times with the sender."""
        await exchange_times(self._session, self._key(channels.CLOCK), self._clock, self.clock_offset, timeout_s=0.5)

    async def ask_body(self) -> None:
        """Ask for the person's sizes, which are published only when they change."""
        for answer in await ask(self._session, channels.BODY, self._key(channels.BODY)):
            try:
                self._record(self._key(channels.BODY), self._clock.now_ns(), answer)
                self._take_body(answer)
            except WireError:
                self.counts["body malformed"] += 1

    async def ask_repository(self, epoch: int, holding: Mapping[int, int]) -> dict[int, int] | None:
        """Tell the sender the candidate poses held of its run ``epoch``, bytes by id, and ask for its own; None while
        there is no answer."""
        newest = self.stream.skeletons.newest
        if newest is None:
            return None
        mine = holding if epoch == newest.epoch else {}
        told = encode_repository_list(RepositoryList(newest.epoch, self._epoch, mine))
        key = self._key(channels.REPOSITORY, self._name)
        for answer in await ask(self._session, channels.REPOSITORY, key, told):
            try:
                theirs = decode_repository_list(answer)
            except WireError:
                self.counts["repository list malformed"] += 1
                continue
            if (theirs.sender_epoch, theirs.receiver_epoch) == (newest.epoch, self._epoch):
                self.offered_poses = len(theirs.poses)
                return dict(theirs.poses)
        return None

    def age_ns(self, capture_ns: int, now_ns: int) -> int | None:
        """How long ago a capture time of the sender was, by our clock; None while its offset is unknown."""
        return now_ns - self.clock_offset.to_local_ns(capture_ns, now_ns) if self.clock_offset.known else None

    def _listen(self, channel: Channel, key: str, on_arrival: Callable[[Arrival], None]) -> None:
        heard = partial(self._hear, on_arrival) if channel.recorded else on_arrival
        self.subscribers[channel.name] = ChannelSubscriber(self._session, channel, key, heard, self._clock)

    def _hear(self, on_arrival: Callable[[Arrival], None], arrival: Arrival) -> None:
        self._record(arrival.key, arrival.arrival_ns, arrival.payload)
        on_arrival(arrival)

    def _on_skeleton(self, arrival: Arrival) -> None:
        assert self._handlers is not None
        self._split.heard(not self.stream.lacks_body, arrival.arrival_ns)
        newest = self.stream.skeleton(arrival.payload, arrival.arrival_ns)
        if newest is None:
            return
        if newest.new_epoch:
            self.clock_offset.forget()
            self._handlers.epoch()
        if self.first_skeleton_ns is None:
            self.first_skeleton_ns = arrival.arrival_ns
        packet = newest.packet
        self._reception.skeleton(packet.epoch, packet.send_ns, arrival.arrival_ns)
        self._layers.skeleton(packet.epoch, packet.send_ns, arrival.arrival_ns)
        if newest.body is not None and self.freshness.is_fresh(packet.epoch, packet.send_ns, arrival.arrival_ns):
            self._handlers.skeleton(packet, newest.body, arrival.payload)

    def _on_body(self, arrival: Arrival) -> None:
        self._take_body(arrival.payload)

    def _take_body(self, data: bytes) -> None:
        assert self._handlers is not None
        self.stream.body(data)
        self._handlers.body(data)

    def _on_chunk(self, arrival: Arrival) -> None:
        assert self._handlers is not None
        chunk = decode_chunk(arrival.payload)
        message = self.stream.chunk(chunk)
        self._reception.chunk(chunk, len(arrival.payload), arrival.arrival_ns)
        self._layers.bulk(len(arrival.payload))
        if message is not None:
            (self._handlers.residual if is_residual(message) else self._handlers.pose)(message)

    def _key(self, channel: Channel, receiver: str | None = None, layer: int | None = None) -> str:
        return channel_key(channel, self._site, self._person, receiver, layer)
