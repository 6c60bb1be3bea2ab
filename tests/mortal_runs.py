"""Runs of a sender's or a receiver's network part that end by SIGKILL at a given chunk: processes, forked from this one
so that only the first pays for the imports. Each line of standard input is the JSON of a ``Run``; when the run is over
its answer is one line: how it ended, and the digests of the whole messages it was given."""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import json
import os
import random
import secrets
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass

from common.body.skeleton import human_skeleton
from common.body.skeleton_pose import rest_pose
from common.runtime.clock import MonotonicClock
from common.transport.channel_publisher import ChannelPublisher
from common.transport.link_settings import LinkSettings
from common.transport.zenoh_session import ZenohSession, open_session
from common.wire.body_message import BodyMessage, encode_body
from common.wire.skeleton_packet import SkeletonPacket, encode_skeleton
from receiver.channels_in import Handlers, ReceiverChannels
from sender.candidate_poses.mesh_scheduler import MeshScheduler
from sender.candidate_poses.usable_pose_set import Quotients
from sender.channels_out import SenderChannels
from sender.receiver_links import ReceiverLinks

SITE = "studio"
MESSAGE_BYTES = 5_000
CLOCK = MonotonicClock()


@dataclass(frozen=True, slots=True)
class Run:
    """``role``: sender or receiver; it dials ``port``. ``dies_at``: with which chunk, None: it ends when a message is
    whole. ``seed``: of the sender's message."""

    role: str
    port: int
    dies_at: int | None
    seed: int = 0


def message_of(seed: int) -> bytes:
    """A message that nothing else is like; no residual packet."""
    return b"\x00" + random.Random(seed).randbytes(MESSAGE_BYTES - 1)


def digest_of(message: bytes) -> str:
    return hashlib.sha256(message).hexdigest()


def at_chunk(number: int | None) -> Callable[[], None]:
    """To be called with every chunk: with that one the process is killed."""
    chunks = itertools.count(1)

    def came() -> None:
        if next(chunks) == number:
            os.kill(os.getpid(), signal.SIGKILL)

    return came


class MortalPublisher:
    """A receiver's bulk channel whose process ends once a chunk is out."""

    def __init__(self, publisher: ChannelPublisher, dies_at: int | None) -> None:
        self._publisher, self._chunk = publisher, at_chunk(dies_at)

    def put(self, payload: bytes) -> None:
        self._publisher.put(payload)
        self._chunk()

    def close(self) -> None:
        self._publisher.close()


async def send(session: ZenohSession, message: bytes, dies_at: int | None, until: Callable[[], bool]) -> None:
    """A sender with one candidate pose for whoever comes, until it was delivered and ``until`` says so."""
    epoch, scheduler = secrets.randbits(32), MeshScheduler()
    scheduler.offer(1, message, 1, Quotients({1: 0.5}))
    channels = SenderChannels(session, SITE, 0, CLOCK)
    mortal = lambda name: MortalPublisher(channels.bulk_publisher(name), dies_at)  # noqa: E731
    links = ReceiverLinks(epoch, scheduler, mortal, lambda _: None, CLOCK)  # type: ignore[arg-type]
    channels.open(links.on_report, links.on_repository, lambda: b"")
    channels.publish_body(encode_body(BodyMessage(0, epoch, 1, human_skeleton(1.7), 30.0)))
    serving = asyncio.create_task(links.run())
    for sequence in itertools.count():
        packet = SkeletonPacket(0, epoch, sequence, CLOCK.now_ns(), 1, 1.0, rest_pose(), send_delay_ns=0)
        channels.publish_skeleton(encode_skeleton(packet), sequence)
        await asyncio.sleep(1 / 30)
        if links.delivered_poses and until():
            break
    serving.cancel()


async def receive(session: ZenohSession, dies_at: int | None, whole: list[str], until: Callable[[], bool]) -> None:
    """A receiver that notes the digests of whole messages, until ``until`` says so."""
    chunk = at_chunk(dies_at)
    record = lambda key, time_ns, payload: chunk() if "/bulk/" in key else None  # noqa: E731
    channels = ReceiverChannels(session, SITE, 0, "wall", secrets.randbits(64), secrets.randbits(32), CLOCK, record)
    nothing = lambda *_: None  # noqa: E731
    channels.open(Handlers(nothing, lambda message: whole.append(digest_of(message)), nothing, nothing, nothing))
    while not until():
        channels.send_report(0)
        await asyncio.sleep(0.05)
    channels.send_report(0)
    channels.close()


async def live(run: Run, answer: int) -> None:
    """One run, in a process of its own; the digests go to the pipe ``answer``."""
    async with open_session(LinkSettings(connect=(f"tcp/127.0.0.1:{run.port}",))) as session:
        if run.role == "sender":
            await send(session, message_of(run.seed), run.dies_at, lambda: True)
            return
        whole: list[str] = []
        await receive(session, run.dies_at, whole, lambda: bool(whole))
        os.write(answer, json.dumps(whole).encode())


def main() -> None:
    for line in sys.stdin:
        run = Run(**json.loads(line))
        ours, theirs = os.pipe()
        child = os.fork()
        if child == 0:
            asyncio.run(live(run, theirs))
            os._exit(0)
        os.close(theirs)
        with os.fdopen(ours) as answer:
            whole = json.loads(answer.read() or "[]")
        sys.stdout.write(
            json.dumps({"status": os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), "whole": whole}) + "\n"
        )
        sys.stdout.flush()


if __name__ == "__main__":
    main()
