"""DISPOSE §6.2: always add, replace what the new pose animates, prune the least used beyond the bounds."""

from __future__ import annotations

from common.body.rigged_mesh import RiggedMesh
from receiver.repository.pose_repository import Changes, PoseRepository, RepositorySettings
from tests.capsule_views import captured

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
    return [mesh.pose_id for mesh in repository.by_use()]


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


def test_the_pose_on_screen_and_the_new_one_are_never_pruned() -> None:
    repository = filled(RepositorySettings(max_poses=1))
    assert ids(repository) == [2]
    repository.add(pose(3), 1, 0.0, on_screen=2)
    assert sorted(ids(repository)) == [2, 3]


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
