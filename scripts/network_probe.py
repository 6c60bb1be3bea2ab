"""The two ends of a stream without cameras and pictures, to measure networks; all between is the daemons' own.

A sender publishes 30 skeletons a second and, when told to, meshes without end; a receiver notes what arrives. Both are
processes on one host, whose monotonic clock they share, so the delay of a skeleton is simply a difference. Argument:
JSON of a ``ProbeSettings``; the sender's standard input takes the lines "bulk on" and "bulk off"; both run until it
ends and then write what they saw to ``out``.
"""

from __future__ import annotations

import asyncio
import json
import random
import secrets
import sys
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import uvloop

from common.body.skeleton import Skeleton, human_skeleton
from common.body.skeleton_pose import rest_pose
from common.runtime.clock import MonotonicClock
from common.transport.access_rules import for_receiver, for_sender, receiver_name
from common.transport.link_settings import LinkSettings
from common.transport.zenoh_session import ZenohSession, open_session
from common.wire.body_message import BodyMessage, encode_body
from common.wire.skeleton_packet import SkeletonPacket, encode_skeleton
from receiver.channels_in import Handlers, ReceiverChannels
from sender.candidate_poses.mesh_scheduler import MeshScheduler, Reason, SendRecord
from sender.channels_out import SenderChannels
from sender.receiver_links import ReceiverLinks

SITE, FRAME_S = "studio", 1 / 30
REPORT_S = 0.05  # as the receiver daemon does
MESH_BYTES = 100_000
MESH = random.Random(1).randbytes(MESH_BYTES)
CLOCK = MonotonicClock()


@dataclass(frozen=True, slots=True)
class ProbeSettings:
    """``address``: host:port of the sender. ``certificates``: the folder of this end's site, None: plain TCP."""

    role: Literal["sender", "receiver"]
    address: str
    out: str
    certificates: str | None = None
    name: str = "wall"

    def link(self) -> LinkSettings:
        locator = self.address if self.certificates else f"tcp/{self.address}"
        folder = Path(self.certificates) if self.certificates else None
        if self.role == "sender":
            return LinkSettings(listen=(locator,), certificates=folder)
        return LinkSettings(connect=(locator,), certificates=folder)


class EndlessMeshes(MeshScheduler):
    """Always has another mesh for everyone, while ``on``."""

    def __init__(self) -> None:
        super().__init__()
        self.on = False
        self._number = 0

    def next_for(self, receiver_id: str, budget_bytes: int, now_ns: int) -> tuple[int, bytes] | None:
        if not self.on:
            return None
        self._number += 1
        return self._number, MESH

    def sent(self, receiver_id: str, pose_id: int, now_ns: int) -> SendRecord | None:
        return SendRecord(receiver_id, pose_id, Reason.FIRST, 0.0, 0.0, 0.0, MESH_BYTES, 0, now_ns, now_ns)


async def until_input_ends(on_line: Any) -> None:
    """Hand every line of standard input on."""
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    while line := await reader.readline():
        on_line(line.decode().strip())


async def send(settings: ProbeSettings) -> dict[str, Any]:
    """The sender's end; what it sent, as JSON."""
    epoch, meshes = secrets.randbits(32), EndlessMeshes()
    sent: list[tuple[int, int]] = []  # sequence number, when [ns]
    # When, window and in flight [bytes], q [ms], rate [bit/s], the divisor of skeletons reported.
    trace: list[tuple[int, int, int, float, float, int]] = []
    allowed = for_sender(SITE, ("lobby",))
    async with open_session(settings.link(), allowed if settings.certificates else ()) as session:
        channels = SenderChannels(session, SITE, 0, CLOCK)
        links = ReceiverLinks(epoch, meshes, channels.bulk_publisher, lambda _: None, CLOCK)
        channels.open(links.on_report, links.on_repository, lambda: b"")
        channels.publish_body(encode_body(BodyMessage(0, epoch, 1, human_skeleton(1.7), 30.0)))

        async def publish() -> None:
            due_s, pose, sequence = asyncio.get_running_loop().time(), rest_pose(), 0
            while True:
                now_ns = CLOCK.now_ns()
                packet = SkeletonPacket(0, epoch, sequence, now_ns, 1, 1.0, pose, send_delay_ns=0)
                channels.publish_skeleton(encode_skeleton(packet), sequence)
                sent.append((sequence, now_ns))
                sequence += 1
                due_s += FRAME_S
                await asyncio.sleep(due_s - asyncio.get_running_loop().time())

        async def watch() -> None:
            while True:
                for window in (link.bulk.window for link in links.links):
                    now_ns, q_ms = CLOCK.now_ns(), window.queueing_delay_s * 1e3
                    what = window.window_bytes, window.in_flight_bytes, q_ms, window.rate_bytes_s * 8
                    trace.append((now_ns, *what, links.skeleton_divisor))
                await asyncio.sleep(REPORT_S)

        def obey(line: str) -> None:
            meshes.on = line == "bulk on"
            links.wake()

        tasks = [asyncio.create_task(part) for part in (links.run(), publish(), watch())]
        print("up", flush=True)
        await until_input_ends(obey)
        for task in tasks:
            task.cancel()
        outcomes = await asyncio.gather(*tasks, return_exceptions=True)
        failed = [outcome for outcome in outcomes if isinstance(outcome, Exception)]
        if failed:
            raise failed[0]
        counts: Counter[str] = sum((link.bulk.window.counts for link in links.links), Counter())
        return {"sent": sent, "window": counts, "links": links.counts, "trace": trace}


async def receive(settings: ProbeSettings) -> dict[str, Any]:
    """The receiver's end; what arrived, as JSON."""
    shown: list[tuple[int, int, int]] = []  # sequence number, when sent, when it arrived [ns]
    bulk: list[tuple[int, int]] = []  # when, bytes so far
    taken = [(0, 1)]  # from when, 1 in how many skeletons
    meshes: list[tuple[int, int]] = []  # when, bytes; 0: not the one that was sent
    name = receiver_name("lobby", settings.name) if settings.certificates else settings.name
    allowed = for_receiver(SITE, name) if settings.certificates else ()
    async with open_session(settings.link(), allowed) as session:
        channels = _receiving(session, name, shown, meshes)
        print("up", flush=True)

        async def report() -> None:
            while True:
                channels.send_report(len(meshes))
                if channels.skeleton_divisor != taken[-1][1]:
                    taken.append((CLOCK.now_ns(), channels.skeleton_divisor))
                bulk.append((CLOCK.now_ns(), channels.subscribers["bulk"].arrived_bytes))
                if channels.stream.lacks_body:
                    await channels.ask_body()
                await asyncio.sleep(REPORT_S)

        tasks = [asyncio.create_task(part) for part in (report(), channels.keep_session())]
        await until_input_ends(lambda line: None)
        for task in tasks:
            task.cancel()
        channels.close()
        counts = channels.stream.skeletons.counts | channels.stream.assembler.counts
        counts["not fresh"] = channels.freshness.stale
        for name, subscriber in channels.subscribers.items():
            counts |= {f"{name} {cause}": count for cause, count in subscriber.counts.items()}
        return {"shown": shown, "bulk": bulk, "meshes": meshes, "taken": taken, "counts": counts}


def _receiving(
    session: ZenohSession, name: str, shown: list[tuple[int, int, int]], meshes: list[tuple[int, int]]
) -> ReceiverChannels:
    channels = ReceiverChannels(session, SITE, 0, name, secrets.randbits(64), secrets.randbits(32), CLOCK)

    def on_skeleton(packet: SkeletonPacket, body: Skeleton, data: bytes) -> None:
        shown.append((packet.sequence, packet.capture_ns, CLOCK.now_ns()))

    channels.open(
        Handlers(
            skeleton=on_skeleton,
            pose=lambda message: meshes.append((CLOCK.now_ns(), len(message) if message == MESH else 0)),
            body=lambda message: None,
            epoch=lambda: None,
            presence=lambda there: None,
        )
    )
    return channels


def main() -> None:
    settings = ProbeSettings(**json.loads(sys.argv[1]))
    seen = uvloop.run((send if settings.role == "sender" else receive)(settings))
    Path(settings.out).write_text(json.dumps(asdict(settings) | seen))


if __name__ == "__main__":
    main()
