"""A network path in one direction, as arithmetic: rate and drop-tail queue, delay, jitter, loss, damage, outage.

Time is an argument, so the same model serves simulations in virtual time and the emulator that real packets cross:

    arrival → outage? → loss (independent, or in Gilbert–Elliott bursts) → drop-tail queue → serialiser → delay ± jitter
"""

from __future__ import annotations

import heapq
import random
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Generic, TypeVar

Packet = TypeVar("Packet")
S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class BurstLoss:
    """Gilbert–Elliott: a path turns bad with probability ``p`` at each packet and good again with ``r``, and loses
    packets with one probability or the other. E. N. Gilbert 1960, E. O. Elliott 1963."""

    p: float
    r: float
    loss_bad: float = 0.5
    loss_good: float = 0.0

    @property
    def mean(self) -> float:
        """The share of packets lost in the long run."""
        bad = self.p / (self.p + self.r)
        return bad * self.loss_bad + (1 - bad) * self.loss_good

    def __post_init__(self) -> None:
        for name in ("p", "r", "loss_bad", "loss_good"):
            _check_share(name, getattr(self, name))
        if self.p + self.r == 0:
            raise ValueError("burst: p and r cannot both be 0")


@dataclass(frozen=True, slots=True)
class LinkConditions:
    """What a path does to packets. ``rate_bps`` [bit/s], 0: without limit. ``delay_ms``: one way. ``queue_ms``: depth
    of the queue in front of the limit, in time at ``rate_bps``; ``queue_bytes`` instead fixes it when the rate changes.
    ``jitter_ms``: each packet's delay differs by up to ± this; packets overtake each other only with ``reorder``.
    ``loss``, ``damaged``, ``duplicates``: shares of packets. ``burst``: takes the place of ``loss``. ``outage``: all is
    lost."""

    rate_bps: float = 0.0
    delay_ms: float = 0.0
    queue_ms: float = 200.0
    queue_bytes: int | None = None
    jitter_ms: float = 0.0
    reorder: bool = False
    loss: float = 0.0
    burst: BurstLoss | None = None
    damaged: float = 0.0
    duplicates: float = 0.0
    outage: bool = False

    def __post_init__(self) -> None:
        for name in ("rate_bps", "delay_ms", "queue_ms", "jitter_ms"):
            if not 0 <= getattr(self, name) < 1e12:
                raise ValueError(f"{name}: {getattr(self, name)} is negative or not a number")
        if self.queue_bytes is not None and self.queue_bytes < 0:
            raise ValueError(f"queue_bytes: {self.queue_bytes} is negative")
        for name in ("loss", "damaged", "duplicates"):
            _check_share(name, getattr(self, name))

    @property
    def queue_room_bytes(self) -> float:
        """How many bytes may wait."""
        return self.queue_bytes if self.queue_bytes is not None else self.rate_bps / 8 * self.queue_ms / 1e3


def conditions_from(values: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of ``LinkConditions`` from JSON: ``burst`` is a list [p, r, loss_bad, loss_good].

    Raises:
        ValueError: an unknown name.
    """
    names = {field.name for field in fields(LinkConditions)}
    unknown = ", ".join(sorted(set(values) - names))
    if unknown:
        raise ValueError(f"a path has no {unknown}; it has {', '.join(sorted(names))}")
    burst = values.get("burst")
    return {**values, "burst": BurstLoss(*burst)} if burst is not None else dict(values)


def as_values(conditions: LinkConditions) -> dict[str, Any]:
    """``conditions_from`` the other way, without what is as by default."""
    plain = {name: value for name, value in asdict(conditions).items() if value != getattr(LinkConditions(), name)}
    return {name: list(value.values()) if name == "burst" else value for name, value in plain.items()}


@dataclass(order=True, slots=True)
class _OnItsWay(Generic[Packet]):
    due_ns: int
    order: int
    serialised_ns: int = field(compare=False)  # when its last bit has left the queue
    packet: Packet = field(compare=False)


class Link(Generic[Packet]):
    """One direction. ``put`` packets in, ``take`` them out when they are due. ``damage``: what happens to damaged ones.

    ``counts``: packets and bytes put in, delivered, and lost by cause. Deterministic for one ``seed``.
    """

    def __init__(
        self,
        conditions: LinkConditions,
        seed: int = 1,
        damage: Callable[[Packet, random.Random], Packet] = lambda packet, _: packet,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.conditions = conditions
        self._chance = random.Random(seed)
        self._damage = damage
        self._bad = False  # Gilbert–Elliott's state
        self._free_ns = 0  # when the serialiser is done with all that waits
        self._last_due_ns = 0
        self._on_their_way: list[_OnItsWay[Packet]] = []
        self._order = 0

    @property
    def next_due_ns(self) -> int | None:
        """When ``take`` has something next."""
        return self._on_their_way[0].due_ns if self._on_their_way else None

    def waiting_s(self, now_ns: int) -> float:
        """How long a packet put in now would wait in the queue [s]."""
        return max(0, self._free_ns - now_ns) / S

    def change(self, now_ns: int, **conditions: object) -> None:
        """Other conditions from now on, by the names of ``LinkConditions``. What waits in the queue goes out at the
        new rate; what has left it arrives as it was going to.

        Raises:
            TypeError, ValueError: an unknown name or an impossible value.
        """
        before = self.conditions
        self.conditions = replace(before, **conditions)  # type: ignore[arg-type]
        if before.rate_bps != self.conditions.rate_bps:
            slower = before.rate_bps / self.conditions.rate_bps if self.conditions.rate_bps else 0.0
            self._last_due_ns = now_ns
            for waiting in self._on_their_way:
                left_ns = waiting.serialised_ns - now_ns
                if left_ns > 0:
                    shift_ns = int(left_ns * slower) - left_ns
                    waiting.serialised_ns += shift_ns
                    waiting.due_ns += shift_ns
                self._last_due_ns = max(self._last_due_ns, waiting.due_ns)
            heapq.heapify(self._on_their_way)
            self._free_ns = now_ns + int(max(0, self._free_ns - now_ns) * slower)

    def put(self, packet: Packet, size: int, now_ns: int) -> None:
        """A packet of ``size`` bytes, headers included, enters; it may be lost."""
        now = self.conditions
        self.counts["packets"] += 1
        self.counts["bytes"] += size
        lost = "lost in outage" if now.outage else "lost by chance" if self._is_lost() else None
        if lost is None and now.rate_bps and self.waiting_s(now_ns) * now.rate_bps / 8 + size > now.queue_room_bytes:
            lost = "lost in queue" if self._free_ns > now_ns else None  # an empty queue takes any packet
        if lost is not None:
            self.counts[lost] += 1
            return
        if now.damaged and self._chance.random() < now.damaged:
            self.counts["damaged"] += 1
            packet = self._damage(packet, self._chance)
        self._free_ns = max(self._free_ns, now_ns)
        if now.rate_bps:
            self._free_ns += int(size * 8 / now.rate_bps * S)
        self._send(packet, self._free_ns)
        if now.duplicates and self._chance.random() < now.duplicates:
            self.counts["duplicated"] += 1
            self._send(packet, self._free_ns)

    def take(self, now_ns: int) -> Iterator[tuple[int, Packet]]:
        """The packets due by now, each with when it was due [ns]."""
        while self._on_their_way and self._on_their_way[0].due_ns <= now_ns:
            arrived = heapq.heappop(self._on_their_way)
            self.counts["delivered"] += 1
            yield arrived.due_ns, arrived.packet

    def _send(self, packet: Packet, serialised_ns: int) -> None:
        now = self.conditions
        jitter_ms = self._chance.uniform(-now.jitter_ms, now.jitter_ms) if now.jitter_ms else 0.0
        due_ns = serialised_ns + int(max(0.0, now.delay_ms + jitter_ms) * 1e6)
        if not now.reorder:
            due_ns = self._last_due_ns = max(due_ns, self._last_due_ns)
        self._order += 1
        heapq.heappush(self._on_their_way, _OnItsWay(due_ns, self._order, serialised_ns, packet))

    def _is_lost(self) -> bool:
        burst = self.conditions.burst
        if burst is None:
            return self.conditions.loss > 0 and self._chance.random() < self.conditions.loss
        if self._chance.random() < (burst.r if self._bad else burst.p):
            self._bad = not self._bad
        return self._chance.random() < (burst.loss_bad if self._bad else burst.loss_good)


def _check_share(name: str, value: float) -> None:
    if not 0 <= value <= 1:
        raise ValueError(f"{name}: {value} is not within 0..1")
