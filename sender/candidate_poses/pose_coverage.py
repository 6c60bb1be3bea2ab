"""What each captured pose adds to those a receiver has: the better of the two rules for what to send.

χ counts the skeletons a pose animates well enough, each pose for itself: the best ones by χ look alike. Here a pose is
worth by how much it lowers the best σ of the buffered skeletons, given what is there already (a greedy cover).
Unlike ``UsablePoseSet`` it needs no threshold. σ of every pose for every buffered skeleton is kept, so a new pose
costs a row and a new skeleton a column.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.body.body_regions import default_region_weights
from common.body.distortion_score import distortion_scores
from common.body.joint_edge_store import JointEdgeStore
from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton import LINK_COUNT

SIGMA_MAX = 3.0  # DISPOSE §7.1.1: beyond it a mesh is unrecognisable, however far


@dataclass(frozen=True, slots=True)
class CoverageSettings:
    """``max_poses``, ``max_skeletons`` bound what is kept; ``skeleton_every_ns``: of the skeletons sent, one in such a
    time is buffered (30 s then)."""

    max_poses: int = 200
    max_skeletons: int = 300
    skeleton_every_ns: int = 100_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """σ of the poses ``pose_ids`` (P) for the buffered skeletons, ``sigmas`` (P, S) float32 in [0, SIGMA_MAX]."""

    pose_ids: tuple[int, ...]
    sigmas: NDArray[np.float32]

    def gains(self, pose_ids: Sequence[int], has: Collection[int]) -> NDArray[np.float32]:
        """By how much each of ``pose_ids`` would lower the mean best σ, (n,) float32 >= 0, of a receiver that ``has``
        some; 0 for unknown poses."""
        row = {pose_id: index for index, pose_id in enumerate(self.pose_ids)}
        best = self.best([row[pose_id] for pose_id in has if pose_id in row])
        saved = np.maximum(best - self.sigmas, 0).sum(axis=1) / max(self.sigmas.shape[1], 1)
        return np.array([saved[row[p]] if p in row else 0.0 for p in pose_ids], np.float32)

    def best(self, rows: Sequence[int]) -> NDArray[np.float32]:
        """Best σ (S,) of each skeleton among some rows; SIGMA_MAX without any."""
        if not rows:
            return np.full(self.sigmas.shape[1], SIGMA_MAX, np.float32)
        lowest: NDArray[np.float32] = self.sigmas[list(rows)].min(axis=0)
        return lowest


class CoverageSet:
    """One person's poses that may be sent, or were. Not for several threads at once."""

    def __init__(
        self, settings: CoverageSettings | None = None, region_weights: NDArray[np.float32] | None = None
    ) -> None:
        self._settings = settings = settings or CoverageSettings()
        self._weights = default_region_weights() if region_weights is None else region_weights
        self._edges = JointEdgeStore(self._weights)
        self._captured_ns: dict[int, int] = {}
        self._rows: dict[int, int] = {}
        self._free_rows = list(range(settings.max_poses, -1, -1))  # one more: a new pose comes before one leaves
        self._sigmas = np.full((settings.max_poses + 1, settings.max_skeletons), SIGMA_MAX, np.float32)
        self._skeletons = np.zeros((settings.max_skeletons, LINK_COUNT, 4, 4), np.float32)
        self._times_ns = np.full(settings.max_skeletons, -1, np.int64)  # -1: the slot is empty
        self._next_slot = 0
        self._sent: set[int] = set()

    def __len__(self) -> int:
        return len(self._rows)

    def add_skeleton(self, capture_ns: int, T_world_link: NDArray[np.float32]) -> None:
        """Buffer a sent skeleton's links (L, 4, 4), if the last one is long enough ago; the oldest gives way."""
        if 0 <= capture_ns - int(self._times_ns.max()) < self._settings.skeleton_every_ns and self._times_ns.max() >= 0:
            return
        slot = self._next_slot
        self._next_slot = (slot + 1) % len(self._times_ns)
        self._skeletons[slot], self._times_ns[slot] = T_world_link, capture_ns
        ids = list(self._rows)
        self._sigmas[[self._rows[i] for i in ids], slot] = self._edges.scores(ids, T_world_link).clip(0, SIGMA_MAX)

    def add_pose(self, mesh: RiggedMesh) -> tuple[int, ...]:
        """Take in a new pose. Returns the ids that left for it: what is least needed of those not sent, then of all."""
        row = self._rows[mesh.pose_id] = self._free_rows.pop()
        self._captured_ns[mesh.pose_id] = mesh.capture_ns
        self._edges.add(mesh.pose_id, mesh.joint_edges)
        self._sigmas[row] = distortion_scores(mesh.joint_edges, self._skeletons, self._weights).clip(0, SIGMA_MAX)
        removed = []
        while len(self._rows) > self._settings.max_poses:
            removed.append(self._least_needed(mesh.pose_id))
            self._forget(removed[-1])
        return tuple(removed)

    def sent(self, pose_id: int, retain_threshold: float = 0.0) -> None:
        """A pose went out to some receiver: it stays as long as there is another that may leave. RT is the paper's."""
        if pose_id in self._rows:
            self._sent.add(pose_id)

    def worth(self) -> Coverage:
        """σ as it is now, a copy, for who sends them."""
        slots = np.flatnonzero(self._times_ns >= 0)
        rows = np.array(list(self._rows.values()), np.int64)
        return Coverage(tuple(self._rows), self._sigmas[np.ix_(rows, slots)])

    def _least_needed(self, newest: int) -> int:
        """The pose without which the mean best σ rises least; the older of equals."""
        coverage = self.worth()
        ids = coverage.pose_ids
        lowest = np.partition(coverage.sigmas, 1, axis=0)[:2] if len(ids) > 1 else np.zeros((2, 1), np.float32)
        alone = coverage.sigmas <= lowest[0]
        needed = np.where(alone, lowest[1] - lowest[0], 0).sum(axis=1)
        spare = [i for i in range(len(ids)) if ids[i] != newest and ids[i] not in self._sent]
        spare = spare or [i for i in range(len(ids)) if ids[i] != newest]
        return ids[min(spare, key=lambda i: (needed[i], self._captured_ns[ids[i]]))]

    def _forget(self, pose_id: int) -> None:
        row = self._rows.pop(pose_id)
        self._free_rows.append(row)
        self._edges.remove(pose_id)
        self._sent.discard(pose_id)
        del self._captured_ns[pose_id]
