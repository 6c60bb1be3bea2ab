"""What a receiver has heard of its sender, and the report made of it. Pure: no clock, no I/O."""

from __future__ import annotations

from common.transport.bulk_arrivals import BulkArrivals, LeastDelay
from common.transport.chunks import Chunk
from common.wire.receiver_report import ReceiverReport


class Reception:
    """One receiver run's notes on one sender; a new run of the sender (an epoch) begins them anew."""

    def __init__(self, receiver_id: int, receiver_epoch: int) -> None:
        self._receiver_id, self._receiver_epoch = receiver_id, receiver_epoch
        self._number = 0
        self._begin(None)

    def _begin(self, sender_epoch: int | None) -> None:
        self._sender_epoch = sender_epoch
        self._arrivals = BulkArrivals()
        self._skeleton_delay, self._bulk_delay = LeastDelay(), LeastDelay()
        self._skeleton: tuple[int, int] | None = None  # the newest one: when sent, when it arrived

    def skeleton(self, epoch: int, send_ns: int, arrival_ns: int) -> None:
        """The newest skeleton so far arrived. Times by the sender's clock and by the receiver's."""
        if epoch != self._sender_epoch:
            self._begin(epoch)
        self._skeleton = send_ns, arrival_ns
        self._skeleton_delay.note(send_ns, arrival_ns)

    def chunk(self, chunk: Chunk, size: int, arrival_ns: int) -> None:
        """A chunk of ``size`` encoded bytes arrived."""
        if chunk.epoch != self._sender_epoch:
            self._begin(chunk.epoch)
        self._arrivals.note(chunk, size)
        self._bulk_delay.note(chunk.send_ns, arrival_ns)

    def report(
        self,
        now_ns: int,
        body_revision: int | None,
        repository_poses: int,
        wants: int = 0,
        skeleton_divisor: int = 1,
    ) -> ReceiverReport:
        """The next report; delays in it are those since the one before."""
        self._number += 1
        next_chunk, missing = self._arrivals.resolved()
        return ReceiverReport(
            number=self._number,
            receiver_id=self._receiver_id,
            receiver_epoch=self._receiver_epoch,
            sender_epoch=self._sender_epoch,
            clock_ns=now_ns,
            skeleton_send_ns=self._skeleton[0] if self._skeleton else None,
            skeleton_hold_ns=max(now_ns - self._skeleton[1], 0) if self._skeleton else 0,
            skeleton_delay_ns=self._skeleton_delay.take(),
            bulk_delay_ns=self._bulk_delay.take(),
            bulk_bytes=self._arrivals.bulk_bytes,
            next_chunk=next_chunk,
            missing_chunks=missing,
            body_revision=body_revision,
            repository_poses=repository_poses,
            wants=wants,
            skeleton_divisor=skeleton_divisor,
        )
