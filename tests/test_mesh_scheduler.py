"""What goes to whom next: first picture at once, best χ, the newest when there is room, late joiners, bounds."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sender.candidate_poses.mesh_scheduler import MeshScheduler, Reason, SchedulerSettings

SECOND = 1_000_000_000
POSE_BYTES = 1000
SMALL, AMPLE = 2 * POSE_BYTES, 10 * POSE_BYTES  # budgets of a period


def scheduler_with(*chis: float, settings: SchedulerSettings | None = None) -> MeshScheduler:
    """Poses 0, 1, … offered in this order, with a receiver "r" that holds nothing."""
    scheduler = MeshScheduler(settings)
    for pose_id, chi in enumerate(chis):
        offer(scheduler, pose_id, chi)
    scheduler.receiver_joined("r", epoch=1)
    return scheduler


def offer(scheduler: MeshScheduler, pose_id: int, chi: float, size: int = POSE_BYTES) -> None:
    scheduler.offer(pose_id, bytes([pose_id % 256]) * size, pose_id * SECOND, chi)


def send(scheduler: MeshScheduler, budget: int = SMALL, now_ns: int = 0, receiver: str = "r") -> int | None:
    """One decision carried out; the id sent."""
    chosen = scheduler.next_for(receiver, budget, now_ns)
    if chosen is None:
        return None
    assert scheduler.sent(receiver, chosen[0], now_ns) is not None
    return chosen[0]


def test_a_receiver_with_nothing_gets_the_newest_at_once_whatever_the_budget() -> None:
    scheduler = scheduler_with(0.9, 0.2)
    assert scheduler.next_for("r", 0, 0) == (1, bytes([1]) * POSE_BYTES)
    record = scheduler.sent("r", 1, 5)
    assert record is not None
    assert record.reason is Reason.FIRST


def test_then_the_best_quotient_goes_first() -> None:
    scheduler = scheduler_with(0.3, 0.9, 0.5, 0.1)
    assert [send(scheduler) for _ in range(5)] == [3, 1, 2, 0, None]


def test_nothing_is_sent_twice() -> None:
    scheduler = scheduler_with(0.3)
    assert send(scheduler) == 0
    assert scheduler.next_for("r", AMPLE, SECOND) is None


def test_with_ample_bandwidth_the_newest_goes_before_the_best() -> None:
    scheduler = scheduler_with(0.9, 0.1)
    assert send(scheduler) == 1
    offer(scheduler, 2, 0.0)
    assert scheduler.next_for("r", SMALL, 0) == (0, bytes([0]) * POSE_BYTES)
    assert [send(scheduler, AMPLE) for _ in range(3)] == [2, 0, None]


def test_retained_poses_go_before_better_ones() -> None:
    scheduler = scheduler_with(0.5, 0.6, 0.7, 0.1)
    assert send(scheduler) == 3
    scheduler.update({0: 0.5, 1: 0.6, 2: 0.7, 3: 0.1}, retained=[0, 1])
    chosen = scheduler.next_for("r", SMALL, 0)
    assert chosen is not None
    record = scheduler.sent("r", chosen[0], 0)
    assert record is not None
    assert (record.pose_id, record.reason) == (1, Reason.RETAINED)


def test_a_record_says_why() -> None:
    scheduler = scheduler_with(0.8, 0.4, 0.1)
    send(scheduler)
    scheduler.next_for("r", SMALL, 7)
    record = scheduler.sent("r", 0, 9)
    assert record is not None
    assert (record.receiver_id, record.pose_id, record.reason) == ("r", 0, Reason.BEST)
    assert (record.chi, record.chi_best) == (0.8, 0.8)
    assert record.retain_threshold == pytest.approx(
        0.8 * (SMALL / (4 * POSE_BYTES)) * 0.8
    )  # RT: share × bandwidth × χ_s
    assert (record.size_bytes, record.budget_bytes, record.chosen_ns, record.sent_ns) == (POSE_BYTES, SMALL, 7, 9)


def test_what_does_not_fit_waits_until_it_would_have_fitted() -> None:
    scheduler = scheduler_with(0.5, 0.6)
    assert send(scheduler, now_ns=0) == 1
    third = POSE_BYTES // 3 + 1
    assert send(scheduler, third, now_ns=2 * SECOND) is None
    assert send(scheduler, third, now_ns=3 * SECOND) == 0


def test_no_budget_no_pose() -> None:
    scheduler = scheduler_with(0.5, 0.6)
    send(scheduler)
    assert send(scheduler, 0, now_ns=100 * SECOND) is None


def test_a_smaller_pose_may_go_where_a_better_one_does_not_fit() -> None:
    scheduler = scheduler_with(0.5)
    offer(scheduler, 1, 0.9, size=50 * POSE_BYTES)
    offer(scheduler, 2, 0.1)
    assert send(scheduler) == 2
    assert send(scheduler) == 0


def test_asking_again_abandons_the_pose_given_last() -> None:
    scheduler = scheduler_with(0.5)
    assert scheduler.next_for("r", SMALL, 0) is not None
    offer(scheduler, 1, 0.1)
    assert scheduler.next_for("r", SMALL, 0) == (1, bytes([1]) * POSE_BYTES)  # superseded before it was out
    assert scheduler.sent("r", 0, 0) is None
    assert scheduler.sent("r", 1, 0) is not None


def test_a_late_joiner_gets_the_newest_then_what_others_got_best_first() -> None:
    scheduler = scheduler_with(0.3, 0.9, 0.5)
    while send(scheduler) is not None:
        pass
    scheduler.update({})  # the usable set has moved on
    offer(scheduler, 3, 0.2)
    scheduler.receiver_joined("late", epoch=9)
    assert [send(scheduler, receiver="late") for _ in range(5)] == [3, 1, 2, 0, None]


def test_a_receiver_keeps_what_it_has_until_it_restarts() -> None:
    scheduler = scheduler_with(0.3)
    send(scheduler)
    scheduler.receiver_joined("r", epoch=1)
    assert send(scheduler) is None
    scheduler.receiver_joined("r", epoch=2)
    assert send(scheduler) == 0


def test_a_receiver_that_holds_poses_is_not_sent_them() -> None:
    scheduler = scheduler_with(0.3, 0.4)
    scheduler.receiver_joined("s", epoch=1, holding=[0, 77])
    assert [send(scheduler, receiver="s"), send(scheduler, receiver="s")] == [1, None]


def test_strangers_and_those_who_left_get_nothing() -> None:
    scheduler = scheduler_with(0.3)
    scheduler.receiver_left("r")
    scheduler.receiver_left("never seen")
    assert scheduler.next_for("r", AMPLE, 0) is None
    assert scheduler.sent("r", 0, 0) is None


def test_receivers_are_bounded() -> None:
    scheduler = MeshScheduler(SchedulerSettings(max_receivers=1))
    assert scheduler.receiver_joined("a", 1)
    assert not scheduler.receiver_joined("b", 1)
    assert scheduler.receiver_joined("a", 2)


def test_poses_that_left_the_usable_set_unsent_are_forgotten_but_the_newest() -> None:
    scheduler = scheduler_with(0.3, 0.9, 0.2)
    scheduler.update({1: 0.7})
    assert [send(scheduler) for _ in range(3)] == [2, 1, None]


def test_a_rejected_pose_gives_way_to_the_next() -> None:
    scheduler = scheduler_with(0.5, 0.0, 0.0)
    assert [send(scheduler, AMPLE) for _ in range(3)] == [2, 0, None]


def test_memory_is_bounded_and_the_worst_go_first() -> None:
    scheduler = scheduler_with(0.5, 0.2, 0.9, 0.1, settings=SchedulerSettings(max_bytes=3 * POSE_BYTES))
    assert scheduler.held_bytes == 3 * POSE_BYTES
    assert [send(scheduler) for _ in range(4)] == [3, 2, 0, None]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("osujl"), st.integers(0, 30), st.floats(0, 1)), max_size=60))
def test_bounds_hold_whatever_happens(events: list[tuple[str, int, float]]) -> None:
    limits = SchedulerSettings(max_bytes=6 * POSE_BYTES, max_poses=5, max_receivers=3)
    scheduler = MeshScheduler(limits)
    for now, (event, number, chi) in enumerate(events):
        receiver = f"r{number % 5}"
        if event == "o":
            offer(scheduler, number, chi, size=1 + number * 100)
        elif event == "s":
            chosen = scheduler.next_for(receiver, int(chi * AMPLE), now * SECOND)
            if chosen is not None:
                assert scheduler.sent(receiver, chosen[0], now * SECOND) is not None
        elif event == "u":
            scheduler.update({number: chi}, retained=[number])
        elif event == "j":
            scheduler.receiver_joined(receiver, number % 2)
        else:
            scheduler.receiver_left(receiver)
        assert scheduler.held_bytes <= limits.max_bytes
