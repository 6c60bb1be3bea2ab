"""One person's stream as it comes in: payloads of the channels in, what is worth showing out. Pure: no network.

The live receiver feeds it what Zenoh delivers, the player of a session what its file holds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from common.body.skeleton import Skeleton
from common.transport.chunks import Chunk, ChunkAssembler
from common.wire.body_message import BodyMessage, decode_body
from common.wire.header import WireError
from common.wire.skeleton_packet import SkeletonPacket, decode_skeleton
from receiver.skeleton_buffer import SkeletonBuffer


@dataclass(frozen=True, slots=True, eq=False)
class NewestSkeleton:
    """A skeleton that is the newest now. ``body``: its sizes, None while they are unknown; ``new_epoch``: with it a new
    run of the sender begins."""

    packet: SkeletonPacket
    body: Skeleton | None
    new_epoch: bool


@dataclass(slots=True)
class _Bodies:
    """Sizes by revision, of one sender epoch."""

    epoch: int | None = None
    by_revision: dict[int, Skeleton] = field(default_factory=dict)
    newest_revision: int | None = None


class IncomingStream:
    """The stream of ``person``. ``counts``: skeletons whose body was unknown."""

    def __init__(self, person: int) -> None:
        self.counts: Counter[str] = Counter()
        self.skeletons = SkeletonBuffer()
        self.assembler = ChunkAssembler()
        self._person = person
        self._bodies = _Bodies()

    @property
    def body_revision(self) -> int | None:
        """Of the body that came last."""
        return self._bodies.newest_revision

    def bodies(self, epoch: int) -> Mapping[int, Skeleton]:
        """The sizes known by revision, of that run of the sender."""
        return self._bodies.by_revision if epoch == self._bodies.epoch else {}

    @property
    def lacks_body(self) -> bool:
        """A skeleton came whose body has not."""
        newest = self.skeletons.newest
        return newest is not None and self._body_of(newest) is None

    def skeleton(self, payload: bytes, arrival_ns: int) -> NewestSkeleton | None:
        """A skeleton packet arrived at ``arrival_ns`` (our clock); None when a newer one is here.

        Raises:
            WireError: it is malformed or another person's.
        """
        packet = decode_skeleton(payload)
        if packet.person != self._person:
            raise WireError(f"skeleton of person {packet.person} under person {self._person}'s key")
        before = self.skeletons.newest
        if not self.skeletons.push(packet, arrival_ns):
            return None
        body = self._body_of(packet)
        self.counts["body unknown"] += body is None
        return NewestSkeleton(packet, body, before is not None and before.epoch != packet.epoch)

    def body(self, payload: bytes) -> BodyMessage:
        """A body message arrived.

        Raises:
            WireError: it is malformed or another person's.
        """
        message = decode_body(payload)
        if message.person != self._person:
            raise WireError(f"body of person {message.person} under person {self._person}'s key")
        if message.epoch != self._bodies.epoch:
            self._bodies = _Bodies(message.epoch)
        self._bodies.by_revision[message.revision] = message.skeleton
        self._bodies.newest_revision = message.revision
        return message

    def chunk(self, chunk: Chunk) -> bytes | None:
        """A chunk arrived; the whole message when it was the last one missing.

        Raises:
            ChunkError: it is at odds with others.
        """
        return self.assembler.push(chunk)

    def _body_of(self, packet: SkeletonPacket) -> Skeleton | None:
        return self._bodies.by_revision.get(packet.body_revision) if packet.epoch == self._bodies.epoch else None
