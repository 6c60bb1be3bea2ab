"""One link per run of a receiver: opened by its first report, reopened when it restarts, closed by silence."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from common.runtime.clock import ManualClock
from common.transport.channel_subscriber import Arrival
from common.wire.header import WireError
from common.wire.receiver_report import ReceiverReport, encode_report
from sender.candidate_poses.mesh_scheduler import MeshScheduler, SendRecord
from sender.candidate_poses.usable_pose_set import Quotients
from sender.receiver_links import GONE_AFTER_NS, LOOK_EVERY_S, RECEIVERS_MAX, ReceiverLinks

EPOCH = 5


class RecordingPublisher:
    """Stands in for a bulk channel."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []
        self.closed = False

    def put(self, payload: bytes) -> None:
        self.payloads.append(payload)

    def close(self) -> None:
        self.closed = True


class Bench:
    """Links with a scheduler that holds one pose, and everything they did."""

    def __init__(self) -> None:
        self.clock = ManualClock(10**9)
        self.scheduler = MeshScheduler()
        self.scheduler.offer(1, b"p" * 5000, 1, Quotients({1: 0.5}))
        self.publishers: dict[str, list[RecordingPublisher]] = {}
        self.records: list[SendRecord] = []
        self.links = ReceiverLinks(EPOCH, self.scheduler, self._open, self.records.append, self.clock)
        self._number = 0

    def _open(self, name: str) -> RecordingPublisher:
        self.publishers.setdefault(name, []).append(RecordingPublisher())
        return self.publishers[name][-1]

    def report(self, name: str, receiver_epoch: int = 1) -> None:
        self._number += 1
        self.clock.advance(50_000_000)
        report = ReceiverReport(
            number=self._number,
            receiver_id=1,
            receiver_epoch=receiver_epoch,
            sender_epoch=EPOCH,
            clock_ns=self.clock.now_ns(),
            skeleton_send_ns=None,
            skeleton_hold_ns=0,
            skeleton_delay_ns=None,
            bulk_delay_ns=None,
            bulk_bytes=0,
            next_chunk=0,
            missing_chunks=(),
            body_revision=None,
            repository_poses=0,
        )
        key = f"v1/studio/0/report/{name}"
        self.links.on_report(Arrival(key, encode_report(report), self.clock.now_ns()))


@asynccontextmanager
async def running() -> AsyncIterator[Bench]:
    bench = Bench()
    task = asyncio.create_task(bench.links.run())
    await asyncio.sleep(0)
    yield bench
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_the_first_report_opens_a_link_and_a_pose_goes_out():
    async with running() as bench:
        bench.report("wall")
        await asyncio.sleep(0.02)
        assert [link.name for link in bench.links.links] == ["wall"]
        assert bench.publishers["wall"][0].payloads
        assert [record.pose_id for record in bench.records] == [1]


async def test_every_receiver_gets_the_pose():
    async with running() as bench:
        bench.report("wall")
        bench.report("desk")
        await asyncio.sleep(0.02)
        assert {record.receiver_id for record in bench.records} == {"wall", "desk"}


async def test_a_restarted_receiver_is_served_from_the_start():
    async with running() as bench:
        bench.report("wall", receiver_epoch=1)
        await asyncio.sleep(0.02)
        bench.report("wall", receiver_epoch=2)
        await asyncio.sleep(0.02)
        first, second = bench.publishers["wall"]
        assert first.closed
        assert not second.closed
        assert [record.pose_id for record in bench.records] == [1, 1]


async def test_silence_closes_a_link():
    async with running() as bench:
        bench.report("wall")
        bench.clock.advance(GONE_AFTER_NS + 1)
        await asyncio.sleep(1.5 * LOOK_EVERY_S)
        assert bench.links.links == ()
        assert bench.publishers["wall"][0].closed


async def test_names_cannot_be_claimed_without_end():
    async with running() as bench:
        for number in range(3 * RECEIVERS_MAX):
            bench.report(f"r{number}")
        assert len(bench.links.links) == RECEIVERS_MAX
        assert bench.links.counts["refused"] == 2 * RECEIVERS_MAX


async def test_a_report_after_the_end_opens_nothing():
    async with running() as bench:
        pass
    bench.report("late")
    assert bench.links.links == ()
    assert bench.links.counts["refused"] == 1


async def test_a_malformed_report_opens_nothing():
    async with running() as bench:
        with pytest.raises(WireError):
            bench.links.on_report(Arrival("v1/studio/0/report/wall", b"\xff" * 20, 1))
        assert bench.links.links == ()
