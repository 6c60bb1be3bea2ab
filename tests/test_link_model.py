"""The model of a path: rate and queue, delay, jitter, losses and outages, each against arithmetic done by hand."""

from __future__ import annotations

from typing import Any

import pytest

from scripts.link_model import BurstLoss, Link, LinkConditions

MS, S = 1_000_000, 1_000_000_000


def arrivals(link: Link[int], until_ns: int = 1000 * S) -> list[tuple[int, int]]:
    return list(link.take(until_ns))


def test_a_packet_takes_its_length_at_the_rate_and_then_the_delay() -> None:
    link: Link[int] = Link(LinkConditions(rate_bps=1e6, delay_ms=25))
    link.put(1, 1250, 0)  # 10 ms
    link.put(2, 1250, 4 * MS)
    assert link.waiting_s(4 * MS) == pytest.approx(0.016)
    link.put(3, 1250, 40 * MS)
    assert link.next_due_ns == 35 * MS
    assert list(link.take(35 * MS - 1)) == []
    assert arrivals(link) == [(35 * MS, 1), (45 * MS, 2), (75 * MS, 3)]


def test_the_queue_takes_what_it_holds_and_drops_the_rest() -> None:
    link: Link[int] = Link(LinkConditions(rate_bps=1e6, queue_ms=40))  # 5000 bytes
    for number in range(10):
        link.put(number, 1250, 0)
    assert [number for _, number in arrivals(link)] == [0, 1, 2, 3]
    assert link.counts["lost in queue"] == 6
    link.put(10, 9000, 10 * S)  # an empty queue takes any packet
    assert len(arrivals(link)) == 1


def test_what_waits_goes_out_at_a_new_rate_and_what_has_left_arrives_as_before() -> None:
    link: Link[int] = Link(LinkConditions(rate_bps=1e6, delay_ms=25))
    for number in range(3):
        link.put(number, 1250, 0)  # leave at 10, 20, 30 ms
    link.change(15 * MS, rate_bps=5e5)
    link.put(3, 1250, 15 * MS)
    assert arrivals(link) == [(35 * MS, 0), (50 * MS, 1), (70 * MS, 2), (90 * MS, 3)]


def test_without_a_rate_only_the_delay_counts() -> None:
    link: Link[int] = Link(LinkConditions(delay_ms=10))
    for number in range(3):
        link.put(number, 10**6, number)
    assert arrivals(link) == [(10 * MS, 0), (10 * MS + 1, 1), (10 * MS + 2, 2)]


@pytest.mark.parametrize("reorder", [False, True])
def test_jitter_reorders_only_when_told_to(reorder: bool) -> None:
    link: Link[int] = Link(LinkConditions(delay_ms=25, jitter_ms=10, reorder=reorder))
    for number in range(1000):
        link.put(number, 100, number * MS)
    came = arrivals(link)
    delays = [due - number * MS for due, number in came]
    order = [number for _, number in came]
    assert (order != sorted(order)) is reorder
    assert 15 * MS <= min(delays) < (16 if reorder else 20) * MS
    assert max(delays) <= 35 * MS


def test_losses_by_chance_are_as_many_as_asked_for_and_the_same_each_time() -> None:
    def run(seed: int) -> list[int]:
        link: Link[int] = Link(LinkConditions(loss=0.05), seed)
        for number in range(20_000):
            link.put(number, 100, number)
        return [number for _, number in arrivals(link)]

    assert len(run(1)) == pytest.approx(19_000, abs=120)
    assert run(1) == run(1)
    assert run(1) != run(2)


def test_gilbert_elliott_loses_in_bursts() -> None:
    burst = BurstLoss(p=0.01, r=0.25, loss_bad=0.5)
    link: Link[int] = Link(LinkConditions(burst=burst))
    for number in range(30_000):
        link.put(number, 100, number)
    came = {number for _, number in arrivals(link)}
    lost = [number for number in range(30_000) if number not in came]
    after_a_loss = sum(number + 1 not in came for number in lost) / len(lost)
    assert len(lost) / 30_000 == pytest.approx(burst.mean, rel=0.15)
    assert after_a_loss > 10 * burst.mean


def test_duplicates_come_twice_and_an_outage_takes_all_that_enters() -> None:
    link: Link[int] = Link(LinkConditions(delay_ms=5, duplicates=1.0))
    link.put(1, 100, 0)
    link.change(1, outage=True)
    link.put(2, 100, 2)
    link.change(3, outage=False, duplicates=0.0)
    link.put(3, 100, 4)
    assert [number for _, number in arrivals(link)] == [1, 1, 3]
    assert link.counts["lost in outage"] == 1
    assert link.counts["delivered"] == 3


@pytest.mark.parametrize(
    "wrong",
    [{"rate_bps": -1}, {"delay_ms": float("nan")}, {"loss": 1.5}, {"duplicates": -0.1}, {"queue_bytes": -1}],
)
def test_impossible_conditions_are_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LinkConditions(**wrong)


def test_impossible_bursts_are_named() -> None:
    with pytest.raises(ValueError, match="p and r"):
        BurstLoss(0, 0)
    with pytest.raises(ValueError, match="loss_bad"):
        BurstLoss(0.1, 0.1, 2)
