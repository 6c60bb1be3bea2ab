"""Bulk beside skeletons over a simulated path, in virtual time: the real window, sender, chunks and reports.

A sender publishes 30 skeletons a second and messages without end; both directions are ``link_model`` links. A chunk is
one packet here (what TCP does below it is for the emulator to show). The receiver's clock is far from the sender's.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Hashable
from itertools import count

from common.body.skeleton_pose import rest_pose
from common.transport.bulk_sender import BulkMessage, BulkSender
from common.transport.bulk_window import BulkWindow, WindowSettings
from common.transport.chunks import ChunkAssembler, ChunkError, decode_chunk
from common.transport.reception import Reception
from common.transport.temporal_layers import layer_of
from common.wire.receiver_report import ReceiverReport
from common.wire.skeleton_packet import SkeletonPacket
from receiver.freshness import Freshness
from receiver.layer_subscription import LayerSubscription
from receiver.skeleton_buffer import SkeletonBuffer
from scripts.link_model import Link, LinkConditions
from scripts.virtual_time import VirtualTimeLoop, run_virtually

MS, S = 1_000_000, 1_000_000_000
EPOCH = 7
CLOCK_SKEW_NS = 1234 * S  # the receiver's clock minus the sender's
SKELETON_BYTES = 320  # on the wire, with the headers of TCP (transport.md §1)
REPORT_BYTES = 170
PACKET_BYTES, HEADER_BYTES = 1400, 60  # how much of a chunk fits into a packet, and what it costs
MESSAGE_BYTES = 200_000
POSE = rest_pose()
Deliver = Callable[[object], None]


def wire_bytes(size: int) -> int:
    """What a chunk of ``size`` bytes is on the wire."""
    return size + HEADER_BYTES * -(-size // PACKET_BYTES)


class Lane:
    """A link with somebody at its end, who is handed each packet when it is due."""

    def __init__(self, loop: VirtualTimeLoop, conditions: LinkConditions, seed: int, deliver: Deliver) -> None:
        self.link: Link[object] = Link(conditions, seed)
        self._loop = loop
        self._deliver = deliver
        self._timer: asyncio.TimerHandle | None = None

    def put(self, packet: object, size: int) -> None:
        self.link.put(packet, size, self._loop.now_ns())
        self._arm()

    def change(self, **conditions: object) -> None:
        self.link.change(self._loop.now_ns(), **conditions)
        self._arm()

    def _arm(self) -> None:
        due_ns = self.link.next_due_ns
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if due_ns is None else self._loop.at(due_ns, self._pump)

    def _pump(self) -> None:
        for _, packet in self.link.take(self._loop.now_ns()):
            self._deliver(packet)
        self._arm()


class BulkSimulation:
    """One sender and one receiver. ``there``, ``back``: the path's two directions.

    What happened: ``skeletons`` (when sent, how long under way) [ns], of them ``fresh`` those worth showing,
    ``divisors`` (from when, 1 in how many is taken), ``sent`` and ``arrived`` chunks (when, bytes), ``messages``: whole
    ones, ``wrong``: of them those that are not what was sent.
    """

    def __init__(
        self,
        there: LinkConditions,
        back: LinkConditions | None = None,
        settings: WindowSettings | None = None,
        skeleton_hz: float = 30.0,
        report_ms: float = 50.0,
    ) -> None:
        self.loop = VirtualTimeLoop()
        self.there = Lane(self.loop, there, 1, self._arrives)
        self.back = Lane(self.loop, back or there, 2, self._report_arrives)
        self.window = BulkWindow(EPOCH, settings)
        self.sender = BulkSender(self, self.window, EPOCH, self._next_message, self._on_delivered, self.loop)
        self.receiver_epoch = 1
        self.bulk = True
        self.skeletons: list[tuple[int, int]] = []
        self.sent: list[tuple[int, int]] = []
        self.arrived: list[tuple[int, int]] = []
        self.fresh: list[tuple[int, int]] = []
        self.divisors = [(0, 1)]
        self.messages = self.wrong = 0
        self.delivered: list[Hashable] = []
        self._skeleton_hz, self._report_s = skeleton_hz, report_ms / 1e3
        self._ids = count()
        self._payload = random.Random(3).randbytes(MESSAGE_BYTES)
        self.restart_receiver()

    def restart_receiver(self) -> None:
        """A new run of the receiver, which has nothing."""
        self.receiver_epoch += 1
        self._reception = Reception(1, self.receiver_epoch)
        self._assembler = ChunkAssembler()
        self._freshness = Freshness()
        self.layers = LayerSubscription()
        self._flowing = self.layers.layers  # at the sender
        self._buffer = SkeletonBuffer()

    def at(self, seconds: float, action: Callable[[], object]) -> None:
        """Do something at a time of the run."""
        self.loop.at(int(seconds * S), action)

    def run(self, seconds: float) -> BulkSimulation:
        """From the beginning until ``seconds``."""
        run_virtually(self._run(seconds), self.loop)
        return self

    async def _run(self, seconds: float) -> None:
        tasks = [self.loop.create_task(part) for part in (self.sender.run(), self._send_skeletons(), self._report())]
        await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_EXCEPTION)

    async def _send_skeletons(self) -> None:
        for sequence in count():
            if not self._skeleton_hz:
                break
            if layer_of(sequence) < self._flowing:
                packet = SkeletonPacket(0, EPOCH, sequence, self.loop.now_ns(), 0, 1.0, POSE)
                self.there.put(packet, SKELETON_BYTES)
            await asyncio.sleep(1 / self._skeleton_hz)
        await asyncio.Event().wait()

    async def _report(self) -> None:
        await asyncio.sleep(0.01)
        while True:
            now_ns = self.loop.now_ns()
            if self.layers.judge(self._buffer.counts["lost"], now_ns + CLOCK_SKEW_NS):
                self.divisors.append((now_ns, self.layers.divisor))
                self._buffer.take(self.layers.layers)
                told_ns = now_ns + int(self.back.link.conditions.delay_ms * MS)  # Zenoh's declarations are not lost
                self.loop.at(told_ns, self._subscribe, self.layers.layers)
            report = self._reception.report(now_ns + CLOCK_SKEW_NS, None, 0, 0, self.layers.carried_divisor)
            self.back.put(report, REPORT_BYTES)
            await asyncio.sleep(self._report_s)

    def _subscribe(self, layers: int) -> None:
        self._flowing = layers

    def put(self, payload: bytes) -> None:
        """The bulk sender's publisher."""
        self.sent.append((self.loop.now_ns(), len(payload)))
        self.there.put(payload, wire_bytes(len(payload)))

    def _next_message(self, budget_bytes: int) -> BulkMessage | None:
        return BulkMessage(next(self._ids), self._payload) if self.bulk else None

    def _on_delivered(self, name: Hashable) -> None:
        self.delivered.append(name)

    def _arrives(self, packet: object) -> None:
        now_ns = self.loop.now_ns()
        if isinstance(packet, SkeletonPacket):
            if layer_of(packet.sequence) < self.layers.layers:
                self._skeleton_arrives(packet, now_ns)
        elif isinstance(packet, bytes):
            self.arrived.append((now_ns, len(packet)))
            chunk = decode_chunk(packet)
            try:
                message = self._assembler.push(chunk)
            except ChunkError:
                self.wrong += 1
                return
            self._reception.chunk(chunk, len(packet), now_ns + CLOCK_SKEW_NS)
            self.layers.bulk(len(packet))
            if message is not None:
                self._on_message(message, now_ns)

    def _skeleton_arrives(self, packet: SkeletonPacket, now_ns: int) -> None:
        arrival_ns = now_ns + CLOCK_SKEW_NS
        if not self._buffer.push(packet, arrival_ns):
            return
        self.skeletons.append((packet.send_ns, now_ns - packet.send_ns))
        if self._freshness.is_fresh(EPOCH, packet.send_ns, arrival_ns):
            self.fresh.append(self.skeletons[-1])
        self._reception.skeleton(EPOCH, packet.send_ns, arrival_ns)
        self.layers.skeleton(EPOCH, packet.send_ns, arrival_ns)

    def _on_message(self, message: bytes, now_ns: int) -> None:
        """A message is complete."""
        self.messages += 1
        self.wrong += message != self._payload

    def _report_arrives(self, packet: object) -> None:
        assert isinstance(packet, ReceiverReport)
        self.window.trickle = packet.skeleton_divisor > 1
        self.sender.on_report(packet)

    def goodput_bps(self, begin_s: float, end_s: float) -> float:
        """Bytes of chunks that arrived, per second."""
        inside = (size for when_ns, size in self.arrived if begin_s * S <= when_ns < end_s * S)
        return sum(inside) * 8 / (end_s - begin_s)

    def over_idle_ms(self, begin_s: float, end_s: float, percent: float = 99.0) -> float:
        """A percentile of how much longer skeletons sent in a span took than they do on the idle path [ms]."""
        path = self.there.link.conditions
        idle_ns = int(path.delay_ms * MS + (SKELETON_BYTES * 8 / path.rate_bps * S if path.rate_bps else 0))
        extra = sorted(delay - idle_ns for sent, delay in self.skeletons if begin_s * S <= sent < end_s * S)
        return extra[min(len(extra) - 1, int(len(extra) * percent / 100))] / MS


class Competitor:
    """A download over the same queue that behaves as TCP Reno does: it fills the queue until it overflows."""

    def __init__(self, simulation: BulkSimulation, begin_s: float, end_s: float) -> None:
        self._simulation = simulation
        self._window, self._slow_start = 10.0, True
        self._in_flight = 0
        self._halved_ns = 0
        simulation.at(begin_s, self._fill)
        self._end_ns = int(end_s * S)

    def _fill(self) -> None:
        loop, link = self._simulation.loop, self._simulation.there.link
        if loop.now_ns() >= self._end_ns:
            return
        while self._in_flight < self._window:
            self._in_flight += 1
            lost = link.counts["lost in queue"]
            self._simulation.there.put(None, 1500)
            answer_ns = int(2 * link.conditions.delay_ms * MS + link.waiting_s(loop.now_ns()) * S)
            loop.at(loop.now_ns() + answer_ns, self._answer, link.counts["lost in queue"] > lost)

    def _answer(self, lost: bool) -> None:
        now_ns = self._simulation.loop.now_ns()
        self._in_flight -= 1
        if lost and now_ns > self._halved_ns:
            self._window, self._slow_start = max(2.0, self._window / 2), False
            self._halved_ns = now_ns + int(2.5 * self._simulation.there.link.conditions.delay_ms * MS) + 200 * MS
        elif not lost:
            self._window += 1.0 if self._slow_start else 1 / self._window
        self._fill()
