"""The slot between threads: newest wins, drops are counted, closing wakes everyone."""

from __future__ import annotations

import threading

import pytest

from common.runtime.latest_value import Closed, LatestValue


def test_the_newest_value_wins_and_the_others_are_counted() -> None:
    slot: LatestValue[int] = LatestValue()
    for value in (1, 2, 3):
        slot.put(value)
    assert slot.wait(0) == 3
    assert slot.dropped == 2


def test_a_value_is_taken_once() -> None:
    slot: LatestValue[int | None] = LatestValue()
    slot.put(None)
    assert slot.wait(0) is None
    with pytest.raises(TimeoutError):
        slot.wait(0)
    assert slot.dropped == 0


def test_a_waiting_thread_gets_the_value() -> None:
    slot: LatestValue[str] = LatestValue()
    got: list[str] = []
    thread = threading.Thread(target=lambda: got.append(slot.wait(5)))
    thread.start()
    slot.put("here")
    thread.join(5)
    assert got == ["here"]


def test_closing_wakes_a_waiting_thread_and_refuses_later_values() -> None:
    slot: LatestValue[int] = LatestValue()
    ended = threading.Event()

    def wait() -> None:
        with pytest.raises(Closed):
            slot.wait(5)
        ended.set()

    thread = threading.Thread(target=wait)
    thread.start()
    slot.close()
    thread.join(5)
    assert ended.is_set()
    slot.put(1)
    with pytest.raises(Closed):
        slot.wait(0)
    assert slot.dropped == 0


def test_in_turn_nothing_is_dropped() -> None:
    slot: LatestValue[int] = LatestValue()

    def feed() -> None:
        for number in range(50):
            slot.put_in_turn(number)

    feeder = threading.Thread(target=feed, daemon=True)
    feeder.start()
    assert [slot.wait(5) for _ in range(50)] == list(range(50))
    assert slot.dropped == 0


def test_closing_frees_whoever_waits_for_a_turn() -> None:
    slot: LatestValue[int] = LatestValue()
    slot.put(1)
    waiting = threading.Thread(target=slot.put_in_turn, args=(2,), daemon=True)
    waiting.start()
    slot.close()
    waiting.join(5)
    assert not waiting.is_alive()
