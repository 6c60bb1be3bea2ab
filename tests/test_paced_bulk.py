"""A link of a known rate: messages go one after the other, as fast as it carries them beside the skeletons."""

from __future__ import annotations

from collections.abc import Hashable

import pytest

from common.transport.chunks import ChunkAssembler, decode_chunk
from sender.paced_bulk import PacedBulk, PacedChunk

SECOND_NS = 1_000_000_000


class Supply:
    """Messages of one size without end, or ``count`` of them; ``asked``: when, and with which budget."""

    def __init__(self, size: int = 20_000, count: int = 10_000) -> None:
        self.asked: list[tuple[int, int]] = []
        self.left = count
        self._size = size

    def __call__(self, budget_bytes: int, now_ns: int) -> tuple[Hashable, bytes] | None:
        self.asked.append((now_ns, budget_bytes))
        self.left -= 1
        return None if self.left < 0 else (("pose", self.left), bytes([self.left % 256]) * self._size)


def second(bulk: PacedBulk, skeleton_bytes: int = 0) -> list[PacedChunk]:
    """What gets through in 30 frames' time."""
    chunks = []
    for frame in range(1, 31):
        now_ns = frame * SECOND_NS // 30
        chunks += bulk.chunks(now_ns)
        bulk.occupy(skeleton_bytes, now_ns)
    return chunks


@pytest.mark.parametrize("rate_bps", [200_000, 2_000_000, 50_000_000])
def test_it_carries_its_rate(rate_bps):
    carried = sum(len(chunk.data) for chunk in second(PacedBulk(rate_bps, 1, Supply())))
    assert 0.85 * rate_bps / 8 < carried <= rate_bps / 8


def test_skeletons_take_their_part():
    with_skeletons = sum(len(chunk.data) for chunk in second(PacedBulk(500_000, 1, Supply()), 250))
    alone = sum(len(chunk.data) for chunk in second(PacedBulk(500_000, 1, Supply())))
    assert alone - with_skeletons == pytest.approx(30 * 250, abs=2500)


def test_messages_arrive_whole_in_order_and_at_rising_times():
    supply, assembler = Supply(), ChunkAssembler()
    chunks = second(PacedBulk(2_000_000, 7, supply))
    assert [chunk.time_ns for chunk in chunks] == sorted(chunk.time_ns for chunk in chunks)
    whole = [message for chunk in chunks if (message := assembler.push(decode_chunk(chunk.data))) is not None]
    assert len(whole) == 11  # of 20,000 bytes and what the chunks add
    assert [message[0] for message in whole] == [(9999 - n) % 256 for n in range(11)]
    assert decode_chunk(chunks[0].data).epoch == 7


def test_a_message_is_chosen_when_the_link_is_free_and_not_before():
    supply = Supply(size=100_000)
    second(PacedBulk(800_000, 1, supply))  # 100 kB/s
    times_s = [now_ns / SECOND_NS for now_ns, _ in supply.asked]
    assert times_s == [0.0]
    assert supply.asked[0][1] == 90_000


def test_an_idle_link_saves_nothing_up():
    bulk = PacedBulk(1_000_000, 1, Supply(count=0))
    assert list(bulk.chunks(100 * SECOND_NS)) == []
    bulk._next_message = Supply()
    assert sum(len(chunk.data) for chunk in bulk.chunks(100 * SECOND_NS + SECOND_NS // 10)) <= 12_500
