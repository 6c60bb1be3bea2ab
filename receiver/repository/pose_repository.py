"""The candidate pose repository: what the receiver can animate from (DISPOSE §6.2).

Always add, prune when required: the newest pose shows the newest face and clothes, the least used pose goes when the
search for one gets too slow or memory too large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.body.body_regions import default_region_weights
from common.body.distortion_score import distortion_scores
from common.body.joint_edge_store import JointEdgeStore
from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton_pose import forward_kinematics


@dataclass(frozen=True, slots=True)
class RepositorySettings:
    """Bounds of the repository, and ET: a new pose replaces those whose skeleton it takes with σ below
    ``equal_share`` × the session's threshold (the paper's ET is below 0.1 where its threshold is 0.15)."""

    max_poses: int = 200
    max_bytes: int = 512 << 20
    max_search_ns: int = 10_000_000
    equal_share: float = 0.5


@dataclass(frozen=True, slots=True)
class Changes:
    """Poses that left: ``replaced`` by the new one, ``pruned`` as least used, or of an earlier run (``reset``)."""

    replaced: tuple[int, ...] = ()
    pruned: tuple[int, ...] = ()
    reset: tuple[int, ...] = ()

    @property
    def removed(self) -> tuple[int, ...]:
        """All of them."""
        return self.reset + self.replaced + self.pruned


# A pose of fewer texels than one in so many of the finest here is a preview: shown only while there is nothing better.
PREVIEW_SHARE = 4


@dataclass(slots=True, eq=False)
class _Entry:
    mesh: RiggedMesh
    T_world_link: NDArray[np.float32]
    uses: int


class PoseRepository:
    """Poses of one run (epoch) of one sender, with their use counts."""

    def __init__(
        self, settings: RepositorySettings | None = None, region_weights: NDArray[np.float32] | None = None
    ) -> None:
        self._settings = settings or RepositorySettings()
        self._weights = default_region_weights() if region_weights is None else region_weights
        self._entries: dict[int, _Entry] = {}
        self._edges = JointEdgeStore(self._weights)
        self.epoch: int | None = None

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def pose_ids(self) -> frozenset[int]:
        """All that is here."""
        return frozenset(self._entries)

    @property
    def nbytes(self) -> int:
        """Memory of the meshes [bytes]."""
        return sum(entry.mesh.nbytes for entry in self._entries.values())

    def __contains__(self, pose_id: int) -> bool:
        return pose_id in self._entries

    def reset(self, epoch: int) -> tuple[int, ...]:
        """Start a new sender run: nothing of the old one stays. Returns the ids removed."""
        removed = tuple(self._entries)
        self._entries.clear()
        self._edges.clear()
        self.epoch = epoch
        return removed

    def add(self, mesh: RiggedMesh, epoch: int, threshold: float, on_screen: int | None = None) -> Changes:
        """Take in a received pose; ``threshold`` is the session's, ``on_screen`` the pose being shown.

        A new ``epoch`` empties the repository first. The new pose counts as used once, and takes over the uses of
        those it replaces. The pose on screen is neither replaced nor pruned: a viewer may need a while to take in
        another one.
        """
        reset = self.reset(epoch) if epoch != self.epoch else ()
        T_world_link = forward_kinematics(mesh.skeleton, mesh.pose)
        replaced = self._animated_by(mesh, threshold * self._settings.equal_share)
        replaced = tuple(i for i in replaced if i != on_screen and i != mesh.pose_id)
        uses = 1 + sum(self._forget(pose_id).uses for pose_id in (*replaced, mesh.pose_id) if pose_id in self)
        self._entries[mesh.pose_id] = _Entry(mesh, T_world_link, uses)
        self._edges.add(mesh.pose_id, mesh.joint_edges)
        pruned = self._prune(self._settings.max_poses, {mesh.pose_id, on_screen})
        return Changes(replaced, pruned, reset)

    def count_use(self, pose_id: int) -> None:
        """The pose was selected for a frame."""
        if pose_id in self._entries:
            self._entries[pose_id].uses += 1

    def by_use(self) -> list[int]:
        """The poses to search, most used first, the newer of equals first (DISPOSE §5.3); previews only when there is
        nothing else."""
        finest = max((e.mesh.mesh.texture.size for e in self._entries.values()), default=0)
        whole = [e for e in self._entries.values() if e.mesh.mesh.texture.size * PREVIEW_SHARE > finest]
        whole.sort(key=lambda e: (-e.uses, -e.mesh.capture_ns))
        return [entry.mesh.pose_id for entry in whole]

    def scores(
        self, pose_ids: list[int], T_world_link: NDArray[np.float32], limit: float = 0.0, best: int = 0
    ) -> NDArray[np.float32]:
        """σ of some poses, in their order, up to and with the first one below ``limit``: ``JointEdgeStore.scores``."""
        return self._edges.scores(pose_ids, T_world_link, limit, best)

    def get(self, pose_id: int) -> RiggedMesh | None:
        """The pose of that id, if it is here."""
        entry = self._entries.get(pose_id)
        return entry.mesh if entry else None

    def limit_search(self, search_ns: int, on_screen: int | None = None) -> tuple[int, ...]:
        """Prune to the run-time bound: ``search_ns`` is what a search over all poses took. Returns the ids removed.

        The cost is linear in the number of poses, so that many are kept as would have met the bound.
        """
        if search_ns <= self._settings.max_search_ns:
            return ()
        affordable = max(1, len(self._entries) * self._settings.max_search_ns // search_ns)
        return self._prune(affordable, {on_screen})

    def _animated_by(self, mesh: RiggedMesh, equal_threshold: float) -> tuple[int, ...]:
        if not self._entries:
            return ()
        targets = np.stack([entry.T_world_link for entry in self._entries.values()])
        equal = distortion_scores(mesh.joint_edges, targets, self._weights) < equal_threshold
        return tuple(pose_id for pose_id, is_equal in zip(self._entries, equal, strict=True) if is_equal)

    def _prune(self, max_poses: int, keep: set[int | None]) -> tuple[int, ...]:
        """Remove the least used poses (the older of equals) beyond the bounds, never those in ``keep``."""
        spare = [e for e in self._entries.values() if e.mesh.pose_id not in keep]
        spare.sort(key=lambda e: (e.uses, e.mesh.capture_ns))
        held_bytes = self.nbytes
        pruned = []
        for entry in spare:
            if len(self._entries) <= max_poses and held_bytes <= self._settings.max_bytes:
                break
            held_bytes -= entry.mesh.nbytes
            pruned.append(entry.mesh.pose_id)
            self._forget(entry.mesh.pose_id)
        return tuple(pruned)

    def _forget(self, pose_id: int) -> _Entry:
        self._edges.remove(pose_id)
        return self._entries.pop(pose_id)
