"""The sending end of a channel: the table's urgency and bounds on every payload."""

from __future__ import annotations

from typing import Any

import zenoh

from common.transport.channels import Channel
from common.transport.zenoh_session import ZenohSession


class ChannelPublisher:
    """Publishes payloads of one channel under ``key``. ``puts``, ``put_bytes``: what was handed to Zenoh so far."""

    def __init__(self, session: ZenohSession, channel: Channel, key: str) -> None:
        self.puts = 0
        self.put_bytes = 0
        self._channel = channel
        self._publisher = session.declare(
            lambda session: session.declare_publisher(
                key,
                priority=channel.priority,
                congestion_control=zenoh.CongestionControl.DROP,
                reliability=channel.reliability,
                express=channel.express,
            )
        )

    @property
    def heard(self) -> bool:
        """Whether anyone subscribes to the key at the moment."""
        status: Any = self._publisher.now.matching_status  # its annotation is wrong
        return bool(status.matching)

    def put(self, payload: bytes) -> None:
        """Send, or drop when the link is congested: it never waits, and there is no telling which.

        Raises:
            ValueError: a payload of a size the channel does not carry.
        """
        low, high = self._channel.min_bytes, self._channel.max_bytes
        if not low <= len(payload) <= high:
            raise ValueError(f"{self._channel.name}: {len(payload)} bytes, the channel carries {low}..{high}")
        self._publisher.now.put(payload)
        self.puts += 1
        self.put_bytes += len(payload)

    def close(self) -> None:
        """Undeclare the publisher, so that nobody counts on it."""
        self._publisher.undeclare()
