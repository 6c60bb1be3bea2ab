"""DISPOSE §5.3–5.4, §8: which pose is shown, how long it is held, and what is withheld."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from common.body.body_regions import default_region_weights
from common.body.distortion_score import distortion_score
from common.body.rigged_mesh import RiggedMesh
from receiver.repository.pose_repository import PoseRepository
from receiver.repository.pose_selection import PoseSelector, Selection, SelectionSettings
from tests.capsule_views import arms_down_by, captured, links_of

MESHES = [captured(angle, index, index) for index, angle in enumerate((0.5, 0.85, 1.3))]


def repository(meshes: Sequence[RiggedMesh] = MESHES) -> PoseRepository:
    """All of them, the first most used."""
    poses = PoseRepository()
    for index, mesh in enumerate(meshes):
        poses.add(mesh, 1, 0.0)
        for _ in range(len(meshes) - index):
            poses.count_use(mesh.pose_id)
    return poses


POSES = repository()
PAPER = SelectionSettings(search="threshold", hold=True)
EXHAUSTIVE = SelectionSettings(search="exhaustive", hold=False)
LOOSE = 0.07  # takes the first pose to 0.8 rad, the second from 0.7 rad to 1.0 rad


def select(selector: PoseSelector, angle_rad: float, limit: float = LOOSE) -> Selection:
    """One frame with the threshold fixed at ``limit``."""
    selector.threshold.value = limit
    selection = selector.select(POSES, links_of(arms_down_by(angle_rad)))
    assert selection is not None
    return selection


def test_exhaustive_search_finds_the_lowest_score() -> None:
    selector = PoseSelector(EXHAUSTIVE)
    for angle in (0.3, 0.6, 0.8, 1.0, 1.3):
        target = links_of(arms_down_by(angle))
        scores = [distortion_score(pose, target, default_region_weights()) for pose in MESHES]
        selection = select(selector, angle)
        assert selection.pose_id == int(np.argmin(scores))
        assert selection.sigma == pytest.approx(min(scores))
        assert selection.scored == 3


def test_threshold_search_stops_at_the_first_good_pose() -> None:
    selector = PoseSelector(SelectionSettings(search="threshold"))
    selection = select(selector, 0.6)
    assert (selection.pose_id, selection.scored) == (0, 1)
    assert select(selector, 0.85).scored == 2


def test_threshold_search_without_a_good_pose_is_exhaustive() -> None:
    selection = select(PoseSelector(PAPER), 0.9, limit=1e-4)
    assert (selection.pose_id, selection.scored, selection.held) == (1, 3, False)


def test_the_pose_on_screen_is_held_until_it_passes_the_threshold() -> None:
    selector = PoseSelector(PAPER)
    assert select(selector, 0.85).pose_id == 1
    held = select(selector, 0.8)  # pose 0 would be first in order and good too
    assert (held.pose_id, held.held, held.scored) == (1, True, 1)
    let_go = select(selector, 0.5)
    assert (let_go.pose_id, let_go.held) == (0, False)


def test_without_hold_the_best_is_taken_every_frame() -> None:
    selector = PoseSelector(EXHAUSTIVE)
    assert [select(selector, angle).pose_id for angle in (0.85, 0.6, 0.8)] == [1, 0, 1]


def test_exhaustive_search_can_hold() -> None:
    selector = PoseSelector(SelectionSettings(search="exhaustive", hold=True))
    assert [select(selector, angle).pose_id for angle in (0.85, 0.7, 0.5)] == [1, 1, 0]


def test_a_pose_that_left_is_not_held() -> None:
    selector = PoseSelector(PAPER)
    select(selector, 0.85)
    selection = selector.select(repository(MESHES[:1]), links_of(arms_down_by(0.8)))
    assert selection is not None
    assert (selection.pose_id, selection.held) == (0, False)


def test_no_pose_no_selection() -> None:
    assert PoseSelector(PAPER).select(repository([]), links_of(arms_down_by(0.8))) is None


def test_threshold_follows_the_session() -> None:
    selector = PoseSelector(PAPER)
    for _ in range(40):
        selector.select(repository(MESHES[:1]), links_of(arms_down_by(1.2)))
    last = selector.select(repository(MESHES[:1]), links_of(arms_down_by(1.2)))
    assert last is not None
    assert selector.threshold.value == pytest.approx(last.sigma, rel=1e-3)


def test_a_very_high_score_is_withheld_but_not_for_ever() -> None:
    settings = SelectionSettings(withhold_factor=3, withhold_frames=4, memory_frames=1000)
    selector = PoseSelector(settings)
    for _ in range(50):
        selection = selector.select(repository(MESHES[:1]), links_of(arms_down_by(0.4)))
        assert selection is not None
        assert not selection.withheld
    slip = links_of(arms_down_by(1.4))
    flags = [chosen.withheld for _ in range(7) if (chosen := selector.select(repository(MESHES[:1]), slip))]
    assert flags == [True] * 4 + [False] * 3


def test_an_unknown_search_is_refused() -> None:
    with pytest.raises(ValueError, match="fastest"):
        SelectionSettings(search="fastest")  # type: ignore[arg-type]


def test_hysteresis_keeps_the_pose_on_screen_until_another_is_clearly_better() -> None:
    firm = PoseSelector(SelectionSettings(hysteresis=0.9))
    keen = PoseSelector(EXHAUSTIVE)
    assert [select(keen, angle).pose_id for angle in (0.85, 0.67, 0.505)] == [1, 0, 0]
    assert [select(firm, angle).pose_id for angle in (0.85, 0.67, 0.505)] == [1, 1, 0]
    assert select(firm, 0.5).sigma < 0.01


def test_a_withheld_pose_does_not_count_as_the_one_on_screen() -> None:
    selector = PoseSelector(SelectionSettings(search="threshold", hold=True, withhold_factor=1.5))
    for _ in range(20):
        select(selector, 0.84)
    torn = select(selector, 0.2, limit=0.01)
    assert (torn.pose_id, torn.withheld) == (0, True)
    assert select(selector, 0.8).pose_id == 1  # still held, though 0 would do as well
