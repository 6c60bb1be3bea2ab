"""Zenoh sessions, publishers, subscribers and questions over real TCP on loopback, in this process and in others."""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
import zenoh

from common.runtime.clock import MonotonicClock
from common.transport.bulk_arrivals import BulkArrivals, LeastDelay
from common.transport.bulk_sender import BulkMessage, BulkSender
from common.transport.bulk_window import BulkWindow
from common.transport.channel_publisher import ChannelPublisher
from common.transport.channel_query import ChannelQueryable, Question, ask
from common.transport.channel_subscriber import Arrival, ChannelSubscriber
from common.transport.channels import (
    ANY,
    BODY,
    BULK,
    CLOCK,
    RECEIVER_PRESENCE,
    REPORT,
    REPOSITORY,
    SKELETON,
    Channel,
    channel_key,
)
from common.transport.chunks import ChunkAssembler, decode_chunk
from common.transport.clock_exchange import exchange_times, serve_clock
from common.transport.clock_offset import ClockOffset
from common.transport.link_settings import DEFAULT_ENDPOINT, LinkSettings, with_endpoints
from common.transport.zenoh_session import TransportChange, TransportError, ZenohSession, open_session, zenoh_config
from common.wire.header import WireError
from common.wire.receiver_report import ReceiverReport, decode_report, encode_report

WITHIN_S = 10.0
OFFSET_NS = 5_000_000_000_000
KEY = channel_key(SKELETON, "studio", 0, layer=0)


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(WITHIN_S):
        while not condition():  # noqa: ASYNC110 - what is waited for happens in Zenoh
            await asyncio.sleep(0.005)


def hold_up_the_loop_until(condition: Callable[[], bool]) -> None:
    """Wait without giving the loop a turn, for what Zenoh's threads do."""
    for _ in range(int(WITHIN_S / 0.005)):
        if condition():
            return
        threading.Event().wait(0.005)
    raise TimeoutError("the threads of Zenoh did not do it")


class Pair:
    """A listening and a dialling session in this process."""

    def __init__(self, listener: ZenohSession, dialler: ZenohSession) -> None:
        self.listener = listener
        self.dialler = dialler


async def pair(stack: AsyncExitStack, endpoint: str) -> Pair:
    listener = await stack.enter_async_context(open_session(LinkSettings(listen=(endpoint,))))
    dialler = await stack.enter_async_context(open_session(LinkSettings(connect=(endpoint,))))
    return Pair(listener, dialler)


class Inbox:
    """A subscriber that keeps what came."""

    def __init__(self, session: ZenohSession, channel: Channel = SKELETON, key: str = KEY) -> None:
        self.arrivals: list[Arrival] = []
        self.threads: set[int] = set()
        self.subscriber = ChannelSubscriber(session, channel, key, self._take, MonotonicClock())

    def _take(self, arrival: Arrival) -> None:
        self.threads.add(threading.get_ident())
        if arrival.payload.startswith(b"bad"):
            raise WireError("bad: not what was expected")
        self.arrivals.append(arrival)

    @property
    def payloads(self) -> list[bytes]:
        return [arrival.payload for arrival in self.arrivals]


async def test_payloads_arrive_on_the_loop_with_key_and_time(endpoint: str) -> None:
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        publisher, inbox = ChannelPublisher(ends.listener, SKELETON, KEY), Inbox(ends.dialler)
        await until(lambda: publisher.heard)
        before_ns = MonotonicClock().now_ns()
        publisher.put(b"pose")
        await until(lambda: bool(inbox.arrivals))
        (arrival,) = inbox.arrivals
        assert (arrival.key, arrival.payload) == (KEY, b"pose")
        assert before_ns <= arrival.arrival_ns <= MonotonicClock().now_ns()
        assert inbox.threads == {threading.get_ident()}
        assert (publisher.puts, publisher.put_bytes) == (1, 4)


async def test_what_the_channel_does_not_carry_is_refused_at_both_ends(endpoint: str) -> None:
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        publisher, inbox = ChannelPublisher(ends.listener, SKELETON, KEY), Inbox(ends.dialler)
        rogue = ends.listener.zenoh.declare_publisher(KEY)
        await until(lambda: publisher.heard)
        for payload in (b"", bytes(251)):
            with pytest.raises(ValueError, match=r"skeleton: \d+ bytes, the channel carries 1\.\.250"):
                publisher.put(payload)
            rogue.put(payload)
        publisher.put(b"bad")
        publisher.put(bytes(250))
        await until(lambda: bool(inbox.arrivals))
        assert inbox.payloads == [bytes(250)]
        assert inbox.subscriber.counts == {"size": 2, "malformed": 1}
        assert inbox.subscriber.last_error == "bad: not what was expected"


async def test_a_flood_is_bounded_and_the_newest_win(endpoint: str) -> None:
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        inbox = Inbox(ends.dialler)
        rogue = ends.listener.zenoh.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        await until(lambda: bool(rogue.matching_status.matching))  # type: ignore[attr-defined]
        flooded = inbox.subscriber.counts
        for number in range(2000):
            rogue.put(number.to_bytes(4, "little"))
        hold_up_the_loop_until(lambda: flooded["flooded"] >= 2000 - SKELETON.keep)
        assert inbox.arrivals == []
        await until(lambda: len(inbox.arrivals) >= SKELETON.keep)
        newest = [number.to_bytes(4, "little") for number in range(2000 - SKELETON.keep, 2000)]
        assert inbox.payloads == newest


async def test_a_closed_subscriber_hears_nothing_more(endpoint: str) -> None:
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        publisher, inbox = ChannelPublisher(ends.listener, SKELETON, KEY), Inbox(ends.dialler)
        await until(lambda: publisher.heard)
        inbox.subscriber.close()
        await until(lambda: not publisher.heard)
        publisher.put(b"pose")
        publisher.close()
        await asyncio.sleep(0.05)
        assert inbox.arrivals == []


async def test_realms_are_apart_and_keys_are_seen_without_them(endpoint: str) -> None:
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        other = await stack.enter_async_context(open_session(LinkSettings(connect=(endpoint,), realm="other/place")))
        publisher, here, there = ChannelPublisher(ends.listener, SKELETON, KEY), Inbox(ends.dialler), Inbox(other)
        await until(lambda: publisher.heard)
        publisher.put(b"pose")
        await until(lambda: bool(here.arrivals))
        await asyncio.sleep(0.05)
        assert here.arrivals[0].key == KEY
        assert there.arrivals == []


async def test_a_chunk_of_the_largest_size_passes(endpoint: str) -> None:
    key = channel_key(BULK, "studio", 0, "wall")
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        publisher, inbox = ChannelPublisher(ends.listener, BULK, key), Inbox(ends.dialler, BULK, key)
        await until(lambda: publisher.heard)
        publisher.put(bytes(BULK.max_bytes))
        await until(lambda: bool(inbox.arrivals))
        assert len(inbox.payloads[0]) == BULK.max_bytes


async def test_either_end_may_start_first(endpoint: str) -> None:
    async with open_session(LinkSettings(connect=(endpoint,))) as dialler:
        inbox, changes = Inbox(dialler), list[TransportChange]()
        dialler.watch_transports(changes.append)
        await asyncio.sleep(0.3)
        async with open_session(LinkSettings(listen=(endpoint,))) as listener:
            publisher = ChannelPublisher(listener, SKELETON, KEY)
            await until(lambda: publisher.heard)
            publisher.put(b"pose")
            await until(lambda: bool(inbox.arrivals))
        await until(lambda: len(changes) == 2)
    assert [change.up for change in changes] == [True, False]
    assert changes[0].peer == changes[1].peer


@pytest.mark.parametrize("who", ["dialler", "listener"])
async def test_another_session_takes_over_all_that_was_declared(endpoint: str, who: str) -> None:
    presence = channel_key(RECEIVER_PRESENCE, "studio", 0, "wall")
    question, body = channel_key(CLOCK, "studio", 0), channel_key(BODY, "studio", 0)
    links, sessions, seen = list[bool](), list[str](), list[tuple[str, bool]]()
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        dialler, listener = ends.dialler, ends.listener
        listener.watch_presence(presence, lambda *change: seen.append(change))
        dialler.declare_presence(presence)
        dialler.watch_links(lambda: sessions.append(str(dialler.zenoh.zid())), lambda _, up: links.append(up))
        there, back = ChannelPublisher(listener, SKELETON, KEY), ChannelPublisher(dialler, BODY, body)
        inbox, returned = Inbox(dialler), Inbox(listener, BODY, body)
        ChannelQueryable(dialler, CLOCK, question, lambda _: b"here")
        await until(lambda: there.heard and links == [True])
        ids = {str(end.zenoh.zid()) for end in (dialler, listener)}
        await getattr(ends, who).reopen()
        assert len(ids | {str(end.zenoh.zid()) for end in (dialler, listener)}) == 3
        await until(lambda: links == ([True, True] if who == "dialler" else [True, False, True]))
        await until(lambda: there.heard and back.heard)
        there.put(b"pose")
        back.put(b"body")
        await until(lambda: inbox.payloads == [b"pose"] and returned.payloads == [b"body"])
        assert await ask(listener, CLOCK, question) == [b"here"]
        await until(lambda: seen[-1] == (presence, True))


async def test_presence_is_seen_by_who_came_before_and_who_came_after(endpoint: str) -> None:
    key = channel_key(RECEIVER_PRESENCE, "studio", 0, "wall")
    expression = channel_key(RECEIVER_PRESENCE, "studio", 0, "*")
    early, late = list[tuple[str, bool]](), list[tuple[str, bool]]()
    async with open_session(LinkSettings(listen=(endpoint,))) as listener:
        listener.watch_presence(expression, lambda *change: early.append(change))
        async with open_session(LinkSettings(connect=(endpoint,))) as dialler:
            dialler.declare_presence(key)
            await until(lambda: early == [(key, True)])
            listener.watch_presence(expression, lambda *change: late.append(change))
            await until(lambda: late == [(key, True)])
        await until(lambda: early == late == [(key, True), (key, False)])


async def test_questions_are_answered_on_the_loop(endpoint: str) -> None:
    key = channel_key(BODY, "studio", 0)
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        assert await ask(ends.dialler, BODY, key, timeout_s=0.5) == []
        threads: set[int] = set()

        def answer(question: Question) -> bytes | None:
            threads.add(threading.get_ident())
            return None if question.payload == b"secret" else b"body for " + question.payload

        queryable = ChannelQueryable(ends.listener, BODY, key, answer)
        answers: list[bytes] = []
        async with asyncio.timeout(WITHIN_S):
            while not answers:  # until the declaration has reached the other end
                answers = await ask(ends.dialler, BODY, key, b"wall")
        assert answers == [b"body for wall"]
        assert await ask(ends.dialler, BODY, key, b"secret") == []
        assert threads == {threading.get_ident()}
        with pytest.raises(ValueError, match="a question of 16385 bytes"):
            await ask(ends.dialler, BODY, key, bytes(BODY.max_bytes + 1))
        assert queryable.dropped == 0
        queryable.close()


async def test_a_question_under_a_receivers_own_key_says_whose_it_is(endpoint: str) -> None:
    def answer(question: Question) -> bytes:
        if question.payload == b"bad":
            raise WireError("bad: not what was expected")
        return question.key.encode()

    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        every = channel_key(REPOSITORY, "studio", 0, ANY)
        queryable = ChannelQueryable(ends.listener, REPOSITORY, every, answer)
        for name in ("wall", "desk"):
            key = channel_key(REPOSITORY, "studio", 0, name)
            async with asyncio.timeout(WITHIN_S):
                while not (answers := await ask(ends.dialler, REPOSITORY, key)):
                    pass
            assert answers == [key.encode()]
        assert await ask(ends.dialler, REPOSITORY, every) == []
        assert await ask(ends.dialler, REPOSITORY, key, b"bad") == []
        assert queryable.malformed == 2


async def test_too_many_questions_at_once_are_dropped(endpoint: str) -> None:
    key = channel_key(BODY, "studio", 0)
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        queryable = ChannelQueryable(ends.listener, BODY, key, lambda _: b"body")
        async with asyncio.timeout(WITHIN_S):
            while not await ask(ends.dialler, BODY, key):
                pass
        asked = [asyncio.create_task(ask(ends.dialler, BODY, key)) for _ in range(3 * BODY.keep)]
        await asyncio.sleep(0)
        hold_up_the_loop_until(lambda: queryable.dropped >= 2 * BODY.keep)
        answers = await asyncio.gather(*asked)
        assert sum(map(len, answers)) == BODY.keep


class ShiftedClock:
    """Another host's clock: ``OFFSET_NS`` ahead of this one's."""

    def now_ns(self) -> int:
        return MonotonicClock().now_ns() + OFFSET_NS


async def test_the_clocks_offset_is_found_by_asking(endpoint: str) -> None:
    key, offset, clock = channel_key(CLOCK, "studio", 0), ClockOffset(), MonotonicClock()
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        assert not await exchange_times(ends.dialler, key, clock, offset, timeout_s=0.1)
        serve_clock(ends.listener, key, ShiftedClock())
        async with asyncio.timeout(WITHIN_S):
            while not await exchange_times(ends.dialler, key, clock, offset):
                pass
        now_ns = clock.now_ns()
        assert abs(offset.offset_ns(now_ns) - OFFSET_NS) <= offset.error_ns(now_ns) < 10**9


async def test_bulk_and_reports_over_real_channels(endpoint: str) -> None:
    """Two megabytes in chunks, beside nothing else, with everything between sender and assembler in place."""
    payloads = [random.Random(seed).randbytes(500_000) for seed in range(4)]
    to_send = [BulkMessage(i, payload) for i, payload in enumerate(payloads)]
    bulk_key, report_key = (channel_key(channel, "studio", 0, "wall") for channel in (BULK, REPORT))
    clock, arrivals, delay, assembler = MonotonicClock(), BulkArrivals(), LeastDelay(), ChunkAssembler()
    messages: list[bytes] = []

    def on_chunk(arrival: Arrival) -> None:
        chunk = decode_chunk(arrival.payload)
        arrivals.note(chunk, len(arrival.payload))
        delay.note(chunk.send_ns, arrival.arrival_ns)
        message = assembler.push(chunk)
        if message is not None:
            messages.append(message)

    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        publisher = ChannelPublisher(ends.listener, BULK, bulk_key)
        delivered: list[object] = []
        sender = BulkSender(
            publisher, BulkWindow(7), 7, lambda _: to_send.pop(0) if to_send else None, delivered.append, clock
        )
        ChannelSubscriber(
            ends.listener, REPORT, report_key, lambda a: sender.on_report(decode_report(a.payload)), clock
        )
        ChannelSubscriber(ends.dialler, BULK, bulk_key, on_chunk, clock)
        reports = ChannelPublisher(ends.dialler, REPORT, report_key)
        task = asyncio.create_task(sender.run())
        async with asyncio.timeout(WITHIN_S):
            for number in itertools.count(1):
                if len(delivered) == 4:
                    break
                next_chunk, missing = arrivals.resolved()
                report = ReceiverReport(
                    number=number,
                    receiver_id=1,
                    receiver_epoch=1,
                    sender_epoch=arrivals.epoch,
                    clock_ns=clock.now_ns(),
                    skeleton_send_ns=None,
                    skeleton_hold_ns=0,
                    skeleton_delay_ns=None,
                    bulk_delay_ns=delay.take(),
                    bulk_bytes=arrivals.bulk_bytes,
                    next_chunk=next_chunk,
                    missing_chunks=missing,
                    body_revision=None,
                    repository_poses=0,
                )
                reports.put(encode_report(report))
                await asyncio.sleep(0.05)
        task.cancel()
    assert messages == payloads
    assert assembler.counts == {}


async def test_a_second_session_with_the_id_of_another_is_kept_out(endpoint: str, tmp_path: Path) -> None:
    """Ours are random; a file of Zenoh's own may fix one."""
    file = tmp_path / "zenoh.json5"
    file.write_text('{id: "abcdef0123456789"}')
    async with AsyncExitStack() as stack:
        ends = await pair(stack, endpoint)
        publisher, inbox = ChannelPublisher(ends.listener, SKELETON, KEY), Inbox(ends.dialler)
        twins = [
            await stack.enter_async_context(open_session(LinkSettings(connect=(endpoint,), config_file=file)))
            for _ in range(2)
        ]
        heard = [Inbox(twin) for twin in twins]
        await until(lambda: publisher.heard and len(ends.listener.zenoh.info.transports()) == 2)
        async with asyncio.timeout(WITHIN_S):
            while not (inbox.payloads and heard[0].payloads):
                publisher.put(b"pose")
                await asyncio.sleep(0.02)
        await asyncio.sleep(0.5)
        assert heard[1].payloads == []
        assert len(ends.listener.zenoh.info.transports()) == 2


async def test_a_port_in_use_is_named(endpoint: str) -> None:
    async with open_session(LinkSettings(listen=(endpoint,))):
        with pytest.raises(TransportError, match=f"cannot listen: {endpoint} is in use"):
            async with open_session(LinkSettings(listen=(endpoint,))):
                pass


async def test_a_name_that_does_not_resolve_is_named() -> None:
    settings = LinkSettings(listen=("tcp/nowhere.invalid:7447",))
    with pytest.raises(TransportError, match=r"tcp/nowhere\.invalid:7447 has a name that does not resolve"):
        async with open_session(settings):
            pass


@pytest.mark.parametrize(
    "locator", ["", "tcp", "7447", "127.0.0.1:7447", "tpc/a:1", "tcp/", "tcp/a", "tcp/a:", "tcp/a:99999", "tcp/a b:1"]
)
def test_malformed_locators_are_refused(locator: str) -> None:
    with pytest.raises(ValueError, match="connect: "):
        LinkSettings(connect=(locator,))


@pytest.mark.parametrize("locator", ["tcp/[::1]:7447", "tls/host.example:7448", "quic/h:1?rel=0#iface=lo", "tcp/h:0"])
def test_good_locators_are_accepted(locator: str) -> None:
    assert LinkSettings(listen=(locator,)).listen == (locator,)


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"lease_ms": -1}, "lease_ms"),
        ({"retry_ms": (1000, 100)}, "retry_ms"),
        ({"max_links": 0}, "max_links"),
        ({"max_message_bytes": 1}, "max_message_bytes"),
        ({"realm": "a/**"}, "realm"),
        ({"mode": "client", "listen": (DEFAULT_ENDPOINT,)}, "a client only dials"),
    ],
)
def test_settings_out_of_range_are_named(wrong: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        LinkSettings(**wrong)  # type: ignore[arg-type]


def read(config: zenoh.Config, key: str) -> object:
    return json.loads(config.get_json(key))


def test_a_dialling_daemon_does_not_listen_and_shared_memory_is_off(endpoint: str) -> None:
    config = zenoh_config(LinkSettings(connect=(endpoint,)))
    assert read(config, "listen/endpoints") == []
    assert read(config, "connect/endpoints") == [endpoint]
    assert read(config, "mode") == "peer"
    assert read(config, "transport/shared_memory/enabled") is False
    assert read(config, "transport/unicast/compression") == {"enabled": False}
    assert read(config, "transport/link/rx/max_message_size") == 1 << 20
    assert read(config, "scouting/multicast/enabled") is False
    assert read(config, "transport/link/tx/lease") == 3000
    assert read(config, "transport/link/protocols") == ["tcp"]


def test_zenohs_own_file_is_passed_through_below_our_settings(tmp_path: Path, endpoint: str) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(
        f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}, transport: {{unicast: {{max_sessions: 7}}}}}}'
    )
    config = zenoh_config(LinkSettings(config_file=path))
    assert read(config, "mode") == "client"
    assert read(config, "connect/endpoints") == [endpoint]
    assert read(config, "listen/endpoints") == []
    assert read(config, "transport/unicast/max_sessions") == 7
    assert read(config, "namespace") == "telepose"
    assert read(zenoh_config(LinkSettings(config_file=path, mode="peer", listen=(endpoint,))), "listen/endpoints") == [
        endpoint
    ]


@pytest.mark.parametrize("text", ["{mode: 'nobody'}", "{", "{nonsense: 1}"])
def test_a_file_zenoh_refuses_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(text)
    with pytest.raises(TransportError, match=r"zenoh\.json5"):
        zenoh_config(LinkSettings(config_file=path))


def test_roles_have_a_default_only_when_nothing_is_named(endpoint: str) -> None:
    assert with_endpoints(LinkSettings(), "sender").listen == (DEFAULT_ENDPOINT,)
    assert with_endpoints(LinkSettings(), "receiver").connect == (DEFAULT_ENDPOINT,)
    told = LinkSettings(connect=(endpoint,))
    assert with_endpoints(told, "sender") == told
    assert with_endpoints(dataclasses.replace(told, connect=(), config_file=Path("z")), "sender").listen == ()


OTHER = """
import asyncio, sys
from common.runtime.daemon import run_daemon, set_up_logging
from common.transport.channel_publisher import ChannelPublisher
from common.transport.channels import *
from common.transport.link_settings import LinkSettings
from common.transport.zenoh_session import open_session
set_up_logging()
key = channel_key(SKELETON, "studio", 0, layer=0)
async def main(daemon):
    async with open_session(LinkSettings({role}=("{endpoint}",))) as session:
        session.declare_presence(channel_key(SENDER_PRESENCE, "studio", 0))
        publisher = ChannelPublisher(session, SKELETON, key)
        daemon.announce_ready()
        while True:
            publisher.put(b"pose")
            await asyncio.sleep(0.01)
sys.exit(run_daemon("other", main))
"""
Start = Callable[[str, str], "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a publishing daemon that listens at or dials an endpoint; killed when the test ends."""
    processes: list[subprocess.Popen[str]] = []

    def run(role: str, endpoint: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", OTHER.format(role=role, endpoint=endpoint)]
        processes.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True))
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.communicate()


async def finished(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, log = await asyncio.to_thread(process.communicate, timeout=WITHIN_S)
    return process.returncode, log


@pytest.mark.parametrize("role", ["listen", "connect"])
async def test_a_killed_peer_is_noticed_and_seen_again_after_its_restart(
    start: Start, endpoint: str, role: str
) -> None:
    settings = LinkSettings(connect=(endpoint,)) if role == "listen" else LinkSettings(listen=(endpoint,))
    async with open_session(settings) as session:
        inbox, present = Inbox(session), list[bool]()
        session.watch_presence("v1/studio/0/sender", lambda _, there: present.append(there))
        for round_ in (1, 2):
            process = start(role, endpoint)
            await until(lambda count=round_: len(present) == 2 * count - 1 and bool(inbox.arrivals))  # type: ignore[misc]
            os.kill(process.pid, signal.SIGKILL)
            await until(lambda count=round_: len(present) == 2 * count)  # type: ignore[misc]
            inbox.arrivals.clear()
    assert present == [True, False, True, False]


async def test_a_daemon_with_a_session_ends_cleanly_on_a_signal(start: Start, endpoint: str) -> None:
    async with open_session(LinkSettings(listen=(endpoint,))) as session:
        inbox = Inbox(session)
        process = start("connect", endpoint)
        await until(lambda: bool(inbox.arrivals))
        process.send_signal(signal.SIGINT)
        assert (await finished(process))[0] == 0


async def test_a_daemon_that_still_dials_ends_cleanly_on_a_signal(start: Start, endpoint: str) -> None:
    process = start("connect", endpoint)
    assert process.stderr is not None
    while "ready" not in await asyncio.to_thread(process.stderr.readline):
        pass
    process.terminate()
    code, log = await finished(process)
    assert code == 0
    assert "left behind" not in log


async def test_a_daemon_ends_although_its_peer_is_stopped(start: Start, endpoint: str) -> None:
    """The peer's process is frozen: it acknowledges nothing, and closing must not wait for it."""
    frozen = start("listen", endpoint)
    process = start("connect", endpoint)
    for daemon in (frozen, process):
        assert daemon.stderr is not None
        while "ready" not in await asyncio.to_thread(daemon.stderr.readline):
            pass
    await asyncio.sleep(0.2)
    frozen.send_signal(signal.SIGSTOP)
    await asyncio.sleep(0.2)
    process.terminate()
    assert (await finished(process))[0] == 0


async def test_a_daemon_whose_port_is_in_use_says_so_and_fails(start: Start, endpoint: str) -> None:
    async with open_session(LinkSettings(listen=(endpoint,))):
        code, log = await finished(start("listen", endpoint))
    assert code == 1
    assert f"other failed: cannot listen: {endpoint} is in use by another program" in log
    assert "Traceback" not in log
