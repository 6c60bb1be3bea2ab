"""One link per run of a receiver: opened by its first report, reopened when it restarts, closed by silence."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import numpy as np
import pytest

from common.runtime.clock import ManualClock
from common.transport.channel_query import Question
from common.transport.channel_subscriber import Arrival
from common.transport.chunks import ChunkAssembler, decode_chunk
from common.transport.reception import Reception
from common.wire.header import WireError
from common.wire.receiver_report import ReceiverReport, encode_report
from common.wire.repository_list import RepositoryList, decode_repository_list, encode_repository_list
from sender.candidate_poses.mesh_scheduler import MeshScheduler, SendRecord
from sender.candidate_poses.pose_coverage import Coverage
from sender.candidate_poses.usable_pose_set import Quotients
from sender.receiver_links import GONE_AFTER_NS, LIST_WITHIN_NS, LOOK_EVERY_S, RECEIVERS_MAX, ReceiverLinks

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

    def report(
        self,
        name: str,
        receiver_epoch: int = 1,
        sender_epoch: int = EPOCH,
        poses: int = 0,
        skeleton_divisor: int = 1,
    ) -> None:
        self._number += 1
        self.clock.advance(50_000_000)
        report = ReceiverReport(
            number=self._number,
            receiver_id=1,
            receiver_epoch=receiver_epoch,
            sender_epoch=sender_epoch,
            clock_ns=self.clock.now_ns(),
            skeleton_send_ns=None,
            skeleton_hold_ns=0,
            skeleton_delay_ns=None,
            bulk_delay_ns=None,
            bulk_bytes=0,
            next_chunk=0,
            missing_chunks=(),
            body_revision=None,
            repository_poses=poses,
            skeleton_divisor=skeleton_divisor,
        )
        key = f"v1/studio/0/report/{name}"
        self.links.on_report(Arrival(key, encode_report(report), self.clock.now_ns()))

    def tell(
        self, name: str, poses: dict[int, int], receiver_epoch: int = 1, sender_epoch: int = EPOCH
    ) -> dict[int, int]:
        """A receiver's list, and the answer."""
        told = encode_repository_list(RepositoryList(sender_epoch, receiver_epoch, poses))
        answer = self.links.on_repository(Question(f"v1/studio/0/repository/{name}", told))
        return dict(decode_repository_list(answer).poses)

    def sent_to(self, name: str) -> list[int]:
        return [record.pose_id for record in self.records if record.receiver_id == name]


class Receiver:
    """A receiver that takes in the chunks put for it, and reports. ``hears`` False: the link is cut both ways."""

    def __init__(self, bench: Bench, name: str) -> None:
        self.bench, self.name = bench, name
        self.hears = True
        self.messages: list[bytes] = []
        self.chunk_bytes = 0
        self._reception, self._assembler = Reception(1, 1), ChunkAssembler()
        self._read = 0

    async def live(self, rounds: int) -> None:
        for _ in range(rounds):
            self.bench.clock.advance(50_000_000)
            now_ns = self.bench.clock.now_ns()
            payloads = self.bench.publishers[self.name][-1].payloads if self.name in self.bench.publishers else []
            for payload in payloads[self._read :] if self.hears else []:
                self._take(payload, now_ns)
            self._read = len(payloads)
            if self.hears:
                data = encode_report(self._reception.report(now_ns, None, 0))
                self.bench.links.on_report(Arrival(f"v1/studio/0/report/{self.name}", data, now_ns))
            await asyncio.sleep(0.002)

    def _take(self, payload: bytes, now_ns: int) -> None:
        chunk = decode_chunk(payload)
        self._reception.chunk(chunk, len(payload), now_ns)
        self.chunk_bytes += len(payload)
        message = self._assembler.push(chunk)
        if message is not None:
            self.messages.append(message)


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
        assert (bench.links.given_up_poses, bench.links.poses_under_way) == (1, 1)


async def test_silence_is_noticed_and_the_link_kept():
    async with running() as bench:
        bench.report("wall")
        await asyncio.sleep(0.02)
        bench.clock.advance(GONE_AFTER_NS + 1)
        await asyncio.sleep(1.5 * LOOK_EVERY_S)
        assert bench.links.links == ()
        assert not bench.publishers["wall"][0].closed
        bench.report("wall")
        await asyncio.sleep(0.02)
        assert [link.name for link in bench.links.links] == ["wall"]
        assert bench.sent_to("wall") == [1]  # not once more
        assert (bench.links.counts["away"], bench.links.counts["back"], bench.links.counts["opened"]) == (1, 1, 1)


async def test_a_half_sent_pose_goes_on_after_an_outage_where_it_was():
    async with running() as bench:
        payload = random.Random(1).randbytes(400_000)
        bench.scheduler.offer(2, payload, 2, Quotients({2: 0.5}))
        receiver = Receiver(bench, "wall")
        while receiver.chunk_bytes < len(payload) / 2:
            await receiver.live(1)
        assert receiver.messages == []
        receiver.hears = False
        await receiver.live(5)
        bench.clock.advance(2 * GONE_AFTER_NS)
        await asyncio.sleep(1.5 * LOOK_EVERY_S)
        assert bench.links.links == ()
        receiver.hears = True
        while payload not in receiver.messages:
            await receiver.live(1)
        assert receiver.chunk_bytes < 1.2 * len(payload)


async def test_those_away_make_room_for_others():
    async with running() as bench:
        for number in range(RECEIVERS_MAX):
            bench.report(f"r{number}")
        bench.clock.advance(GONE_AFTER_NS + 1)
        for number in range(1, RECEIVERS_MAX):
            bench.report(f"r{number}")
        await asyncio.sleep(1.5 * LOOK_EVERY_S)
        bench.report("new")
        assert bench.publishers["r0"][0].closed
        assert {link.name for link in bench.links.links} == {f"r{n}" for n in range(1, RECEIVERS_MAX)} | {"new"}


async def test_no_site_can_shut_the_others_out():
    async with running() as bench:
        for number in range(5 * RECEIVERS_MAX):
            bench.report(f"wall.{number}")
        assert len(bench.links.links) == RECEIVERS_MAX
        for number in range(3):
            bench.report(f"lobby.{number}")
        for number in range(5 * RECEIVERS_MAX):
            bench.report(f"wall.{number}")
            bench.report("lobby.0")
        names = {link.name for link in bench.links.links}
        assert {f"lobby.{number}" for number in range(3)} <= names
        assert len(names) == RECEIVERS_MAX
        assert bench.publishers["lobby.0"][0].closed is False


async def test_what_a_receiver_tells_is_not_sent_again_and_it_learns_what_there_is():
    async with running() as bench:
        bench.scheduler.offer(2, b"q" * 3000, 2, Quotients({1: 0.5, 2: 0.6}))
        assert bench.tell("wall", {2: 3000}) == {1: 5000, 2: 3000}
        bench.report("wall", poses=1)
        await asyncio.sleep(0.02)
        assert bench.sent_to("wall") == [1]


async def test_a_receiver_that_has_poses_is_waited_for_but_not_for_long():
    async with running() as bench:
        bench.report("wall", poses=1)
        await asyncio.sleep(0.02)
        assert bench.sent_to("wall") == []
        bench.tell("wall", {1: 5000})
        bench.report("wall", poses=1)
        await asyncio.sleep(0.02)
        assert bench.sent_to("wall") == []  # it has the only one
        bench.report("mute", poses=1)
        bench.clock.advance(LIST_WITHIN_NS)
        bench.report("mute", poses=1)
        await asyncio.sleep(0.02)
        assert bench.sent_to("mute") == [1]


async def test_poses_of_another_run_count_for_nothing():
    async with running() as bench:
        bench.tell("wall", {1: 5000}, sender_epoch=EPOCH - 1)
        bench.report("wall", poses=7, sender_epoch=EPOCH - 1)
        bench.report("wall", poses=7)
        await asyncio.sleep(0.02)
        assert bench.sent_to("wall") == [1]


async def test_a_malformed_list_opens_nothing():
    async with running() as bench:
        with pytest.raises(WireError):
            bench.links.on_repository(Question("v1/studio/0/repository/wall", b"\x81\x00"))
        assert bench.links.links == ()


async def test_a_pose_on_its_way_is_cancelled_at_the_next_chunk_when_a_better_one_comes():
    async with running() as bench:
        sigmas = np.array([[1.9, 3.0, 3.0], [0.1, 0.1, 0.1]], np.float32)
        long = random.Random(2).randbytes(400_000)
        bench.scheduler.offer(2, long, 2, Coverage((2,), sigmas[:1]))
        receiver = Receiver(bench, "wall")
        while receiver.chunk_bytes < 20_000:
            await receiver.live(1)
        bench.scheduler.offer(3, b"better" * 100, 3, Coverage((2, 3), sigmas))
        bench.links.wake()
        while b"better" * 100 not in receiver.messages:
            await receiver.live(1)
        assert bench.links.counts["superseded"] == bench.links.given_up_poses == 1
        await receiver.live(5)
        whole = bench.links.delivered_poses + bench.links.given_up_poses + bench.links.poses_under_way
        assert len(bench.records) == whole
        assert receiver.chunk_bytes < len(long) / 2
        assert long not in receiver.messages


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


async def test_who_takes_fewer_skeletons_gets_a_trickle_of_bulk_and_the_others_all() -> None:
    async with running() as bench:
        bench.report("thin", skeleton_divisor=255)
        bench.report("wide")
        trickling = {link.name: link.bulk.window.trickle for link in bench.links.links}
        assert trickling == {"thin": True, "wide": False}
        assert bench.links.skeleton_divisor == 255
        bench.report("thin")
        assert not any(link.bulk.window.trickle for link in bench.links.links)
        assert bench.links.skeleton_divisor == 1
