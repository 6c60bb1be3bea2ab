"""Sends large messages to one receiver as fast as its bulk window allows: the loop's part of bulk transport.

Messages go out in chunks, the newest one's after those of earlier ones; chunks that were lost go again first. The
window, the chunks and the channel decide everything else.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Protocol

from common.runtime.clock import Clock
from common.transport.bulk_window import BulkWindow, Outcome
from common.transport.chunks import OutgoingMessage
from common.wire.receiver_report import ReceiverReport

PERIOD_NS = 250_000_000  # of the budget told to whoever chooses the next message
UNDER_WAY_MAX = 32  # messages begun and not yet acknowledged: as many as a receiver puts together at a time
EXPIRY_S = 0.25  # how often to look for chunks that are never acknowledged
BURST_CHUNKS = 16  # sent in one turn of the loop at most


class Publisher(Protocol):
    """Where chunks go: a ``ChannelPublisher``."""

    def put(self, payload: bytes) -> None: ...


@dataclass(frozen=True, slots=True)
class BulkMessage:
    """What to send, and the name by which it is cancelled and its delivery told. ``supersedes``: the name of an earlier
    one that is worth nothing any more. ``urgent``: its chunks go before those of messages that are not."""

    name: Hashable
    payload: bytes
    supersedes: Hashable | None = None
    urgent: bool = False


class BulkSender:
    """One receiver's bulk. ``next_message(budget_bytes)`` is asked for more when all else is on its way.

    It may return None; ``wake`` when there is something again. ``next_urgent()`` is asked between the chunks of
    messages that are not urgent. ``on_delivered(name)`` tells that all of a message has arrived. ``chunks``,
    ``chunk_bytes``, ``repeated``: what was sent so far, and how much of it again.
    """

    def __init__(
        self,
        publisher: Publisher,
        window: BulkWindow,
        epoch: int,
        next_message: Callable[[int], BulkMessage | None],
        on_delivered: Callable[[Hashable], None],
        clock: Clock,
        next_urgent: Callable[[], BulkMessage | None] = lambda: None,
    ) -> None:
        self.chunks = 0
        self.chunk_bytes = 0
        self.repeated = 0
        self.window = window
        self._publisher = publisher
        self._epoch = epoch
        self._next_message = next_message
        self._next_urgent = next_urgent
        self._on_delivered = on_delivered
        self._clock = clock
        self._ids = itertools.count()
        self._under_way: dict[Hashable, OutgoingMessage] = {}  # in the order they began
        self._urgent: set[Hashable] = set()  # of those under way
        self._in_flight: dict[int, tuple[Hashable, OutgoingMessage, range]] = {}  # by sequence number
        self._changed = asyncio.Event()

    @property
    def under_way(self) -> tuple[Hashable, ...]:
        """The names of messages begun and neither delivered nor cancelled."""
        return tuple(self._under_way)

    def wake(self) -> None:
        """There may be something to send."""
        self._changed.set()

    def on_report(self, report: ReceiverReport) -> None:
        """Take in what the receiver reports."""
        self._settle(self.window.on_report(report, self._clock.now_ns()))
        self._changed.set()

    def cancel(self, name: Hashable) -> bool:
        """Send nothing more of a message, because a better one supersedes it; False when it is not under way."""
        self._urgent.discard(name)
        return self._under_way.pop(name, None) is not None

    async def run(self) -> None:
        """Send until cancelled."""
        while True:
            self._changed.clear()
            wait_s = self._send()
            if wait_s == 0:
                await asyncio.sleep(0)  # everyone else has a turn between bursts
                continue
            try:
                async with asyncio.timeout(wait_s):
                    await self._changed.wait()
            except TimeoutError:
                continue

    def _send(self) -> float | None:
        """Send what may go now; how long to wait for more [s], None: until something changes."""
        for _ in range(BURST_CHUNKS):
            now_ns = self._clock.now_ns()
            self._settle(self.window.expire(now_ns))
            size = self.window.chunk_bytes
            when_ns = self.window.next_send_ns(size, now_ns)
            if when_ns is None:
                return EXPIRY_S
            if when_ns > now_ns:
                return (when_ns - now_ns) / 1e9
            chosen = self._choose()  # as late as possible: meanwhile a better message may have come up
            if chosen is None:
                return EXPIRY_S if self._in_flight else None
            self._send_chunk(*chosen, size, now_ns)
        return 0

    def _choose(self) -> tuple[Hashable, OutgoingMessage] | None:
        """The message whose chunk goes next."""
        unsent = [(name, message) for name, message in self._under_way.items() if not message.all_sent]
        urgent = next((one for one in unsent if one[0] in self._urgent), None)
        if urgent is not None:
            return urgent
        if len(self._under_way) < UNDER_WAY_MAX:
            new = self._next_urgent() if unsent else self._next_message(self.window.budget_bytes(PERIOD_NS))
            if new is not None:
                return self._begin(new)
        return unsent[0] if unsent else None

    def _begin(self, new: BulkMessage) -> tuple[Hashable, OutgoingMessage]:
        if new.name in self._under_way:
            raise ValueError(f"message {new.name!r} is under way already")
        if new.supersedes is not None:
            self.cancel(new.supersedes)
        if new.urgent:
            self._urgent.add(new.name)
        message = self._under_way[new.name] = OutgoingMessage(next(self._ids), new.payload)
        return new.name, message

    def _send_chunk(self, name: Hashable, message: OutgoingMessage, size: int, now_ns: int) -> None:
        blocks = message.take(size)
        oldest, sequence = self.window.oldest_sequence, self.window.next_sequence
        data = message.chunk(blocks, self._epoch, sequence, oldest, now_ns)
        self.window.on_sent(len(data), now_ns)
        self._in_flight[sequence] = (name, message, blocks)
        self._publisher.put(data)
        self.chunks += 1
        self.chunk_bytes += len(data)

    def _settle(self, outcome: Outcome) -> None:
        """Note which chunks arrived, and queue the lost ones again."""
        if outcome.restarted:  # this receiver has nothing of what the one before it had
            self._in_flight.clear()
            for name, message in self._under_way.items():
                self._under_way[name] = OutgoingMessage(next(self._ids), message.payload)
            return
        for sequence in outcome.lost:
            name, message, blocks = self._in_flight.pop(sequence)
            if self._under_way.get(name) is message:
                message.lost(blocks)
                self.repeated += 1
        for sequence in outcome.arrived:
            name, message, blocks = self._in_flight.pop(sequence)
            message.arrived(blocks)
            if message.all_arrived and self._under_way.get(name) is message:
                self.cancel(name)
                self._on_delivered(name)
