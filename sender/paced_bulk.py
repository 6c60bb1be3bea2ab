"""Bulk to a receiver behind a link of a known rate that loses nothing: what a session file is. Pure: time is given.

It stands where the live sender has a ``BulkSender`` with its window: messages are chosen as late as possible, cut into
chunks and sent one after the other, as fast as the rate allows beside the skeletons.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Iterator
from dataclasses import dataclass

from common.transport.bulk_window import CHUNK_HOLDS_S, CHUNK_LEAST_BYTES
from common.transport.chunks import CHUNK_MAX_BYTES, OutgoingMessage
from sender.outgoing_bulk import Outgoing, OutgoingBulk

BUDGET_SHARE = 0.9  # as in BulkWindow.budget_bytes


@dataclass(frozen=True, slots=True)
class PacedChunk:
    """An encoded chunk of the message ``name``, and when its last byte is through [ns]."""

    time_ns: int
    name: Hashable
    data: bytes


class PacedBulk:
    """``rate_bps``: of the link, all that goes over it. ``choice``: what to send when the link is free."""

    def __init__(self, rate_bps: float, epoch: int, choice: OutgoingBulk) -> None:
        self._ns_per_byte = 8e9 / rate_bps
        self._budget_bytes = int(BUDGET_SHARE * rate_bps / 8)
        self._chunk_bytes = int(min(max(rate_bps / 8 * CHUNK_HOLDS_S, CHUNK_LEAST_BYTES), CHUNK_MAX_BYTES))
        self._epoch = epoch
        self._choice = choice
        self._ids, self._sequences = itertools.count(), itertools.count()
        self._messages: list[tuple[Outgoing, OutgoingMessage]] = []  # begun: at most a pose, and what is urgent
        self._under_way: tuple[Hashable, bytes] | None = None  # a chunk, through at _free_ns
        self._free_ns = 0.0

    def occupy(self, size: int, now_ns: int) -> None:
        """Something more urgent of ``size`` bytes takes its time on the link."""
        self._free_ns = max(self._free_ns, now_ns) + size * self._ns_per_byte

    def chunks(self, now_ns: int) -> Iterator[PacedChunk]:
        """What is through by ``now_ns``. What an idle link could have carried is lost."""
        while self._free_ns <= now_ns:
            if self._under_way is not None:
                yield PacedChunk(int(self._free_ns), *self._under_way)
                self._under_way = None
            elif not self._begin_chunk():
                self._free_ns = now_ns + 1
                return

    def _begin_chunk(self) -> bool:
        self._begin_message()
        if not self._messages:
            return False
        chosen, message = self._messages[-1]
        sequence = next(self._sequences)
        blocks = message.take(self._chunk_bytes)
        data = message.chunk(blocks, self._epoch, sequence, sequence, int(self._free_ns))
        self._under_way = chosen.name, data
        self._free_ns += len(data) * self._ns_per_byte
        if message.all_sent:
            self._messages.pop()
        return True

    def _begin_message(self) -> None:
        if self._messages and self._messages[-1][0].urgent:
            return
        new = (
            self._choice.next_urgent()
            if self._messages
            else self._choice.next_message(self._budget_bytes, int(self._free_ns))
        )
        if new is not None:
            self._messages.append((new, OutgoingMessage(next(self._ids), new.payload)))
