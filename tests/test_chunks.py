"""Chunks: what is cut is put together again, whatever happens on the way; the rest is refused and counted."""

from __future__ import annotations

import random
import struct
import zlib
from dataclasses import replace
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.transport.bulk_arrivals import BulkArrivals, LeastDelay
from common.transport.chunks import (
    BLOCK_BYTES,
    CHUNK_MAX_BYTES,
    HEADER_BYTES,
    MESSAGE_MAX_BYTES,
    Chunk,
    ChunkAssembler,
    ChunkError,
    OutgoingMessage,
    decode_chunk,
    encode_chunk,
)
from common.wire.receiver_report import MAX_MISSING_CHUNKS

SMALL = Chunk(
    epoch=1, message_id=2, first_block=0, total_bytes=4, checksum=0x9BE3E0A3, sequence=9, oldest_sequence=5, send_ns=77,
    payload=b"1234",
)  # fmt: skip


def cut(payload: bytes, chunk_bytes: int = 5000, message_id: int = 1, epoch: int = 1) -> list[Chunk]:
    message, numbers, chunks = OutgoingMessage(message_id, payload), count(), []
    while not message.all_sent:
        sequence = next(numbers)
        data = message.chunk(message.take(chunk_bytes), epoch, sequence, 0, 1000)
        assert len(data) <= max(chunk_bytes, HEADER_BYTES + BLOCK_BYTES)
        chunks.append(decode_chunk(data))
    return chunks


def noise(size: int, seed: int = 1) -> bytes:
    return random.Random(seed).randbytes(size)


def test_the_format_is_what_it_was() -> None:
    golden = bytes.fromhex(
        "6100040001000000020000000000000004000000a3e0e39b09000000000000004d000000000000000c22512531323334"
    )
    assert encode_chunk(SMALL) == golden
    assert decode_chunk(golden) == SMALL


@given(
    st.binary(min_size=1, max_size=40_000), st.integers(1, 40_000), st.randoms(use_true_random=False), st.integers(0, 5)
)
def test_in_any_order_and_with_repeats_the_message_comes_out_once(
    payload: bytes, chunk_bytes: int, chance: random.Random, repeats: int
) -> None:
    chunks = cut(payload, chunk_bytes)
    chunks += chance.choices(chunks, k=repeats)
    chance.shuffle(chunks)
    assembler = ChunkAssembler()
    out = [message for chunk in chunks if (message := assembler.push(chunk)) is not None]
    assert out == [payload]
    assert assembler.counts == ({"duplicate": repeats} if repeats else {})
    assert assembler.unfinished_bytes == 0


def test_chunks_may_change_their_size_in_the_middle_of_a_message() -> None:
    payload, message, assembler, out = noise(50_000), OutgoingMessage(1, noise(50_000)), ChunkAssembler(), []
    for sequence, size in enumerate([32_768, 1200, 1, 9000, 40_000]):
        if not message.all_sent:
            data = message.chunk(message.take(size), 1, sequence, 0, 0)
            assert len(data) <= CHUNK_MAX_BYTES
            out.append(assembler.push(decode_chunk(data)))
    assert out[-1] == payload


def test_lost_chunks_go_again_first_and_arrival_is_known() -> None:
    message = OutgoingMessage(1, noise(10 * BLOCK_BYTES))
    runs = [message.take(HEADER_BYTES + 2 * BLOCK_BYTES) for _ in range(3)]
    message.arrived(runs[0])
    message.lost(runs[1])
    assert message.take(HEADER_BYTES + BLOCK_BYTES) == range(2, 3)
    assert message.take(CHUNK_MAX_BYTES) == range(3, 4)
    assert message.take(CHUNK_MAX_BYTES) == range(6, 10)
    assert message.all_sent
    with pytest.raises(LookupError):
        message.take(1000)
    for run in (runs[0], runs[1], runs[2]):
        message.arrived(run)
    assert not message.all_arrived
    message.arrived(range(6, 10))
    assert message.all_arrived


@pytest.mark.parametrize("size", [0, MESSAGE_MAX_BYTES + 1])
def test_messages_of_impossible_sizes_are_refused(size: int) -> None:
    with pytest.raises(ValueError, match=f"message of {size} bytes"):
        OutgoingMessage(1, bytes(size))


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_no_chunk(data: bytes) -> None:
    with pytest.raises(ChunkError):
        decode_chunk(data)


@given(st.integers(0, HEADER_BYTES + 3), st.integers(1, 255))
def test_any_flipped_byte_is_noticed(position: int, flip: int) -> None:
    data = bytearray(encode_chunk(SMALL))
    data[position] ^= flip
    with pytest.raises(ChunkError):
        decode_chunk(bytes(data))


@given(st.integers(0, HEADER_BYTES + 3))
def test_every_truncation_is_noticed(length: int) -> None:
    with pytest.raises(ChunkError):
        decode_chunk(encode_chunk(SMALL)[:length])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"first_block": 1}, "block 1 of a message of 1"),
        ({"total_bytes": 0}, "message of 0 bytes"),
        ({"total_bytes": MESSAGE_MAX_BYTES + 1}, f"message of {MESSAGE_MAX_BYTES + 1} bytes"),
        ({"total_bytes": (1 << 32) - 1}, "message of 4294967295 bytes"),
        ({"total_bytes": 3}, "4 bytes of payload at block 0, expected 1..3"),
        ({"total_bytes": 5}, "not whole blocks"),
        ({"payload": b""}, "0 bytes of payload"),
        ({"oldest_sequence": -1}, "out of range"),
        ({"send_ns": 1 << 63}, "out of range"),
        ({"oldest_sequence": 10}, "chunk: "),
        ({"epoch": 1 << 32}, "chunk: "),
    ],
)
def test_impossible_fields_are_refused_when_encoding(change: dict[str, int], reason: str) -> None:
    with pytest.raises(ChunkError, match=reason):
        encode_chunk(replace(SMALL, **change))  # type: ignore[arg-type]


def test_impossible_fields_with_a_right_checksum_are_refused_when_decoding() -> None:
    data = bytearray(encode_chunk(SMALL))
    struct.pack_into("<I", data, 12, 7)  # first block
    data[HEADER_BYTES - 4 : HEADER_BYTES] = bytes(4)
    struct.pack_into("<I", data, HEADER_BYTES - 4, zlib.crc32(data))
    with pytest.raises(ChunkError, match="block 7 of a message of 1"):
        decode_chunk(bytes(data))


def test_other_versions_are_named() -> None:
    with pytest.raises(ChunkError, match="version byte 0x62"):
        decode_chunk(b"\x62" + encode_chunk(SMALL)[1:])


@pytest.mark.parametrize("change", [{"total_bytes": 6000}, {"checksum": 1}])
def test_a_message_cannot_change_its_length_or_checksum(change: dict[str, int]) -> None:
    payload = noise(7000)
    first, second = cut(payload)
    assembler = ChunkAssembler()
    assembler.push(first)
    with pytest.raises(ChunkError, match="length or checksum has changed"):
        assembler.push(replace(first, **change))  # type: ignore[arg-type]
    assert assembler.push(second) == payload  # what came before is not harmed
    assert assembler.counts == {"conflicting": 1}


def test_a_finished_message_with_a_wrong_byte_is_refused() -> None:
    assembler = ChunkAssembler()
    first, second = cut(noise(7000))
    assembler.push(first)
    with pytest.raises(ChunkError, match="checksum does not match"):
        assembler.push(replace(second, payload=bytes(len(second.payload))))
    assert assembler.counts == {"damaged": 1}
    assert assembler.unfinished_bytes == 0


def test_unfinished_messages_are_bounded_and_the_one_that_waited_longest_goes() -> None:
    assembler = ChunkAssembler(max_messages=3)
    messages = {i: cut(noise(7000, i), message_id=i) for i in range(5)}
    for i in range(3):
        assembler.push(messages[i][0])
    assembler.push(messages[0][0])  # heard of again
    assembler.push(messages[3][0])
    assert assembler.counts == {"duplicate": 1, "evicted": 1}
    assert assembler.push(messages[0][1]) == noise(7000, 0)
    assert assembler.push(messages[1][1]) is None  # 1 had waited longest: begins anew


def test_a_million_ids_and_huge_announcements_take_bounded_memory() -> None:
    assembler = ChunkAssembler(max_messages=4, max_bytes=2 * MESSAGE_MAX_BYTES)
    block = bytes(BLOCK_BYTES)
    for i in range(1000):
        assembler.push(Chunk(1, i, 0, MESSAGE_MAX_BYTES, 0, i, 0, 0, block))
        assert assembler.unfinished_bytes <= 2 * MESSAGE_MAX_BYTES
    assert assembler.counts["evicted"] == 998


def test_a_new_epoch_drops_the_old_one_for_good() -> None:
    old, new = cut(noise(7000), epoch=1), cut(noise(7000, 2), epoch=2)
    assembler = ChunkAssembler()
    assembler.push(old[0])
    assembler.push(new[0])
    assert assembler.epoch == 2
    with pytest.raises(ChunkError, match="chunk of epoch 1, now it is 2"):
        assembler.push(old[1])
    assert assembler.push(new[1]) == noise(7000, 2)
    assert assembler.counts == {"old epoch": 1}


def arrive(arrivals: BulkArrivals, *sequences: int, oldest: int = 0, epoch: int = 1) -> None:
    for sequence in sequences:
        arrivals.note(replace(SMALL, sequence=sequence, oldest_sequence=oldest, epoch=epoch), 100)


def test_gaps_are_missing_until_they_come_or_the_sender_no_longer_waits() -> None:
    arrivals = BulkArrivals()
    assert arrivals.resolved() == (0, ())
    arrive(arrivals, 0, 1, 4, 6)
    assert arrivals.resolved() == (7, (2, 3, 5))
    arrive(arrivals, 3)
    assert arrivals.resolved() == (7, (2, 5))
    arrive(arrivals, 7, oldest=5)
    assert arrivals.resolved() == (8, (5,))
    assert arrivals.bulk_bytes == 600


def test_a_late_joiner_misses_nothing_of_before() -> None:
    arrivals = BulkArrivals()
    arrive(arrivals, 1_000_002, oldest=1_000_000)
    assert arrivals.resolved() == (1_000_003, (1_000_000, 1_000_001))


def test_a_long_list_of_missing_chunks_is_cut_where_it_can_go_on() -> None:
    arrivals = BulkArrivals()
    arrive(arrivals, 1000)
    next_chunk, missing = arrivals.resolved()
    assert missing == tuple(range(MAX_MISSING_CHUNKS))
    assert next_chunk == MAX_MISSING_CHUNKS


def test_arrivals_of_a_new_epoch_begin_anew() -> None:
    arrivals = BulkArrivals()
    arrive(arrivals, 0, 5)
    arrive(arrivals, 0, epoch=2)
    assert (arrivals.epoch, arrivals.bulk_bytes, arrivals.resolved()) == (2, 100, (1, ()))


def test_the_least_delay_is_taken_once() -> None:
    least = LeastDelay()
    for send_ns, arrival_ns in ((10, 60), (20, 50), (30, 90)):
        least.note(send_ns, arrival_ns)
    assert least.take() == 30
    assert least.take() is None
