"""What the receiver notes about arriving chunks and skeletons for its next report. Pure: no clock, no I/O."""

from __future__ import annotations

from common.transport.chunks import Chunk
from common.wire.receiver_report import MAX_MISSING_CHUNKS


class BulkArrivals:
    """Which transmissions of chunks came, of one sender epoch.

    The sender says in each chunk which one is the oldest it still waits to hear of, so nothing needs to be remembered
    below that, and a receiver that joins late does not miss what was never meant for it.
    """

    def __init__(self) -> None:
        self.epoch: int | None = None
        self._begin(None)

    def _begin(self, epoch: int | None) -> None:
        self.epoch = epoch
        self.bulk_bytes = 0
        self._next = 0
        self._missing: dict[int, None] = {}  # ascending, since gaps only open at the end

    def note(self, chunk: Chunk, size: int) -> None:
        """A chunk of ``size`` encoded bytes came. A chunk of another epoch begins that epoch."""
        if chunk.epoch != self.epoch:
            self._begin(chunk.epoch)
        self.bulk_bytes += size
        if chunk.oldest_sequence > self._next:
            self._missing.clear()
            self._next = chunk.oldest_sequence
        while self._missing and (first := next(iter(self._missing))) < chunk.oldest_sequence:
            del self._missing[first]
        if chunk.sequence >= self._next:
            self._missing.update(dict.fromkeys(range(self._next, chunk.sequence)))
            self._next = chunk.sequence + 1
        else:
            self._missing.pop(chunk.sequence, None)

    def resolved(self) -> tuple[int, tuple[int, ...]]:
        """``next_chunk`` and ``missing_chunks`` of a ``ReceiverReport``."""
        missing = tuple(self._missing)
        if len(missing) > MAX_MISSING_CHUNKS:
            return missing[MAX_MISSING_CHUNKS], missing[:MAX_MISSING_CHUNKS]
        return self._next, missing


class LeastDelay:
    """The least (arrival - send time) since it was last asked for [ns]; the clocks' offset is part of it."""

    def __init__(self) -> None:
        self._least_ns: int | None = None

    def note(self, send_ns: int, arrival_ns: int) -> None:
        delay_ns = arrival_ns - send_ns
        if self._least_ns is None or delay_ns < self._least_ns:
            self._least_ns = delay_ns

    def take(self) -> int | None:
        """The least delay, and begin anew; None when nothing came."""
        least_ns, self._least_ns = self._least_ns, None
        return least_ns
