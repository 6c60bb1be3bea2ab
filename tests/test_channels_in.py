"""The receiver's channels against a real sender's, and against bytes from nobody we know."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from common.body.skeleton import human_skeleton
from common.body.skeleton_pose import rest_pose
from common.runtime.clock import MonotonicClock
from common.transport import channels
from common.transport.channel_query import Question
from common.transport.channel_subscriber import Arrival
from common.transport.channels import channel_key
from common.transport.chunks import OutgoingMessage
from common.transport.link_settings import LinkSettings
from common.transport.temporal_layers import LAYERS
from common.transport.zenoh_session import ZenohSession, open_session
from common.wire.body_message import BodyMessage, encode_body
from common.wire.receiver_report import decode_report
from common.wire.repository_list import RepositoryList, decode_repository_list, encode_repository_list
from common.wire.skeleton_packet import SkeletonPacket, encode_skeleton
from receiver.channels_in import Handlers, ReceiverChannels
from receiver.layer_subscription import LayerSubscription
from scripts.daemon_processes import free_port
from sender.channels_out import SenderChannels

EPOCH = 9
CLOCK = MonotonicClock()


def packet(sequence: int, epoch: int = EPOCH) -> bytes:
    return encode_skeleton(
        SkeletonPacket(0, epoch, sequence, CLOCK.now_ns(), 1, 1.0, rest_pose(), send_delay_ns=1_000_000)
    )


def body(epoch: int = EPOCH) -> bytes:
    return encode_body(BodyMessage(0, epoch, 1, human_skeleton(1.7), 30.0))


class Ends:
    """Both ends of one stream over loopback, and what the receiver's handlers were told."""

    def __init__(self, sending: ZenohSession, receiving: ZenohSession) -> None:
        self.sending = sending
        self.heard: dict[str, list[object]] = {"skeleton": [], "pose": [], "body": [], "epoch": [], "presence": []}
        self.reports: list[Arrival] = []
        self.questions: list[Question] = []
        self.sender = SenderChannels(sending, "studio", 0, CLOCK)
        self.receiver = ReceiverChannels(receiving, "studio", 0, "wall", 1, 2, CLOCK)
        self.sender.open(self.reports.append, self._answer, lambda: b"fine")
        heard = self.heard
        self.receiver.open(
            Handlers(
                skeleton=lambda packet, body, data: heard["skeleton"].append(packet.sequence),
                pose=heard["pose"].append,
                body=heard["body"].append,
                epoch=lambda: heard["epoch"].append(1),
                presence=heard["presence"].append,
            )
        )

    def _answer(self, question: Question) -> bytes:
        self.questions.append(question)
        told = decode_repository_list(question.payload)
        return encode_repository_list(RepositoryList(told.sender_epoch, told.receiver_epoch, {4: 400, 5: 500}))

    def raw(self, channel: channels.Channel, payload: bytes, receiver: str | None = None) -> None:
        """Put bytes as anyone on the network could."""
        layer = 0 if channel.layered else None
        self.sending.zenoh.put(channel_key(channel, "studio", 0, receiver, layer), payload)

    def publish(self, sequence: int, epoch: int = EPOCH) -> None:
        self.sender.publish_skeleton(packet(sequence, epoch), sequence)

    @property
    def layers_heard(self) -> list[bool]:
        """By the sender: of which layers somebody takes the skeletons."""
        return [publisher.heard for publisher in self.sender._skeleton]


@asynccontextmanager
async def ends() -> AsyncIterator[Ends]:
    link = (f"tcp/127.0.0.1:{free_port()}",)
    async with (
        open_session(LinkSettings(listen=link)) as sending,
        open_session(LinkSettings(connect=link)) as receiving,
    ):
        made = Ends(sending, receiving)
        await until(lambda: made.heard["presence"] == [True])
        await until(lambda: all(made.layers_heard))
        yield made


async def until(condition: Callable[[], object], limit_s: float = 10.0) -> None:
    async with asyncio.timeout(limit_s):
        while not condition():  # noqa: ASYNC110 (what is waited for is not an event of ours)
            await asyncio.sleep(0.01)


async def test_a_skeleton_is_handed_on_once_its_body_is_known():
    async with ends() as both:
        both.publish(0)
        await until(lambda: both.receiver.stream.counts["body unknown"] == 1)
        assert both.receiver.stream.lacks_body
        both.sender.publish_body(body())
        await until(lambda: both.heard["body"])
        both.publish(1)
        await until(lambda: both.heard["skeleton"] == [1])
        assert not both.receiver.stream.lacks_body


async def test_a_late_receiver_asks_for_the_body():
    async with ends() as both:
        both.sender._body_message = body()  # published before anyone listened
        both.publish(0)
        await until(lambda: both.receiver.stream.lacks_body)
        await both.receiver.ask_body()
        assert not both.receiver.stream.lacks_body


async def test_what_is_here_is_told_and_what_is_there_is_learned():
    async with ends() as both:
        assert await both.receiver.ask_repository(EPOCH, {1: 100}) is None  # of whom, is not known yet
        both.publish(0)
        await until(lambda: both.receiver.stream.skeletons.newest)
        assert await both.receiver.ask_repository(EPOCH, {1: 100}) == {4: 400, 5: 500}
        assert await both.receiver.ask_repository(EPOCH - 1, {1: 100}) == {4: 400, 5: 500}
        told = [decode_repository_list(question.payload) for question in both.questions]
        assert told == [RepositoryList(EPOCH, 2, {1: 100}), RepositoryList(EPOCH, 2, {})]
        assert {question.key for question in both.questions} == {"v1/studio/0/repository/wall"}


async def test_a_new_run_is_told_and_forgets_the_old_clock():
    async with ends() as both:
        both.sender.publish_body(body())
        await until(lambda: both.heard["body"])  # skeletons are more urgent, and would overtake it
        both.publish(0)
        await until(lambda: both.heard["skeleton"])
        await both.receiver.ask_time()
        assert both.receiver.clock_offset.known
        both.publish(0, epoch=EPOCH + 1)
        await until(lambda: both.heard["epoch"])
        assert not both.receiver.clock_offset.known


async def test_clocks_of_one_host_agree_to_milliseconds():
    async with ends() as both:
        for _ in range(10):
            await both.receiver.ask_time()
        age_ns = both.receiver.age_ns(CLOCK.now_ns() - 50_000_000, CLOCK.now_ns())
        assert age_ns is not None
        assert abs(age_ns - 50_000_000) < 20_000_000


async def test_chunks_become_a_message_and_the_report_says_so():
    async with ends() as both:
        publisher = both.sender.bulk_publisher("wall")
        await until(lambda: publisher.heard)
        message = OutgoingMessage(0, b"m" * 50_000)
        sequence = 0
        while not message.all_sent:
            publisher.put(message.chunk(message.take(16_000), EPOCH, sequence, 0, CLOCK.now_ns()))
            sequence += 1
        await until(lambda: both.heard["pose"] == [b"m" * 50_000])
        both.receiver.send_report(repository_poses=4)
        await until(lambda: both.reports)
        report = decode_report(both.reports[-1].payload)
        assert (report.next_chunk, report.missing_chunks, report.repository_poses) == (sequence, (), 4)
        assert report.sender_epoch == EPOCH
        assert report.bulk_bytes > 50_000


@pytest.mark.parametrize("payload", [b"\x00", b"\xff" * 250, packet(5)[:-1], packet(5)[:-4] + b"\0\0\0\0"])
async def test_bytes_that_are_no_skeleton_are_counted_and_change_nothing(payload):
    async with ends() as both:
        both.raw(channels.SKELETON, payload)
        await until(lambda: both.receiver.subscribers["skeleton"].counts["malformed"] == 1)
        assert both.receiver.stream.skeletons.newest is None


async def test_junk_on_every_channel_is_counted():
    async with ends() as both:
        both.raw(channels.SKELETON, b"x" * 100_000)
        both.raw(channels.BODY, b"\xc1" * 50)
        both.raw(channels.BULK, b"junk" * 20, receiver="wall")
        subscribers = both.receiver.subscribers
        await until(lambda: subscribers["skeleton"].counts["size"] == 1)
        await until(lambda: subscribers["body"].counts["malformed"] == 1)
        await until(lambda: subscribers["bulk"].counts["malformed"] == 1)
        assert [both.heard[kind] for kind in ("skeleton", "body", "pose")] == [[], [], []]


async def test_after_closing_nothing_is_handed_on():
    async with ends() as both:
        both.sender.publish_body(body())
        await until(lambda: both.heard["body"])
        both.receiver.close()
        both.publish(0)
        await asyncio.sleep(0.1)
        assert both.heard["skeleton"] == []


async def test_another_persons_packets_under_our_key_are_refused():
    async with ends() as both:
        foreign = SkeletonPacket(3, EPOCH, 0, CLOCK.now_ns(), 1, 1.0, rest_pose())
        both.raw(channels.SKELETON, encode_skeleton(foreign))
        await until(lambda: both.receiver.subscribers["skeleton"].counts["malformed"] == 1)
        assert "person 3" in both.receiver.subscribers["skeleton"].last_error


async def test_a_vanished_sender_is_noticed(tmp_path):
    link = (f"tcp/127.0.0.1:{free_port()}",)
    presence: list[bool] = []
    nothing = Handlers(lambda *_: None, lambda _: None, lambda _: None, lambda: None, presence.append)
    async with open_session(LinkSettings(connect=link)) as receiving:
        ReceiverChannels(receiving, "studio", 0, "wall", 1, 2, CLOCK).open(nothing)
        async with open_session(LinkSettings(listen=link)) as sending:
            SenderChannels(sending, "studio", 0, CLOCK).open(lambda _: None, lambda _: b"", lambda: b"")
            await until(lambda: presence == [True])
        await until(lambda: not presence[-1])
        assert presence == [True, False]


class Decided(LayerSubscription):
    """Takes as many layers as it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.decided = LAYERS

    def judge(self, lost: int, now_ns: int) -> bool:
        before, self.layers = self.layers, self.decided
        return self.layers != before


async def test_layers_are_dropped_and_joined_in_order_and_nothing_counts_as_lost_for_it():
    async with ends() as both:
        both.receiver._layers = decided = Decided()
        both.sender.publish_body(body())
        await until(lambda: both.heard["body"])
        heard = both.heard["skeleton"]
        for first, layers in ((0, 4), (16, 2), (32, 3), (48, 4)):
            decided.decided = layers
            both.receiver.send_report(0)
            await until(lambda layers=layers: both.layers_heard == [layer < layers for layer in range(LAYERS)])
            for sequence in range(first, first + 16):
                both.publish(sequence)
                await until(lambda sequence=sequence: sequence % decided.divisor or sequence in heard)
            assert [each for each in heard if each >= first] == list(range(first, first + 16, decided.divisor))
            await until(lambda: both.reports)
            assert decode_report(both.reports.pop().payload).skeleton_divisor == decided.divisor
        assert both.receiver.stream.skeletons.counts["lost"] == 0
