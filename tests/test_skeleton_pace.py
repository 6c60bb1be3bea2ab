"""Thin paths in virtual time: skeletons are left out on purpose, what is shown is fresh, and all come again later."""

from __future__ import annotations

import pytest

from common.transport.reception import Reception
from scripts.bulk_simulation import MS, BulkSimulation, Competitor, S
from scripts.link_model import LinkConditions
from sender.skeleton_pace import DIVISOR_MAX, SkeletonPace


def shown_per_s(run: BulkSimulation, begin_s: float, end_s: float) -> float:
    return sum(begin_s * S <= sent < end_s * S for sent, _ in run.fresh) / (end_s - begin_s)


def oldest_ms(run: BulkSimulation) -> float:
    return max(delay for _, delay in run.fresh) / MS


@pytest.mark.parametrize("queue_ms", [200, 1000])
def test_on_64_kbit_s_every_second_skeleton_goes_and_nothing_old_is_shown(queue_ms: float) -> None:
    run = BulkSimulation(LinkConditions(64e3, 50, queue_ms=queue_ms)).run(30)
    assert oldest_ms(run) <= 500
    assert shown_per_s(run, 10, 30) >= 7.5
    assert max(divisor for _, divisor in run.divisors) in (2, 4)
    assert run.divisors[1][0] <= 5 * S  # that is when it was noticed


def test_without_the_pace_skeletons_of_a_thin_path_would_age_without_end() -> None:
    run = BulkSimulation(LinkConditions(64e3, 50, queue_ms=10_000))
    run.bulk = False
    run.pace.on_report = lambda *_: None  # type: ignore[method-assign]
    run.run(30)
    assert max(delay for _, delay in run.skeletons) / MS > 2000
    assert oldest_ms(run) <= 500  # the receiver shows none of those


def test_when_the_path_is_wide_again_all_skeletons_go() -> None:
    run = BulkSimulation(LinkConditions(64e3, 50, queue_bytes=12_500))
    run.at(20, lambda: run.there.change(rate_bps=10e6))
    run.run(70)
    assert shown_per_s(run, 55, 70) >= 29
    assert run.divisors[-1][1] == 1
    assert run.goodput_bps(60, 70) >= 0.7 * 10e6  # and bulk is back as well, as far as so short a queue lets it


@pytest.mark.parametrize(
    "conditions",
    [LinkConditions(10e6, 25), LinkConditions(256e3, 25), LinkConditions(10e6, 25, loss=0.2)],
    ids=["10M", "256k", "20 % loss"],
)
def test_a_path_that_carries_them_gets_them_all(conditions: LinkConditions) -> None:
    assert BulkSimulation(conditions).run(15).divisors == [(0, 1)]


def test_a_slower_path_that_still_carries_them_gets_them_all() -> None:
    run = BulkSimulation(LinkConditions(10e6, 100, queue_bytes=250_000))
    run.at(6, lambda: run.there.change(rate_bps=1e6))
    assert run.run(15).divisors == [(0, 1)]  # two seconds of queue, but it is bulk's, and drains


def test_a_download_beside_them_takes_none() -> None:
    run = BulkSimulation(LinkConditions(10e6, 25))
    Competitor(run, 3, 10)
    assert run.run(12).divisors == [(0, 1)]


def test_the_thinnest_path_counts_until_its_receiver_goes() -> None:
    pace = SkeletonPace()
    reception = Reception(1, 1)
    for frame in range(300):
        now_ns = frame * S // 30
        if pace.due(now_ns):
            reception.skeleton(1, now_ns, now_ns)
        report = reception.report(now_ns, None, 0)
        pace.on_report("thin", report, 0.4, True, now_ns)
        pace.on_report("wide", report, 0.0, False, now_ns)
    assert pace.divisor == pace.divisor_of("thin") == DIVISOR_MAX
    assert pace.divisor_of("wide") == pace.divisor_of("unknown") == 1
    assert pace.left_out > 100
    pace.forget("thin")
    assert pace.divisor == 1
    assert all(pace.due(S * 11 + frame) for frame in range(10))
