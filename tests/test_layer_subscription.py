"""Thin paths in virtual time: a receiver takes fewer skeletons, what is shown is fresh, and all come again later."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.transport.temporal_layers import LAYERS, between, divisor_of, layer_of
from receiver.layer_subscription import (
    BAD_NS,
    OVERFULL_NS,
    PATIENCE_NS,
    SETTLE_NS,
    SILENCE_NS,
    TRIAL_NS,
    LayerSubscription,
)
from scripts.bulk_simulation import MS, BulkSimulation, Competitor, S
from scripts.link_model import LinkConditions

FRAME_NS = S // 30


def shown_per_s(run: BulkSimulation, begin_s: float, end_s: float) -> float:
    return sum(begin_s * S <= sent < end_s * S for sent, _ in run.fresh) / (end_s - begin_s)


def oldest_ms(run: BulkSimulation) -> float:
    return max(delay for _, delay in run.fresh) / MS


@pytest.mark.parametrize("layers", range(1, LAYERS + 1))
def test_the_lowest_layers_are_evenly_spaced(layers: int) -> None:
    taken = [sequence for sequence in range(64) if layer_of(sequence) < layers]
    assert taken == list(range(0, 64, divisor_of(layers)))


@given(st.integers(0, 1 << 32), st.integers(1, 300), st.integers(1, LAYERS))
def test_skeletons_between_two_are_counted_by_layer(first: int, apart: int, layers: int) -> None:
    counted = sum(layer_of(sequence) < layers for sequence in range(first + 1, first + apart))
    assert between(first, first + apart, layers) == counted


@pytest.mark.parametrize("queue_ms", [200, 1000])
def test_on_64_kbit_s_every_second_skeleton_comes_and_nothing_old_is_shown(queue_ms: float) -> None:
    run = BulkSimulation(LinkConditions(64e3, 50, queue_ms=queue_ms)).run(30)
    assert oldest_ms(run) <= 500
    assert shown_per_s(run, 10, 30) >= 14
    assert max(divisor for _, divisor in run.divisors) == 2  # a deep queue, too, halves them but once
    assert run.divisors[1][0] <= 5 * S  # that is when it was noticed


def test_with_all_layers_skeletons_of_a_thin_path_would_age_without_end() -> None:
    run = BulkSimulation(LinkConditions(64e3, 50, queue_ms=10_000))
    run.bulk = False
    run.layers.judge = lambda *_: False  # type: ignore[method-assign]
    run.run(30)
    assert max(delay for _, delay in run.skeletons) / MS > 2000
    assert oldest_ms(run) <= 500  # the receiver shows none of those


def test_when_the_path_is_wide_again_all_skeletons_come() -> None:
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


class Thin:
    """A receiver whose path carries at most so many layers: with more there is a queue, and losses."""

    def __init__(self, carries: int, queue_ms: int = 400, loses: bool = True) -> None:
        self.carries, self._queue_ns, self._loses = carries, queue_ms * MS, loses
        self.layers = LayerSubscription()
        self.changes: list[tuple[int, int]] = []
        self._sequence = self._lost = 0

    def live(self, seconds: float, epoch: int = 1, bulk_bytes: int = 0) -> None:
        for sequence in range(self._sequence, self._sequence + int(seconds * 30)):
            self._sequence = sequence + 1
            now_ns = sequence * FRAME_NS
            if layer_of(sequence) < self.layers.layers:
                full = self.layers.layers > self.carries
                if full and self._loses and sequence % 2 == 1:
                    self._lost += 1
                else:
                    self.layers.skeleton(epoch, now_ns - (self._queue_ns if full and sequence > 10 else 0), now_ns)
            self.layers.bulk(bulk_bytes)
            if self.layers.judge(self._lost, now_ns):
                self.changes.append((now_ns, self.layers.layers))


def test_a_layer_at_a_time_is_dropped_until_the_path_carries_the_rest() -> None:
    receiver = Thin(1)
    receiver.live(12)
    assert [layers for _, layers in receiver.changes] == [3, 2, 1]
    assert receiver.layers.divisor == 8
    assert all(b - a >= SETTLE_NS for (a, _), (b, _) in zip(receiver.changes, receiver.changes[1:], strict=False))


def test_none_is_dropped_while_bulk_has_not_given_way() -> None:
    receiver = Thin(1)
    receiver.live(12, bulk_bytes=1000)  # 240 kbit/s
    assert receiver.changes == []
    receiver.live(6)
    assert receiver.changes


def test_each_time_a_layer_was_joined_in_vain_the_next_time_is_later() -> None:
    receiver = Thin(3)
    receiver.live(90)
    joined = [when for when, layers in receiver.changes if layers == 4]
    dropped = [when for when, layers in receiver.changes if layers == 3]
    waited = [after - before for before, after in zip(dropped, joined, strict=False)]
    assert waited[0] >= PATIENCE_NS
    assert waited[1] > 1.8 * waited[0]


def test_a_layer_on_trial_goes_at_once_when_a_queue_begins_and_bulk_waits_for_the_verdict() -> None:
    receiver = Thin(4)
    receiver.layers.layers = 3
    receiver.live(PATIENCE_NS / S + 1)
    assert [layers for _, layers in receiver.changes] == [4]
    assert (receiver.layers.divisor, receiver.layers.carried_divisor) == (1, 2)
    receiver.live(TRIAL_NS / S)
    assert receiver.layers.carried_divisor == 1
    short = Thin(3, queue_ms=100, loses=False)  # too short to count but on trial
    short.layers.layers = 3
    short.live(8)
    (joined, _), (dropped, layers) = short.changes
    assert layers == 3
    assert BAD_NS < dropped - joined < 1.5 * BAD_NS


def test_a_queue_that_ends_in_silence_is_a_full_path_and_silence_alone_an_outage() -> None:
    """TCP on a path that is too thin delivers nothing for seconds, while its timeouts grow."""
    for queue_ms, changes in ((100, [3]), (0, [])):
        receiver = Thin(3, queue_ms, loses=False)
        receiver.live(3)
        assert receiver.changes == []
        for step in range(100):
            now_ns = 3 * S + step * 50 * MS
            if receiver.layers.judge(0, now_ns):
                receiver.changes.append((now_ns, receiver.layers.layers))
        assert [layers for _, layers in receiver.changes] == changes


def test_another_run_of_the_sender_has_another_clock_and_the_same_path() -> None:
    receiver = Thin(3)
    receiver.live(8)
    assert receiver.layers.layers == 3
    receiver.live(5, epoch=2)
    assert receiver.layers.layers == 3


def test_who_takes_the_least_and_still_has_a_full_path_says_it_anew_and_again_later_if_that_does_not_help() -> None:
    receiver = Thin(0)  # its sender never heard that no more are taken
    said: list[int] = []
    for frame in range(60 * 30):
        receiver.live(1 / 30)
        if receiver.layers.is_overfull(frame * FRAME_NS):
            said.append(frame * FRAME_NS)
            receiver.layers.said_anew(frame * FRAME_NS, True)
    assert [layers for _, layers in receiver.changes] == [3, 2, 1]
    assert said[0] - receiver.changes[-1][0] >= SETTLE_NS + OVERFULL_NS
    waited = [after - before for before, after in pairwise(said)]
    assert len(waited) >= 2
    assert waited[1] > 1.5 * waited[0]
    silent = Thin(0)
    silent.live(25)
    assert silent.layers.is_overfull(25 * S)
    assert not silent.layers.is_overfull(25 * S + 2 * SILENCE_NS)  # nothing comes any more: that is something else
    heard = Thin(1)
    heard.live(60)
    assert heard.changes[2][1] == 1
    assert not heard.layers.is_overfull(60 * S)  # what its path carries is well
