"""Coverage: what a pose adds to those that are there, and which leave when there are too many."""

from __future__ import annotations

import numpy as np
import pytest

from common.body.body_regions import default_region_weights
from common.body.distortion_score import distortion_score
from sender.candidate_poses.pose_coverage import SIGMA_MAX, Coverage, CoverageSet, CoverageSettings
from tests.capsule_views import arms_down_by, captured, links_of

TENTH = 100_000_000


def session(*angles_rad: float, settings: CoverageSettings | None = None) -> CoverageSet:
    """Skeletons a tenth of a second apart."""
    found = CoverageSet(settings)
    for index, angle in enumerate(angles_rad):
        found.add_skeleton(index * TENTH, links_of(arms_down_by(angle)))
    return found


def test_sigma_of_every_pose_for_every_skeleton_whichever_came_first() -> None:
    poses = session(0.3, 0.6)
    poses.add_pose(captured(0.5, 1))
    poses.add_skeleton(9 * TENTH, links_of(arms_down_by(1.2)))
    poses.add_pose(captured(1.1, 2))
    coverage = poses.worth()
    targets = [links_of(arms_down_by(angle)) for angle in (0.3, 0.6, 1.2)]
    weights = default_region_weights()
    expected = [[distortion_score(captured(a), target, weights) for target in targets] for a in (0.5, 1.1)]
    assert coverage.pose_ids == (1, 2)
    np.testing.assert_allclose(coverage.sigmas, expected, rtol=1e-3)


def test_gain_is_what_the_mean_best_score_falls_by() -> None:
    sigmas = np.array([[0.2, 1.0], [0.1, 2.0], [3.0, 0.4]], np.float32)
    coverage = Coverage((5, 6, 7), sigmas)
    assert coverage.gains([5, 6, 7, 99], [5]) == pytest.approx([0, 0.05, 0.3, 0])
    assert coverage.gains([5], []) == pytest.approx([SIGMA_MAX - 0.6])
    assert coverage.gains([7], [5, 6, 42]) == pytest.approx([0.3])


def test_skeletons_are_thinned_and_the_oldest_give_way() -> None:
    poses = session(settings=CoverageSettings(max_skeletons=3))
    for frame in range(30):
        poses.add_skeleton(frame * TENTH // 3, links_of(arms_down_by(frame / 30)))
    poses.add_pose(captured(0.9, 1))
    sigmas = poses.worth().sigmas
    assert sigmas.shape == (1, 3)
    assert sigmas.max() < 0.2  # those kept are the last ones, near 0.9 rad


def test_the_pose_least_needed_leaves_but_neither_the_newest_nor_a_sent_one() -> None:
    poses = session(0.3, 1.2, settings=CoverageSettings(max_poses=3))
    for pose_id, angle in ((1, 0.3), (2, 0.32), (3, 1.2)):
        assert poses.add_pose(captured(angle, pose_id, pose_id)) == ()
    poses.sent(1)
    poses.sent(77)
    assert poses.add_pose(captured(0.8, 4, 4)) == (2,)
    poses.sent(3)
    assert poses.add_pose(captured(0.81, 5, 5)) == (4,)
    poses.sent(5)
    assert poses.add_pose(captured(0.31, 6, 6)) == (5,)  # all were sent: it is needed least
    assert set(poses.worth().pose_ids) == {1, 3, 6}
