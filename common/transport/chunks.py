"""Large messages in small chunks: cutting, numbering, and putting together again what arrives, within bounds.

A message is a row of blocks of ``BLOCK_BYTES``; a chunk carries a run of whole blocks (the last one may be short), so
chunks can shrink in the middle of a message when the link gets slower. Every transmission of a chunk, repeats included,
has a new sequence number. Pure: no clock, no I/O.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass

from common.wire.header import TIME_MAX_NS, U32_MAX, WireError

CHUNK_VERSION = 0x61
BLOCK_BYTES = 1024
CHUNK_MAX_BYTES = 32 << 10
MESSAGE_MAX_BYTES = 4 << 20

# version, sequence number - oldest sequence number, epoch, message id, first block, total length, CRC-32 of the
# message, sequence number, send time [ns], CRC-32 of this chunk with these four bytes zero
_HEADER = struct.Struct("<BxHIIIIIQQI")
HEADER_BYTES = _HEADER.size
_CHECKSUM = struct.Struct("<I")
_CHECKSUM_AT = HEADER_BYTES - _CHECKSUM.size
CHUNK_MIN_BYTES = HEADER_BYTES + 1
BLOCKS_PER_CHUNK = (CHUNK_MAX_BYTES - HEADER_BYTES) // BLOCK_BYTES


class ChunkError(WireError):
    """A chunk that cannot be used; the text is the exact reason."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """One transmission of blocks ``first_block``, ... of a message of ``total_bytes`` with CRC-32 ``checksum``.

    ``sequence``: of this transmission; ``oldest_sequence``: the lowest one the sender still waits to hear of.
    ``send_ns``: the sender's monotonic clock [ns]. ``payload``: whole blocks, but for the message's end.
    """

    epoch: int
    message_id: int
    first_block: int
    total_bytes: int
    checksum: int
    sequence: int
    oldest_sequence: int
    send_ns: int
    payload: bytes


def block_count(total_bytes: int) -> int:
    """How many blocks a message of ``total_bytes`` has."""
    return -(-total_bytes // BLOCK_BYTES)


def encode_chunk(chunk: Chunk) -> bytes:
    """At most ``CHUNK_MAX_BYTES``.

    Raises:
        ChunkError: a field outside its range, or a payload that is not what its position demands.
    """
    _check(chunk)
    what = (chunk.epoch, chunk.message_id, chunk.first_block, chunk.total_bytes, chunk.checksum)
    waiting = chunk.sequence - chunk.oldest_sequence
    try:
        data = _HEADER.pack(CHUNK_VERSION, waiting, *what, chunk.sequence, chunk.send_ns, 0) + chunk.payload
    except struct.error as error:
        raise ChunkError(f"chunk: {error}") from error
    return data[:_CHECKSUM_AT] + _CHECKSUM.pack(zlib.crc32(data)) + data[HEADER_BYTES:]


def decode_chunk(data: bytes) -> Chunk:
    """The chunk of ``encode_chunk``'s bytes.

    Raises:
        ChunkError: not a chunk, damaged, or a payload that is not what its position demands.
    """
    if not CHUNK_MIN_BYTES <= len(data) <= CHUNK_MAX_BYTES:
        raise ChunkError(f"chunk: {len(data)} bytes, expected {CHUNK_MIN_BYTES}..{CHUNK_MAX_BYTES}")
    if data[0] != CHUNK_VERSION:
        raise ChunkError(f"chunk: version byte 0x{data[0]:02x}, expected 0x{CHUNK_VERSION:02x}")
    _, waiting, epoch, message_id, first, total, checksum, sequence, send_ns, own = _HEADER.unpack_from(data)
    if zlib.crc32(data[:_CHECKSUM_AT] + bytes(4) + data[HEADER_BYTES:]) != own:
        raise ChunkError("chunk: damaged, its checksum does not match")
    oldest = sequence - waiting
    chunk = Chunk(epoch, message_id, first, total, checksum, sequence, oldest, send_ns, data[HEADER_BYTES:])
    _check(chunk)
    return chunk


def _check(chunk: Chunk) -> None:
    if chunk.oldest_sequence < 0 or chunk.send_ns > TIME_MAX_NS:
        raise ChunkError(f"chunk: oldest sequence {chunk.oldest_sequence}, send time {chunk.send_ns} out of range")
    if not 1 <= chunk.total_bytes <= MESSAGE_MAX_BYTES:
        raise ChunkError(f"chunk: message of {chunk.total_bytes} bytes, expected 1..{MESSAGE_MAX_BYTES}")
    blocks = block_count(chunk.total_bytes)
    if not 0 <= chunk.first_block < blocks:
        raise ChunkError(f"chunk: block {chunk.first_block} of a message of {blocks}")
    room = min(chunk.total_bytes - chunk.first_block * BLOCK_BYTES, BLOCKS_PER_CHUNK * BLOCK_BYTES)
    size = len(chunk.payload)
    if not 0 < size <= room:
        raise ChunkError(f"chunk: {size} bytes of payload at block {chunk.first_block}, expected 1..{room}")
    ends_message = chunk.first_block * BLOCK_BYTES + size == chunk.total_bytes
    if size % BLOCK_BYTES and not ends_message:
        raise ChunkError(f"chunk: {size} bytes of payload are not whole blocks")


class OutgoingMessage:
    """A message being sent: which of its blocks still have to go out, and which are known to have arrived."""

    def __init__(self, message_id: int, payload: bytes) -> None:
        """
        Raises:
            ValueError: no bytes, too many, or an id outside u32.
        """
        if not 1 <= len(payload) <= MESSAGE_MAX_BYTES:
            raise ValueError(f"message of {len(payload)} bytes, expected 1..{MESSAGE_MAX_BYTES}")
        if not 0 <= message_id <= U32_MAX:
            raise ValueError(f"message id {message_id} is outside u32")
        self.message_id = message_id
        self.payload = payload
        self.checksum = zlib.crc32(payload)
        self._to_send: deque[range] = deque([range(block_count(len(payload)))])
        self._not_arrived = block_count(len(payload))
        self._arrived = bytearray(self._not_arrived)

    @property
    def all_sent(self) -> bool:
        """Whether no block waits to be sent (again)."""
        return not self._to_send

    @property
    def all_arrived(self) -> bool:
        return self._not_arrived == 0

    def take(self, chunk_bytes: int) -> range:
        """The next run of blocks that fits into a chunk of ``chunk_bytes``, at least one block.

        Raises:
            LookupError: ``all_sent``.
        """
        if not self._to_send:
            raise LookupError(f"message {self.message_id} has nothing left to send")
        run = self._to_send.popleft()
        count = min(max(1, (chunk_bytes - HEADER_BYTES) // BLOCK_BYTES), BLOCKS_PER_CHUNK)
        if run[count:]:
            self._to_send.appendleft(run[count:])
        return run[:count]

    def chunk(self, blocks: range, epoch: int, sequence: int, oldest_sequence: int, send_ns: int) -> bytes:
        """The encoded chunk that carries ``blocks``; the numbers as in ``Chunk``."""
        part = self.payload[blocks.start * BLOCK_BYTES : blocks.stop * BLOCK_BYTES]
        what = (epoch, self.message_id, blocks.start, len(self.payload), self.checksum)
        return encode_chunk(Chunk(*what, sequence, oldest_sequence, send_ns, part))

    def arrived(self, blocks: range) -> None:
        """The receiver has these blocks."""
        for block in blocks:
            self._not_arrived -= not self._arrived[block]
            self._arrived[block] = 1

    def lost(self, blocks: range) -> None:
        """Send these blocks again, before what was never sent."""
        self._to_send.appendleft(blocks)


class _Partial:
    """A message of which some blocks have arrived."""

    def __init__(self, chunk: Chunk) -> None:
        self.total_bytes = chunk.total_bytes
        self.checksum = chunk.checksum
        self.data = bytearray(chunk.total_bytes)
        self._arrived = bytearray(block_count(chunk.total_bytes))
        self._missing = len(self._arrived)

    @property
    def complete(self) -> bool:
        return self._missing == 0

    def add(self, chunk: Chunk) -> bool:
        """Take over the chunk's blocks; False when all of them were there."""
        begin = chunk.first_block * BLOCK_BYTES
        blocks = slice(chunk.first_block, chunk.first_block + block_count(len(chunk.payload)))
        new = self._arrived[blocks].count(0)
        self.data[begin : begin + len(chunk.payload)] = chunk.payload
        self._arrived[blocks] = bytes([1]) * (blocks.stop - blocks.start)
        self._missing -= new
        return new > 0


class ChunkAssembler:
    """Puts the messages of one sender together again.

    Bounded: at most ``max_messages`` unfinished ones of at most ``max_bytes`` in all; the one that waited longest for
    a chunk goes first. ``counts``: by cause, what was refused or given up.
    """

    def __init__(self, max_messages: int = 32, max_bytes: int = 4 * MESSAGE_MAX_BYTES) -> None:
        self.counts: Counter[str] = Counter()
        self.epoch: int | None = None
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._old_epochs: deque[int] = deque(maxlen=16)
        self._unfinished: OrderedDict[int, _Partial] = OrderedDict()
        self._finished: deque[int] = deque(maxlen=64)

    @property
    def unfinished_bytes(self) -> int:
        return sum(partial.total_bytes for partial in self._unfinished.values())

    def push(self, chunk: Chunk) -> bytes | None:
        """The whole message when ``chunk`` was its last missing one, else None. A new epoch drops all of the old one.

        Raises:
            ChunkError: of an old epoch, at odds with earlier chunks of the message, or the finished message does not
                match its checksum. Each is counted.
        """
        self._follow_epoch(chunk.epoch)
        if chunk.message_id in self._finished:
            self.counts["duplicate"] += 1
            return None
        partial = self._unfinished.setdefault(chunk.message_id, _Partial(chunk))
        if (partial.total_bytes, partial.checksum) != (chunk.total_bytes, chunk.checksum):
            raise self._refused("conflicting", f"message {chunk.message_id}: length or checksum has changed")
        self._unfinished.move_to_end(chunk.message_id)
        self._evict()
        if not partial.add(chunk):
            self.counts["duplicate"] += 1
        if not partial.complete:
            return None
        del self._unfinished[chunk.message_id]
        self._finished.append(chunk.message_id)
        if zlib.crc32(partial.data) != partial.checksum:
            raise self._refused("damaged", f"message {chunk.message_id}: its checksum does not match")
        return bytes(partial.data)

    def _follow_epoch(self, epoch: int) -> None:
        if epoch == self.epoch:
            return
        if epoch in self._old_epochs:
            raise self._refused("old epoch", f"chunk of epoch {epoch}, now it is {self.epoch}")
        if self.epoch is not None:
            self._old_epochs.append(self.epoch)
        self.epoch = epoch
        self._unfinished.clear()
        self._finished.clear()

    def _evict(self) -> None:
        while len(self._unfinished) > self._max_messages or self.unfinished_bytes > self._max_bytes:
            self._unfinished.popitem(last=False)
            self.counts["evicted"] += 1

    def _refused(self, cause: str, reason: str) -> ChunkError:
        self.counts[cause] += 1
        return ChunkError(reason)
