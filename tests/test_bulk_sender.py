"""Bulk to one receiver over a lossy channel in this process: everything arrives, nothing is sent in vain."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Callable, Hashable
from contextlib import asynccontextmanager, suppress
from itertools import count

import pytest

from common.runtime.clock import MonotonicClock
from common.transport.bulk_arrivals import BulkArrivals
from common.transport.bulk_sender import UNDER_WAY_MAX, BulkMessage, BulkSender
from common.transport.bulk_window import BulkWindow
from common.transport.chunks import ChunkAssembler, decode_chunk
from common.wire.receiver_report import ReceiverReport

EPOCH = 5
WITHIN_S = 10.0


class Far:
    """The other end and the channel to it: loses a share of the chunks, delivers the others at once, reports."""

    def __init__(self, loss: float = 0.0) -> None:
        self.loss = loss
        self.epoch = 1
        self.arrivals, self.assembler = BulkArrivals(), ChunkAssembler()
        self.messages: list[bytes] = []
        self.sizes: list[int] = []
        self._numbers = count(1)
        self._chance = random.Random(1)

    def put(self, payload: bytes) -> None:
        self.sizes.append(len(payload))
        if self._chance.random() < self.loss:
            return
        chunk = decode_chunk(payload)
        self.arrivals.note(chunk, len(payload))
        message = self.assembler.push(chunk)
        if message is not None:
            self.messages.append(message)

    def report(self, now_ns: int) -> ReceiverReport:
        next_chunk, missing = self.arrivals.resolved()
        return ReceiverReport(
            number=next(self._numbers),
            receiver_id=1,
            receiver_epoch=self.epoch,
            sender_epoch=EPOCH,
            clock_ns=now_ns,
            skeleton_send_ns=now_ns - 1_000_000,
            skeleton_hold_ns=0,
            skeleton_delay_ns=1_000_000,
            bulk_delay_ns=1_000_000,
            bulk_bytes=self.arrivals.bulk_bytes,
            next_chunk=next_chunk,
            missing_chunks=missing,
            body_revision=None,
            repository_poses=0,
        )


class Bench:
    """A sender with a list of messages, its far end, and what was delivered."""

    def __init__(self, far: Far, payloads: list[bytes]) -> None:
        self.far = far
        self.budgets: list[int] = []
        self.delivered: list[Hashable] = []
        self.to_send = [BulkMessage(i, payload) for i, payload in enumerate(payloads)]
        self.reports = True
        clock = MonotonicClock()
        self.urgent: list[BulkMessage] = []
        self.sender = BulkSender(
            far, BulkWindow(EPOCH), EPOCH, self.next_message, self.delivered.append, clock, self.next_urgent
        )

    def next_message(self, budget_bytes: int) -> BulkMessage | None:
        self.budgets.append(budget_bytes)
        return self.to_send.pop(0) if self.to_send else None

    def next_urgent(self) -> BulkMessage | None:
        return self.urgent.pop(0) if self.urgent else None

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        async def report() -> None:
            while True:
                if self.reports:
                    self.sender.on_report(self.far.report(MonotonicClock().now_ns()))
                await asyncio.sleep(0.02)

        tasks = [asyncio.create_task(self.sender.run()), asyncio.create_task(report())]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            for task in tasks:
                with suppress(asyncio.CancelledError):
                    await task

    async def until_delivered(self, number: int) -> None:
        await until(lambda: len(self.delivered) >= number)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(WITHIN_S):
        while not condition():  # noqa: ASYNC110 - what is waited for is the state of the code under test
            await asyncio.sleep(0.001)


def noise(size: int, seed: int) -> bytes:
    return random.Random(seed).randbytes(size)


async def test_messages_arrive_whole_and_delivery_is_told_once() -> None:
    payloads = [noise(60_000, i) for i in range(4)]
    bench = Bench(Far(), payloads)
    async with bench.running():
        await bench.until_delivered(4)
    assert bench.far.messages == payloads
    assert sorted(map(str, bench.delivered)) == ["0", "1", "2", "3"]
    assert bench.sender.under_way == ()
    assert bench.sender.repeated == 0
    assert bench.sender.chunk_bytes == sum(bench.far.sizes)
    assert all(budget >= 0 for budget in bench.budgets)


async def test_lost_chunks_are_repeated_until_everything_is_there() -> None:
    payloads = [noise(40_000, i) for i in range(3)]
    bench = Bench(Far(loss=0.3), payloads)
    async with bench.running():
        await bench.until_delivered(3)
    assert sorted(bench.far.messages) == sorted(payloads)
    assert bench.sender.repeated > 0


async def test_a_message_added_later_is_sent_once_woken() -> None:
    bench = Bench(Far(), [])
    async with bench.running():
        await asyncio.sleep(0.05)
        bench.reports = False  # so that only the call wakes it
        bench.to_send.append(BulkMessage("late", b"x" * 1500))
        bench.sender.wake()
        await until(lambda: bool(bench.far.messages))


async def test_a_cancelled_message_is_sent_no_further() -> None:
    bench = Bench(Far(), [noise(3_000_000, 1), b"better"])
    async with bench.running():
        await until(lambda: bool(bench.far.sizes))
        assert bench.sender.cancel(0)
        assert not bench.sender.cancel(0)
        await bench.until_delivered(1)
    assert bench.delivered == [1]
    assert bench.far.messages == [b"better"]
    assert sum(bench.far.sizes) < 1_000_000


async def test_without_reports_nothing_is_sent() -> None:
    bench = Bench(Far(), [b"x"])
    bench.reports = False
    async with bench.running():
        await asyncio.sleep(0.1)
    assert bench.far.sizes == []
    assert bench.budgets == []  # nothing was even chosen: it would be stale by the time reports come


async def test_when_everything_in_flight_is_lost_it_goes_again() -> None:
    far = Far(loss=1.0)
    bench = Bench(far, [noise(500, 1)])
    async with bench.running():
        await until(lambda: bool(far.sizes))
        far.loss = 0.0
        await bench.until_delivered(1)  # by writing off: no later chunk shows that these are missing
    assert bench.sender.window.counts["written off"] > 0


async def test_a_restarted_receiver_gets_what_is_under_way_from_the_start() -> None:
    first = Far(loss=0.0)
    bench = Bench(first, [noise(600_000, 1)])
    async with bench.running():
        await until(lambda: bench.sender.chunks >= 20)  # by then several were acknowledged
        first.epoch, first.arrivals, first.assembler = 2, BulkArrivals(), ChunkAssembler()
        await bench.until_delivered(1)
    assert first.messages == [noise(600_000, 1)]


async def test_few_messages_are_under_way_at_once() -> None:
    bench = Bench(Far(loss=1.0), [b"x"] * 50)
    async with bench.running():
        await asyncio.sleep(0.2)
        assert len(bench.sender.under_way) == UNDER_WAY_MAX


async def test_a_name_under_way_cannot_be_used_again() -> None:
    bench = Bench(Far(loss=1.0), [])
    bench.to_send = [BulkMessage("same", b"1"), BulkMessage("same", b"2")]
    bench.sender.on_report(bench.far.report(0))
    with pytest.raises(ValueError, match="'same' is under way"):
        await asyncio.wait_for(bench.sender.run(), WITHIN_S)


async def test_what_is_urgent_goes_between_the_chunks_of_what_is_not():
    bench = Bench(Far(), [noise(1_000_000, 1)])
    async with bench.running():
        await until(lambda: len(bench.far.sizes) > 2)
        bench.urgent = [BulkMessage(("map", i), noise(5_000, i), urgent=True) for i in range(3)]
        await bench.until_delivered(4)
    assert bench.delivered == [("map", 0), ("map", 1), ("map", 2), 0]
    assert bench.far.messages == [noise(5_000, 0), noise(5_000, 1), noise(5_000, 2), noise(1_000_000, 1)]


async def test_what_is_superseded_is_sent_no_more_not_even_what_was_lost_of_it():
    bench = Bench(Far(), [])
    bench.far.loss = 1.0
    bench.to_send = [BulkMessage("old", noise(8_000, 1), urgent=True)]
    async with bench.running():
        await until(lambda: len(bench.far.sizes) >= 2)
        bench.to_send = [BulkMessage("new", noise(9_000, 2), supersedes="old", urgent=True)]
        bench.sender.wake()
        await until(lambda: "new" in bench.sender.under_way)
        assert bench.sender.under_way == ("new",)
        bench.far.loss = 0.0
        await bench.until_delivered(1)
    assert bench.delivered == ["new"]
    assert bench.far.messages == [noise(9_000, 2)]
