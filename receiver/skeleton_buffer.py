"""The newest skeleton wins; everything else is counted (DISPOSE §6.2: latency is the skeleton's alone).

A sender run is an *epoch*. The first packet of an unknown epoch starts it and retires the one before, so that nothing
late from an old run is ever shown again.
"""

from __future__ import annotations

from collections import Counter, deque

from common.transport.temporal_layers import LAYERS, between, layer_of
from common.wire.skeleton_packet import SkeletonPacket

RETIRED_EPOCHS = 16
CLOCK_SLACK_NS = 2_000_000_000
FASTEST_RATE_HZ = 240
FUTURE_RUN = 10  # so many packets from the future, each fit to follow the one before: then it is the newest that is odd


class SkeletonBuffer:
    """Judges each arriving packet. ``counts``: accepted, duplicate, stale, old_epoch, far_future, lost (of the layers
    taken), not taken (of the others), epochs."""

    def __init__(self) -> None:
        self.newest: SkeletonPacket | None = None
        self.counts: Counter[str] = Counter()
        self._arrival_ns = 0
        self._ahead: SkeletonPacket | None = None  # the last one refused as from the future
        self._ahead_ns = 0
        self._ahead_run = 0
        self._retired: deque[int] = deque(maxlen=RETIRED_EPOCHS)
        self._taken = self._coming = LAYERS

    def take(self, layers: int) -> None:
        """The lowest ``layers`` are taken from now on. What others have is not lost; of a layer that is new, nothing is
        before its first packet came."""
        self._taken = layers
        self._coming = min(self._coming, layers)

    def push(self, packet: SkeletonPacket, now_ns: int) -> bool:
        """Take a packet that arrived at ``now_ns`` (receiver's monotonic clock); True when it is the one to show."""
        verdict = self._judge(packet, now_ns)
        if verdict == "far_future" and self._is_the_present(packet, now_ns):
            verdict = "accepted"
        self.counts[verdict] += 1
        if verdict != "accepted":
            return False
        if self.newest is None or packet.epoch != self.newest.epoch:
            self.counts["epochs"] += 1
            if self.newest is not None:
                self._retired.append(self.newest.epoch)
        else:
            lost = between(self.newest.sequence, packet.sequence, self._coming)
            self.counts["lost"] += lost
            self.counts["not taken"] += packet.sequence - self.newest.sequence - 1 - lost
        self._coming = max(self._coming, min(layer_of(packet.sequence) + 1, self._taken))
        self.newest, self._arrival_ns = packet, now_ns
        self._ahead, self._ahead_run = None, 0
        return True

    def _is_the_present(self, packet: SkeletonPacket, now_ns: int) -> bool:
        """Whether the packets refused as from the future have become the stream: a first packet that was held up for
        seconds (a cold start, a jam on the link) must not make all later ones look too early for ever."""
        follows = self._ahead is not None and _follows(self._ahead, packet, now_ns - self._ahead_ns)
        self._ahead, self._ahead_ns = packet, now_ns
        self._ahead_run = self._ahead_run + 1 if follows else 1
        return self._ahead_run >= FUTURE_RUN

    def _judge(self, packet: SkeletonPacket, now_ns: int) -> str:
        newest = self.newest
        if packet.epoch in self._retired:
            return "old_epoch"
        if newest is None or packet.epoch != newest.epoch:
            return "accepted"
        if packet.sequence == newest.sequence:
            return "duplicate"
        if packet.sequence < newest.sequence or packet.capture_ns <= newest.capture_ns:
            return "stale"
        # A forged or broken packet from the future would make every honest one after it stale.
        return "accepted" if _follows(newest, packet, now_ns - self._arrival_ns) else "far_future"


def _follows(before: SkeletonPacket, packet: SkeletonPacket, passed_ns: int) -> bool:
    """Whether capture time and sequence went on from ``before`` as they can in the time between the arrivals."""
    advance_ns = packet.capture_ns - before.capture_ns
    frames = packet.sequence - before.sequence
    in_time = 0 < advance_ns <= passed_ns + CLOCK_SLACK_NS
    return packet.epoch == before.epoch and in_time and 0 < frames <= FASTEST_RATE_HZ * (advance_ns / 1e9 + 1)
