"""What the sender declares with Zenoh: its publishers, its answers to questions, its presence."""

from __future__ import annotations

from collections.abc import Callable

from common.runtime.clock import Clock
from common.transport import channels
from common.transport.channel_publisher import ChannelPublisher
from common.transport.channel_query import ChannelQueryable, Question
from common.transport.channel_subscriber import Arrival, ChannelSubscriber
from common.transport.channels import ANY, Channel, channel_key
from common.transport.clock_exchange import serve_clock
from common.transport.temporal_layers import LAYERS, layer_of
from common.transport.zenoh_session import ZenohSession


class SenderChannels:
    """One person's outgoing stream. ``body`` is kept for receivers that ask."""

    def __init__(self, session: ZenohSession, site: str, person: int, clock: Clock) -> None:
        self._session = session
        self._site = site
        self._person = person
        self._clock = clock
        self._skeleton = tuple(
            ChannelPublisher(session, channels.SKELETON, self._key(channels.SKELETON, layer=layer))
            for layer in range(LAYERS)
        )
        self._body = ChannelPublisher(session, channels.BODY, self._key(channels.BODY))
        self._body_message: bytes | None = None
        self.reports: ChannelSubscriber | None = None

    def open(
        self,
        on_report: Callable[[Arrival], None],
        on_repository: Callable[[Question], bytes],
        status: Callable[[], bytes],
    ) -> None:
        """Answer questions, listen to reports, and be seen."""
        session = self._session
        ChannelQueryable(session, channels.BODY, self._key(channels.BODY), lambda _: self._body_message)
        ChannelQueryable(session, channels.STATUS, self._key(channels.STATUS), lambda _: status())
        ChannelQueryable(session, channels.REPOSITORY, self._key(channels.REPOSITORY, ANY), on_repository)
        serve_clock(session, self._key(channels.CLOCK), self._clock)
        key = self._key(channels.REPORT, ANY)
        self.reports = ChannelSubscriber(session, channels.REPORT, key, on_report, self._clock)
        session.declare_presence(self._key(channels.SENDER_PRESENCE))

    def publish_body(self, message: bytes) -> None:
        """Tell everyone the person's sizes, and keep them for those who come later."""
        self._body_message = message
        self._body.put(message)

    def publish_skeleton(self, packet: bytes, sequence: int) -> None:
        """One frame, to everyone who takes its layer."""
        self._skeleton[layer_of(sequence)].put(packet)

    def bulk_publisher(self, receiver: str) -> ChannelPublisher:
        """The bulk channel of one receiver."""
        return ChannelPublisher(self._session, channels.BULK, self._key(channels.BULK, receiver))

    def _key(self, channel: Channel, receiver: str | None = None, layer: int | None = None) -> str:
        return channel_key(channel, self._site, self._person, receiver, layer)
