"""A link of a known rate: messages go one after the other, as fast as it carries them beside the skeletons."""

from __future__ import annotations

import pytest

from common.transport.chunks import ChunkAssembler, decode_chunk
from sender.outgoing_bulk import Outgoing
from sender.paced_bulk import PacedBulk, PacedChunk

SECOND_NS = 1_000_000_000


class Supply:
    """Messages of one size without end, or ``count`` of them, in place of a choice; ``urgent`` ones go between.
    ``asked``: when, and with which budget."""

    def __init__(self, size: int = 20_000, count: int = 10_000) -> None:
        self.asked: list[tuple[int, int]] = []
        self.left = count
        self.urgent: list[bytes] = []
        self._size = size

    def next_message(self, budget_bytes: int, now_ns: int) -> Outgoing | None:
        self.asked.append((now_ns, budget_bytes))
        self.left -= 1
        return None if self.left < 0 else Outgoing(("pose", self.left), bytes([self.left % 256]) * self._size)

    def next_urgent(self) -> Outgoing | None:
        return Outgoing(("residual", len(self.urgent)), self.urgent.pop(), urgent=True) if self.urgent else None


def paced(rate_bps: float, supply: Supply, epoch: int = 1) -> PacedBulk:
    return PacedBulk(rate_bps, epoch, supply)  # type: ignore[arg-type]


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
    carried = sum(len(chunk.data) for chunk in second(paced(rate_bps, Supply())))
    assert 0.85 * rate_bps / 8 < carried <= rate_bps / 8


def test_skeletons_take_their_part():
    with_skeletons = sum(len(chunk.data) for chunk in second(paced(500_000, Supply()), 250))
    alone = sum(len(chunk.data) for chunk in second(paced(500_000, Supply())))
    assert alone - with_skeletons == pytest.approx(30 * 250, abs=2500)


def test_messages_arrive_whole_in_order_and_at_rising_times():
    supply, assembler = Supply(), ChunkAssembler()
    chunks = second(paced(2_000_000, supply, 7))
    assert [chunk.time_ns for chunk in chunks] == sorted(chunk.time_ns for chunk in chunks)
    whole = [message for chunk in chunks if (message := assembler.push(decode_chunk(chunk.data))) is not None]
    assert len(whole) == 11  # of 20,000 bytes and what the chunks add
    assert [message[0] for message in whole] == [(9999 - n) % 256 for n in range(11)]
    assert decode_chunk(chunks[0].data).epoch == 7


def test_a_message_is_chosen_when_the_link_is_free_and_not_before():
    supply = Supply(size=100_000)
    second(paced(800_000, supply))  # 100 kB/s
    times_s = [now_ns / SECOND_NS for now_ns, _ in supply.asked]
    assert times_s == [0.0]
    assert supply.asked[0][1] == 90_000


def test_an_idle_link_saves_nothing_up():
    bulk = paced(1_000_000, Supply(count=0))
    assert list(bulk.chunks(100 * SECOND_NS)) == []
    bulk._choice = Supply()  # type: ignore[assignment]
    assert sum(len(chunk.data) for chunk in bulk.chunks(100 * SECOND_NS + SECOND_NS // 10)) <= 12_500


def test_what_is_urgent_goes_between_the_chunks_of_a_message():
    supply, assembler = Supply(size=100_000), ChunkAssembler()
    bulk = paced(800_000, supply)
    chunks = list(bulk.chunks(SECOND_NS // 4))
    supply.urgent = [b"x" * 3000]
    chunks += bulk.chunks(2 * SECOND_NS)
    whole = [message for chunk in chunks if (message := assembler.push(decode_chunk(chunk.data))) is not None]
    assert [len(message) for message in whole] == [3000, 100_000]
