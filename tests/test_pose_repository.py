"""DISPOSE §6.2: always add, replace what the new pose animates, prune the least used beyond the bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from common.body.body_regions import default_region_weights
from common.body.distortion_score import distortion_score
from common.body.rigged_mesh import RiggedMesh
from receiver.repository.pose_repository import Changes, PoseRepository, RepositorySettings
from tests.capsule_views import arms_down_by, captured, links_of

THRESHOLD = 0.06  # ET is half of it: arms 0.1 rad apart are equal, 0.5 rad apart are not
ANGLES_RAD = (0.2, 0.8, 1.4)


def pose(pose_id: int) -> RiggedMesh:
    """Pose ``pose_id`` with one of three arm positions, captured in the order of the ids."""
    return captured(ANGLES_RAD[pose_id % 3], pose_id, pose_id)


def filled(settings: RepositorySettings | None = None) -> PoseRepository:
    repository = PoseRepository(settings)
    for pose_id in range(3):
        assert repository.add(pose(pose_id), 1, THRESHOLD).replaced == ()
    return repository


def ids(repository: PoseRepository) -> list[int]:
    return repository.by_use()


def test_different_poses_are_all_kept() -> None:
    repository = filled()
    assert sorted(ids(repository)) == [0, 1, 2]
    assert len(repository) == 3
    assert repository.get(1) is pose(1)
    assert repository.get(9) is None


def test_a_pose_replaces_the_one_whose_skeleton_it_animates() -> None:
    repository = filled()
    assert repository.add(captured(0.85, 3, 3), 1, THRESHOLD) == Changes(replaced=(1,))
    assert sorted(ids(repository)) == [0, 2, 3]


def test_a_strict_threshold_replaces_nothing() -> None:
    repository = filled()
    assert repository.add(captured(0.85, 3, 3), 1, THRESHOLD / 100) == Changes()
    assert len(repository) == 4


def test_a_repeated_id_is_the_same_pose_again() -> None:
    repository = filled()
    assert repository.add(pose(1), 1, 0.0).removed == ()
    assert sorted(ids(repository)) == [0, 1, 2]


def test_order_of_use_is_most_used_then_newest_first() -> None:
    repository = filled()
    assert ids(repository) == [2, 1, 0]
    repository.count_use(0)
    repository.count_use(0)
    repository.count_use(1)
    repository.count_use(42)
    assert ids(repository) == [0, 1, 2]


def test_a_replacement_takes_over_the_uses() -> None:
    repository = filled()
    for _ in range(5):
        repository.count_use(1)
    repository.add(captured(0.85, 3, 3), 1, THRESHOLD)
    assert ids(repository)[0] == 3


def test_beyond_the_bound_the_least_used_goes() -> None:
    repository = filled(RepositorySettings(max_poses=3))
    repository.count_use(0)
    repository.count_use(2)
    assert repository.add(captured(0.5, 3, 3), 1, 0.0) == Changes(pruned=(1,))


def test_the_pose_on_screen_and_the_new_one_are_never_removed() -> None:
    repository = filled(RepositorySettings(max_poses=1))
    assert ids(repository) == [2]
    assert repository.add(pose(3), 1, 0.0, on_screen=2) == Changes()
    assert sorted(ids(repository)) == [2, 3]
    assert repository.add(captured(1.45, 5, 5), 1, THRESHOLD, on_screen=2) == Changes(pruned=(3,))  # equal, but shown


def test_memory_is_bounded() -> None:
    one = pose(0).nbytes
    repository = filled(RepositorySettings(max_bytes=int(2.5 * one)))
    assert len(repository) == 2
    assert repository.nbytes <= 2.5 * one


def test_a_search_over_the_run_time_bound_prunes_in_proportion() -> None:
    repository = filled(RepositorySettings(max_search_ns=10_000))
    assert repository.limit_search(9_999) == ()
    assert repository.limit_search(14_000, on_screen=0) == (1,)
    assert sorted(ids(repository)) == [0, 2]
    assert repository.limit_search(1_000_000, on_screen=0) == (2,)
    assert ids(repository) == [0]
    assert repository.limit_search(1_000_000, on_screen=0) == ()


def test_a_new_epoch_empties_it() -> None:
    repository = filled()
    changes = repository.add(pose(4), 2, THRESHOLD)
    assert set(changes.reset) == {0, 1, 2}
    assert set(changes.removed) == {0, 1, 2}
    assert (repository.epoch, ids(repository)) == (2, [4])


def preview(pose_id: int) -> RiggedMesh:
    """As ``pose``, with a ninth of the texels."""
    mesh = pose(pose_id)
    small = np.ascontiguousarray(mesh.mesh.texture[::3, ::3])
    return replace(mesh, mesh=replace(mesh.mesh, texture=small))


def test_a_preview_is_searched_only_while_there_is_nothing_better() -> None:
    repository = PoseRepository()
    repository.add(preview(0), 1, THRESHOLD)
    assert ids(repository) == [0]
    repository.add(pose(1), 1, THRESHOLD)
    assert ids(repository) == [1]
    assert repository.pose_ids == {0, 1}
    repository.add(pose(0), 1, THRESHOLD)  # whole now
    assert sorted(ids(repository)) == [0, 1]


def test_scores_come_in_the_order_asked_for_and_stop_below_the_limit() -> None:
    repository = filled()
    target = links_of(arms_down_by(0.8))
    weights = default_region_weights()
    expected = [distortion_score(pose(pose_id), target, weights) for pose_id in (2, 0, 1)]
    np.testing.assert_allclose(repository.scores([2, 0, 1], target), expected, rtol=1e-4)
    assert len(repository.scores([2, 1, 0], target, limit=expected[2] * 1.01)) == 2
