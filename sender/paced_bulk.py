"""Bulk to a receiver behind a link of a known rate that loses nothing: what a session file is. Pure: time is given.

It stands where the live sender has a ``BulkSender`` with its window: messages are chosen as late as possible, cut into
chunks and sent one after the other, as fast as the rate allows beside the skeletons.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass

from common.transport.bulk_window import CHUNK_HOLDS_S, CHUNK_LEAST_BYTES
from common.transport.chunks import CHUNK_MAX_BYTES, OutgoingMessage

BUDGET_SHARE = 0.9  # as in BulkWindow.budget_bytes


@dataclass(frozen=True, slots=True)
class PacedChunk:
    """An encoded chunk of the message ``name``, and when its last byte is through [ns]."""

    time_ns: int
    name: Hashable
    data: bytes


class PacedBulk:
    """``rate_bps``: of the link, all that goes over it. ``next_message(budget [bytes/s], now_ns)`` gives name and
    payload of what to send when the link is free, or None."""

    def __init__(
        self, rate_bps: float, epoch: int, next_message: Callable[[int, int], tuple[Hashable, bytes] | None]
    ) -> None:
        self._ns_per_byte = 8e9 / rate_bps
        self._budget_bytes = int(BUDGET_SHARE * rate_bps / 8)
        self._chunk_bytes = int(min(max(rate_bps / 8 * CHUNK_HOLDS_S, CHUNK_LEAST_BYTES), CHUNK_MAX_BYTES))
        self._epoch = epoch
        self._next_message = next_message
        self._ids, self._sequences = itertools.count(), itertools.count()
        self._message: tuple[Hashable, OutgoingMessage] | None = None
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
        if self._message is None:
            chosen = self._next_message(self._budget_bytes, int(self._free_ns))
            if chosen is None:
                return False
            self._message = chosen[0], OutgoingMessage(next(self._ids), chosen[1])
        name, message = self._message
        sequence = next(self._sequences)
        blocks = message.take(self._chunk_bytes)
        data = message.chunk(blocks, self._epoch, sequence, sequence, int(self._free_ns))
        self._under_way = name, data
        self._free_ns += len(data) * self._ns_per_byte
        if message.all_sent:
            self._message = None
        return True
