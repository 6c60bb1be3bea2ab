"""The receiving end of a channel: from Zenoh's threads to the loop, bounded, with every drop counted here."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import zenoh
from zenoh.handlers import Callback

from common.runtime.clock import Clock
from common.transport.channels import Channel
from common.transport.zenoh_session import Declared, ZenohSession
from common.wire.header import WireError


@dataclass(frozen=True, slots=True)
class Arrival:
    """One payload. ``arrival_ns``: when it came, by the clock given to the subscriber [ns]."""

    key: str
    payload: bytes
    arrival_ns: int


class ChannelSubscriber:
    """Calls ``on_arrival`` on the loop for the payloads that come under ``key`` (an expression, perhaps) and the keys
    that are added later, in the order in which they come.

    At most ``channel.keep`` payloads wait for the loop; when more come the oldest go. A ``WireError`` raised by
    ``on_arrival`` means a malformed payload. ``counts``: "size", "flooded", "malformed"; ``last_error`` has the latest
    reason. Other exceptions are the loop's, and end the daemon.
    """

    def __init__(
        self, session: ZenohSession, channel: Channel, key: str, on_arrival: Callable[[Arrival], None], clock: Clock
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.arrivals = 0
        self.arrived_bytes = 0
        self.last_error = ""
        self._session = session
        self._channel = channel
        self._on_arrival = on_arrival
        self._clock = clock
        self._lock = threading.Lock()
        self._waiting: deque[Arrival] = deque(maxlen=channel.keep)
        self._woken = False
        self._closed = False
        self._subscribers: dict[str, Declared[zenoh.Subscriber[None]]] = {}
        self.add(key)

    def add(self, key: str) -> None:
        """Hear what comes under this key as well."""
        self._subscribers[key] = self._session.declare(
            lambda session: session.declare_subscriber(key, Callback(self._came, indirect=False))
        )

    def remove(self, key: str) -> None:
        """Hear no more of what comes under a key; others upstream need not send it then.

        Raises:
            KeyError: it was not heard.
        """
        self._subscribers.pop(key).undeclare()

    def close(self) -> None:
        """Undeclare all; what still waits for the loop is dropped."""
        self._closed = True
        for key in list(self._subscribers):
            self.remove(key)

    def _came(self, sample: zenoh.Sample) -> None:
        """On a thread of Zenoh: copy and hand over, nothing else, since the link waits meanwhile."""
        arrival_ns = self._clock.now_ns()
        fits = self._channel.min_bytes <= len(sample.payload) <= self._channel.max_bytes
        arrival = Arrival(str(sample.key_expr), sample.payload.to_bytes(), arrival_ns) if fits else None
        with self._lock:
            if arrival is None:
                self.counts["size"] += 1
                return
            if len(self._waiting) == self._channel.keep:
                self.counts["flooded"] += 1
            self._waiting.append(arrival)
            wake, self._woken = not self._woken, True
        if wake:
            self._session.on_loop(self._drain)

    def _drain(self) -> None:
        """On the loop: everything that waited when it was called; one wake-up serves many arrivals."""
        with self._lock:
            self._woken = False
            waiting = list(self._waiting)
            self._waiting.clear()
        for arrival in waiting:
            if self._closed:
                return
            self.arrivals += 1
            self.arrived_bytes += len(arrival.payload)
            try:
                self._on_arrival(arrival)
            except WireError as error:
                self.counts["malformed"] += 1
                self.last_error = str(error)
