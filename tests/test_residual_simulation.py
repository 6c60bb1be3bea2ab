"""Residual packets over simulated paths: the level follows the bandwidth, losses heal, nothing old is queued."""

from __future__ import annotations

from itertools import pairwise

import pytest

from scripts.bulk_simulation import BulkSimulation, S
from scripts.link_model import LinkConditions
from scripts.residual_simulation import ResidualSimulation


def path(mbit: float, **conditions: object) -> LinkConditions:
    return LinkConditions(mbit * 1e6, delay_ms=25, **conditions)  # type: ignore[arg-type]


def run(there: LinkConditions, seconds: float = 8.0, poses: bool = True) -> ResidualSimulation:
    simulation = ResidualSimulation(there, poses)
    simulation.run(seconds)
    return simulation


def late_level(simulation: ResidualSimulation) -> float:
    late = simulation.levels[len(simulation.levels) // 2 :]
    return sum(late) / len(late)


def test_the_level_follows_the_bandwidth_and_the_picture_stays_fluent():
    runs = [run(path(mbit)) for mbit in (0.5, 1, 2, 4)]
    levels = [late_level(simulation) for simulation in runs]
    for low, high in pairwise(levels):
        assert high > 1.5 * low
    assert 0 < levels[0] < 8
    assert levels[-1] < 100
    for simulation in runs:
        assert len(simulation.shown(4)) > 0.6 * 30 * 4
        residual_bytes = simulation.choice.counts["bytes"]
        assert residual_bytes == pytest.approx(simulation.pose_bytes, rel=0.35)


def test_without_poses_to_send_residuals_take_the_link():
    assert late_level(run(path(1), poses=False)) > 2 * late_level(run(path(1)))


def test_what_comes_is_new_and_skeletons_are_not_held_up_by_it():
    simulation = run(path(2))
    ages_ms = sorted((one.came_ns - one.made_ns) / 1e6 for one in simulation.shown(4))
    assert ages_ms[len(ages_ms) * 95 // 100] < 120  # 25 of them are the path's
    poses_alone = BulkSimulation(path(2)).run(8)
    assert simulation.over_idle_ms(4, 8) < poses_alone.over_idle_ms(4, 8) + 10


@pytest.mark.parametrize("loss", [0.02, 0.1])
def test_losses_heal_within_a_second(loss):
    shown = run(path(2, loss=loss)).shown(2)
    assert len(shown) > 10 * 6
    gaps_s = [(after.came_ns - before.came_ns) / S for before, after in pairwise(shown)]
    assert max(gaps_s) < 1.0


def test_after_an_outage_only_what_is_new_comes():
    simulation = ResidualSimulation(path(2))
    simulation.at(3.0, lambda: simulation.there.change(outage=True))
    simulation.at(4.5, lambda: simulation.there.change(outage=False))
    simulation.run(8.0)
    after = [one for one in simulation.shown(0) if one.came_ns > 4.6 * S]
    assert after[0].came_ns < 6.0 * S
    for one in after[1:]:  # the first may be the key that was on its way, and is seen through
        assert one.came_ns - one.made_ns < 1.1 * S


def test_who_asks_late_is_shown_something_at_once():
    simulation = ResidualSimulation(path(2))
    simulation.choice.wants_residuals = False

    def ask() -> None:
        simulation.choice.wants_residuals = True

    simulation.at(3.0, ask)
    simulation.run(5.0)
    shown = simulation.shown(0)
    assert shown[0].made_ns >= 3.0 * S
    assert shown[0].came_ns < 3.3 * S
