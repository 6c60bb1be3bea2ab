"""What goes to whom next: first picture at once, the paper's rule and coverage, late joiners, bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sender.candidate_poses.mesh_scheduler import MeshScheduler, Reason, SchedulerSettings, SendRecord
from sender.candidate_poses.pose_coverage import Coverage
from sender.candidate_poses.usable_pose_set import Quotients

SECOND = 1_000_000_000
POSE_BYTES = 1000
SMALL, AMPLE = 2 * POSE_BYTES, 10 * POSE_BYTES  # budgets of a second


class Sender:
    """A scheduler fed by the paper's rule, with a receiver "r" that holds nothing."""

    def __init__(self, *chis: float, settings: SchedulerSettings | None = None) -> None:
        self.scheduler = MeshScheduler(settings)
        self.chi: dict[int, float] = {}
        for pose_id, chi in enumerate(chis):
            self.offer(pose_id, chi)
        self.scheduler.receiver_joined("r", epoch=1)

    def offer(self, pose_id: int, chi: float | None, retained: frozenset[int] = frozenset(), preview: int = 0) -> None:
        """A new pose; ``chi`` None: the usable set rejects it."""
        if chi is not None:
            self.chi[pose_id] = chi
        self.scheduler.offer(
            pose_id, payload(pose_id), pose_id * SECOND, Quotients(dict(self.chi), retained), b"s" * preview or None
        )

    def send(self, budget: int = SMALL, receiver: str = "r") -> SendRecord | None:
        """One decision carried out."""
        return send(self.scheduler, budget, receiver)

    def ids(self, count: int, budget: int = SMALL, receiver: str = "r") -> list[int | None]:
        records = [self.send(budget, receiver) for _ in range(count)]
        return [None if record is None else record.pose_id for record in records]


def payload(pose_id: int) -> bytes:
    return bytes([pose_id % 256]) * POSE_BYTES


def send(scheduler: MeshScheduler, budget: int = SMALL, receiver: str = "r") -> SendRecord | None:
    chosen = scheduler.next_for(receiver, budget, 0)
    if chosen is None:
        return None
    record = scheduler.sent(receiver, chosen[0], 0)
    assert record is not None
    assert record.size_bytes == len(chosen[1])
    return record


def test_a_receiver_with_nothing_gets_the_newest_at_once_whatever_the_budget() -> None:
    sender = Sender(0.9, 0.2)
    assert sender.scheduler.next_for("r", 0, 0) == (1, payload(1))
    record = sender.scheduler.sent("r", 1, 5)
    assert record is not None
    assert (record.reason, record.sent_ns, record.preview) == (Reason.FIRST, 5, False)


def test_over_a_thin_link_the_first_sight_is_a_preview_and_the_whole_pose_comes_later() -> None:
    sender = Sender(0.3)
    sender.offer(1, 0.9, preview=90)
    first = sender.send(POSE_BYTES)
    assert first is not None
    assert (first.pose_id, first.reason, first.preview, first.size_bytes) == (1, Reason.FIRST, True, 90)
    second = sender.send(POSE_BYTES)
    assert second is not None
    assert (second.pose_id, second.reason, second.preview) == (1, Reason.BEST, False)
    assert sender.ids(2) == [0, None]


def test_over_a_wide_link_the_first_sight_is_whole() -> None:
    sender = Sender()
    sender.offer(1, 0.9, preview=90)
    first = sender.send(100 * POSE_BYTES)
    assert first is not None
    assert not first.preview


def test_a_preview_is_of_the_newest_only() -> None:
    sender = Sender()
    sender.offer(1, 0.9, preview=90)
    sender.offer(2, 0.9, preview=90)
    assert sender.scheduler.held_bytes == 2 * POSE_BYTES + 90


def test_then_the_best_quotient_goes_first() -> None:
    assert Sender(0.3, 0.9, 0.5, 0.1).ids(5) == [3, 1, 2, 0, None]


def test_nothing_is_sent_twice() -> None:
    assert Sender(0.3).ids(2, AMPLE) == [0, None]


def test_by_the_paper_the_newest_has_no_privilege() -> None:
    sender = Sender(0.9, 0.5)
    assert sender.ids(1, AMPLE) == [1]
    sender.offer(2, 0.1)
    assert sender.ids(2, AMPLE) == [0, 2]


def test_a_pose_that_animates_nothing_is_not_sent() -> None:
    sender = Sender(0.4, 0.0)
    assert sender.ids(1) == [1]  # there is nobody on screen yet
    sender.offer(2, 0.0)
    assert sender.ids(2) == [0, None]


def test_retained_poses_go_before_better_ones_if_they_pass_the_retain_threshold() -> None:
    sender = Sender(0.5, 0.6, 0.7)
    sender.offer(3, 0.1, retained=frozenset([0, 1]))
    assert sender.ids(1) == [3]
    record = sender.send()
    assert record is not None
    assert (record.pose_id, record.reason) == (1, Reason.RETAINED)
    sender.chi[0] = 0.1
    sender.offer(4, 0.2, retained=frozenset([0]))
    record = sender.send()
    assert record is not None
    assert (record.pose_id, record.reason) == (2, Reason.BEST)  # RT is 0.28


@pytest.mark.parametrize(("budget", "share"), [(1, 0.001 / 4), (SMALL, 0.5), (AMPLE, 1.0)])
def test_a_record_says_why_and_rt_is_proportional_to_the_bandwidth(budget: int, share: float) -> None:
    sender = Sender(0.8, 0.4, 0.1)
    sender.send()
    sender.scheduler.next_for("r", budget, 7)
    record = sender.scheduler.sent("r", 0, 9)
    assert record is not None
    assert (record.receiver_id, record.pose_id, record.reason) == ("r", 0, Reason.BEST)
    assert (record.chi, record.chi_best) == (0.8, 0.8)
    assert record.retain_threshold == pytest.approx(0.8 * share * 0.8)  # RT: percentage × bandwidth × χ_s
    assert (record.size_bytes, record.budget_bytes, record.chosen_ns, record.sent_ns) == (POSE_BYTES, budget, 7, 9)


def test_no_budget_no_pose() -> None:
    assert Sender(0.5, 0.6).ids(1) == [1]
    sender = Sender(0.5, 0.6)
    sender.send()
    assert sender.send(0) is None


def test_asking_again_abandons_the_pose_given_last() -> None:
    sender = Sender(0.5)
    assert sender.scheduler.next_for("r", SMALL, 0) is not None
    sender.offer(1, 0.1)
    assert sender.scheduler.next_for("r", SMALL, 0) == (1, payload(1))  # superseded before it was out
    assert sender.scheduler.sent("r", 0, 0) is None
    assert sender.scheduler.sent("r", 1, 0) is not None


def test_a_late_joiner_gets_the_newest_then_what_others_got_best_first() -> None:
    sender = Sender(0.3, 0.9, 0.5)
    assert sender.ids(4)[-1] is None
    sender.chi = {}  # the usable set has moved on
    sender.offer(3, 0.2)
    sender.scheduler.receiver_joined("late", epoch=9)
    assert sender.ids(5, receiver="late") == [3, 1, 2, 0, None]


def test_a_receiver_keeps_what_it_has_until_it_restarts() -> None:
    sender = Sender(0.3)
    sender.send()
    sender.scheduler.receiver_joined("r", epoch=1)
    assert sender.ids(1) == [None]
    sender.scheduler.receiver_joined("r", epoch=2)
    assert sender.ids(1) == [0]


def test_a_receiver_that_holds_poses_is_not_sent_them() -> None:
    sender = Sender(0.3, 0.4)
    sender.scheduler.receiver_joined("s", epoch=1, holding={0: POSE_BYTES, 77: POSE_BYTES})
    assert sender.ids(2, receiver="s") == [1, None]
    assert sender.scheduler.holding == {0: POSE_BYTES, 1: POSE_BYTES}


def test_a_receiver_that_holds_a_preview_lacks_the_pose() -> None:
    sender = Sender(0.3, 0.4)
    sender.scheduler.receiver_joined("s", epoch=1, holding={0: POSE_BYTES // 10, 1: POSE_BYTES})
    assert sender.ids(2, receiver="s") == [0, None]


def test_what_a_receiver_tells_later_is_added_to_what_it_was_sent() -> None:
    sender = Sender(0.3, 0.4, 0.5)
    assert sender.ids(1) == [2]
    sender.scheduler.receiver_joined("r", epoch=1, holding={1: POSE_BYTES})
    assert sender.ids(2) == [0, None]


def test_strangers_and_those_who_left_get_nothing() -> None:
    scheduler = Sender(0.3).scheduler
    scheduler.receiver_left("r")
    scheduler.receiver_left("never seen")
    assert scheduler.next_for("r", AMPLE, 0) is None
    assert scheduler.sent("r", 0, 0) is None


def test_receivers_are_bounded_and_the_thinnest_link_is_known() -> None:
    scheduler = MeshScheduler(SchedulerSettings(max_receivers=2))
    assert scheduler.budget_bytes is None
    assert scheduler.receiver_joined("a", 1)
    assert scheduler.receiver_joined("b", 1)
    assert not scheduler.receiver_joined("c", 1)
    assert scheduler.receiver_joined("a", 2)
    scheduler.next_for("a", 3000, 0)
    scheduler.next_for("b", 2000, 0)
    assert scheduler.budget_bytes == 2000


def test_poses_that_left_the_usable_set_unsent_are_forgotten_but_the_newest() -> None:
    sender = Sender(0.3, 0.9)
    sender.chi = {1: 0.7}
    sender.offer(2, None)
    assert sender.ids(3) == [2, 1, None]


def test_memory_is_bounded_and_the_worst_go_first() -> None:
    sender = Sender(0.5, 0.2, 0.9, 0.1, settings=SchedulerSettings(max_bytes=3 * POSE_BYTES))
    assert sender.scheduler.held_bytes == 3 * POSE_BYTES
    assert sender.ids(4) == [3, 2, 0, None]


# Poses 0 and 1 look alike and are good for three of four skeletons; pose 2 for the fourth only; pose 3 for none.
SIGMAS = np.array([[0.1, 0.1, 0.1, 2.0], [0.1, 0.1, 0.2, 2.0], [2.0, 2.0, 2.0, 0.1], [3.0, 3.0, 3.0, 3.0]], np.float32)
COVERAGE = Coverage((0, 1, 2, 3), SIGMAS)


def by_coverage(*holding: int, ids: tuple[int, ...] = (0, 1, 2, 3)) -> MeshScheduler:
    scheduler = MeshScheduler()
    rows = [COVERAGE.pose_ids.index(pose_id) for pose_id in ids]
    for pose_id in ids:
        coverage = Coverage(ids, COVERAGE.sigmas[rows])
        scheduler.offer(pose_id, payload(pose_id), pose_id * SECOND, coverage)
    scheduler.receiver_joined("r", 1, dict.fromkeys(holding, POSE_BYTES))
    return scheduler


def test_by_coverage_the_pose_that_adds_most_to_what_the_receiver_has_goes_next() -> None:
    scheduler = by_coverage(0)
    record = send(scheduler)
    assert record is not None
    assert (record.pose_id, record.reason) == (2, Reason.GAIN)  # not 1, though it animates more
    assert record.chi == pytest.approx((2.0 - 0.1) / 4)
    assert record.retain_threshold == 0
    assert send(scheduler) is None  # 1 and 3 add nothing


def test_each_receiver_has_its_own_coverage() -> None:
    scheduler = by_coverage(0)
    scheduler.receiver_joined("s", 1, {2: POSE_BYTES})
    assert [send(scheduler, SMALL, name) and send(scheduler, SMALL, name) for name in "rs"] == [None, None]
    scheduler = by_coverage(0)
    scheduler.receiver_joined("s", 1, {2: POSE_BYTES})
    first = [send(scheduler, SMALL, name) for name in "rs"]
    assert [record.pose_id for record in first if record is not None] == [2, 0]


def test_with_ample_bandwidth_the_newest_goes_first_whatever_it_adds() -> None:
    scheduler = by_coverage(0)
    records = [send(scheduler, AMPLE) for _ in range(3)]
    assert [record and (record.pose_id, record.reason) for record in records] == [
        (3, Reason.NEWEST),
        (2, Reason.GAIN),
        None,
    ]


# Pose 1 does all that pose 0 does, and much more; pose 2 does a little else.
BETTER = np.array([[1.9, 3.0, 3.0], [0.1, 0.1, 3.0], [3.0, 3.0, 2.9]], np.float32)


def superseded(sigmas: np.ndarray, under_way: int, arrived: tuple[int, ...] = ()) -> tuple[int, ...]:
    """What is superseded when ``under_way`` is on its way and then the other poses come up."""
    scheduler = MeshScheduler()
    scheduler.offer(under_way, payload(under_way), 0, Coverage((under_way,), sigmas[[under_way]]))
    scheduler.receiver_joined("r", 1)
    record = send(scheduler)
    assert record is not None
    assert record.pose_id == under_way
    ids = tuple(range(len(sigmas)))
    for pose_id in ids:
        if pose_id != under_way:
            scheduler.offer(pose_id, payload(pose_id), SECOND, Coverage(ids, sigmas))
    scheduler.receiver_joined("r", 1, dict.fromkeys(arrived, POSE_BYTES))
    lost = scheduler.superseded("r", [under_way])
    assert scheduler.superseded("r", [under_way]) == ()  # said once
    assert scheduler.superseded("nobody", [under_way]) == ()
    if lost:
        record = send(scheduler)
        assert record is not None
        assert record.pose_id not in lost
    return lost


def test_a_pose_on_its_way_gives_way_to_one_that_does_all_it_does_and_more() -> None:
    assert superseded(BETTER, under_way=0) == (0,)
    assert superseded(BETTER, under_way=1) == ()


def test_a_pose_on_its_way_stays_when_the_better_one_is_there_already_or_little_better() -> None:
    assert superseded(BETTER, under_way=0, arrived=(1,)) == ()
    alike = np.array([[0.5, 0.5, 0.5], [0.4, 0.4, 0.4]], np.float32)  # somebody who stands still
    assert superseded(alike, under_way=0) == ()


def test_a_pose_on_its_way_stays_when_it_does_what_the_better_one_does_not() -> None:
    beside = np.array([[1.0, 3.0, 3.0], [3.0, 0.0, 0.0]], np.float32)
    assert superseded(beside, under_way=0) == ()


def test_what_left_the_coverage_unsent_is_forgotten() -> None:
    scheduler = by_coverage(0)
    kept = Coverage((0, 4), SIGMAS[[0, 2]])
    scheduler.offer(4, payload(4), 4 * SECOND, kept)
    assert scheduler.held_bytes == 2 * POSE_BYTES
    record = send(scheduler)
    assert record is not None
    assert record.pose_id == 4


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("ocsjl"), st.integers(0, 30), st.floats(0, 1)), max_size=60))
def test_bounds_hold_whatever_happens(events: list[tuple[str, int, float]]) -> None:
    limits = SchedulerSettings(max_bytes=6 * POSE_BYTES, max_poses=5, max_receivers=3)
    scheduler = MeshScheduler(limits)
    for now, (event, number, chi) in enumerate(events):
        receiver = f"r{number % 5}"
        if event == "o":
            scheduler.offer(number, b"p" * (1 + number * 100), now, Quotients({number: chi}, frozenset([number])), b"s")
        elif event == "c":
            sigmas = np.full((1, 3), chi, np.float32)
            scheduler.offer(number, b"p" * 500, now, Coverage((number,), sigmas))
        elif event == "s":
            chosen = scheduler.next_for(receiver, int(chi * AMPLE), now)
            if chosen is not None:
                assert scheduler.sent(receiver, chosen[0], now) is not None
        elif event == "j":
            scheduler.receiver_joined(receiver, number % 2)
        else:
            scheduler.receiver_left(receiver)
        assert scheduler.held_bytes <= limits.max_bytes
