"""The soak bench's own parts: the faults it draws, the sums it checks, the growth it finds; namespaces entered."""

from __future__ import annotations

import socket

import pytest

from scripts.link_model import LinkConditions, conditions_from
from scripts.network_emulation import emulated_network, unavailable
from scripts.soak_ledger import BETWEEN, OWN, Identity, Sample, cameras_add_up, growth, read_metrics, still
from scripts.soak_plan import COUNT_EVERY_S, KILLS_UNTIL, Fault, plan

WHY_NOT = unavailable()


def seconds_of(faults: list[Fault]) -> float:
    return sum(fault.quiet_s + fault.seconds for fault in faults)


def test_a_seed_is_a_plan_with_every_fault_in_it():
    faults = plan(3, 1800)
    assert faults == plan(3, 1800) != plan(4, 1800)
    assert seconds_of(faults) == pytest.approx(1800, rel=0.05)
    named = {f.kind for f in faults} | {name for f in faults for name in f.conditions}
    assert named >= {"loss", "burst", "rate_bps", "outage", "deaf", "stop sender", "stop receiver"}
    for fault in faults:
        LinkConditions(**conditions_from(fault.conditions))


def test_each_daemon_is_killed_once_early_and_counted_before_and_after():
    faults = plan(5, 1800)
    kills = [index for index, fault in enumerate(faults) if fault.kind.startswith("kill")]
    assert sorted(faults[index].kind for index in kills) == ["kill receiver", "kill sender"]
    for index in kills:
        assert faults[index - 1].kind == faults[index + 1].kind == "count"
        assert seconds_of(faults[:index]) <= 1800 * KILLS_UNTIL + 60


def test_counts_come_often_and_at_the_end():
    faults = plan(7, 1800)
    assert faults[0].kind == faults[-1].kind == "count"
    between = 0.0
    for fault in faults:
        between = 0.0 if fault.kind == "count" else between + fault.quiet_s + fault.seconds
        assert between < COUNT_EVERY_S + 60


TEXT = """# HELP telepose_tasks Tasks
# TYPE telepose_tasks gauge
telepose_tasks 12.0
# HELP telepose_dropped_total What
# TYPE telepose_dropped_total counter
telepose_dropped_total{cause="fitting busy"} 3.0
"""


def test_metrics_are_read_by_name_and_label():
    assert read_metrics(TEXT) == {"tasks": 12.0, "dropped_total/fitting busy": 3.0}


def test_what_came_and_did_not_go_is_an_imbalance_beyond_what_waits():
    one = Identity("one", ("a", "b"), ("c",), waiting=2)
    assert one.imbalance({"a": 5, "b": 5, "c": 10}) == 0
    assert one.imbalance({"a": 5, "b": 5, "c": 8}) == 0
    assert one.imbalance({"a": 5, "b": 5, "c": 7}) == 1
    assert one.imbalance({"a": 5, "b": 5, "c": 11}) == -1
    assert one.imbalance({"a": 5, "b": 5, "c": 11}, {"a": 1, "c": 2}) == 0


def test_the_identities_are_broken_by_a_frame_that_is_lost_uncounted():
    now = dict.fromkeys(
        (name for each in (*OWN, *BETWEEN, cameras_add_up(2)) for name in (*each.came, *each.went)), 0.0
    )
    now |= {"sender.frames_captured_total": 19, "sender.dropped_total/camera missing": 1, "sender.frame_sets_total": 10}
    now |= {"sender.skeletons_published_total": 8, "sender.dropped_total/fitting busy": 2}
    now |= {"receiver.arrived_total/skeleton": 7, "receiver.skeletons_received_total": 6}
    now |= {"receiver.dropped_total/skeleton duplicate": 1, "receiver.skeletons_lost_total": 2}
    now |= {"receiver.frames_shown_total": 5, "receiver.dropped_total/withheld": 1}
    every = (*OWN, *BETWEEN, cameras_add_up(2))
    assert [each.imbalance(now) for each in every] == [0] * len(every)
    for name in ("sender.frames_captured_total", "sender.frame_sets_total", "receiver.skeletons_received_total"):
        assert any(each.imbalance(now | {name: now[name] - 1}) for each in every), name
    assert still(now, dict(now), every)
    assert not still(now, now | {"sender.frame_sets_total": 11}, every)


def test_growth_is_of_what_follows_the_warm_up():
    def samples(until_s: int) -> list[Sample]:
        return [Sample(t, 100 + min(t, 180) + (5 if t > 500 else 0), 9, 20, 12) for t in range(0, until_s, 3)]

    assert growth(samples(600), "rss_mib", 180) == (280, 285)
    assert growth(samples(600), "threads", 180) == (9, 9)
    assert growth(samples(250), "rss_mib", 180) is None
    assert growth([], "tasks", 180) is None


@pytest.mark.network
@pytest.mark.skipif(WHY_NOT is not None, reason=WHY_NOT or "")
def test_a_thread_can_be_on_a_side_for_a_while():
    with emulated_network(LinkConditions()) as network:
        for _ in range(2):
            with network.inside("A"), socket.create_server((network.addresses["A"], 0)) as server:
                assert server.getsockname()[0] == network.addresses["A"]
        with socket.socket() as outside, pytest.raises(OSError, match="assign"):
            outside.bind((network.addresses["A"], 0))
