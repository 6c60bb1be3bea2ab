"""The usable pose set: which captured poses are worth sending (DISPOSE §6.1).

Skeletons of the recent past are buffered; a pose's rigging quotient χ = N_p / N_s is the share of them it animates
accurately. σ of every pose for every buffered skeleton is kept, so a new skeleton or a new pose costs one row.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from common.body.body_regions import default_region_weights
from common.body.distortion_score import SessionThreshold, distortion_scores
from common.body.joint_edges import JointEdges
from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton import LINK_COUNT
from common.body.skeleton_pose import forward_kinematics


@dataclass(frozen=True, slots=True)
class UsablePoseSettings:
    """``max_poses`` of the set, ``max_skeletons`` buffered, ``sent_poses``: how many of the poses sent last stand for
    what the receivers hold when the session's threshold is learned."""

    max_poses: int = 20
    max_skeletons: int = 300
    sent_poses: int = 20


class Verdict(StrEnum):
    """What became of a new pose."""

    REPLACES = "replaces"
    ADDED = "added"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class Admission:
    """``removed``: poses that left the set for this one, replaced or (set full) with the lowest χ."""

    verdict: Verdict
    removed: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Quotients:
    """By the paper: ``chi`` of the usable poses, and which of them are ``retained`` for the next time."""

    chi: Mapping[int, float]
    retained: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True)
class Transmission:
    """The set after a pose was sent: earlier poses ``retained`` for the next time, and ``dropped``."""

    retained: tuple[int, ...]
    dropped: tuple[int, ...]


@dataclass(slots=True, eq=False)
class _Pose:
    pose_id: int
    capture_ns: int
    edges: JointEdges
    T_world_link: NDArray[np.float32]
    sigmas: NDArray[np.float32]  # for each slot of the skeleton buffer
    retained: bool = False


class UsablePoseSet:
    """One person's poses that may be sent. Not for several threads at once."""

    def __init__(
        self, settings: UsablePoseSettings | None = None, region_weights: NDArray[np.float32] | None = None
    ) -> None:
        self._settings = settings or UsablePoseSettings()
        self._weights = default_region_weights() if region_weights is None else region_weights
        self._poses: dict[int, _Pose] = {}
        self._sent: deque[JointEdges] = deque(maxlen=self._settings.sent_poses)
        self._skeletons = np.zeros((self._settings.max_skeletons, LINK_COUNT, 4, 4), np.float32)
        self._times_ns = np.full(self._settings.max_skeletons, -1, np.int64)  # -1: the slot is empty
        self._next_slot = 0
        self.threshold = SessionThreshold()

    def add_skeleton(self, capture_ns: int, T_world_link: NDArray[np.float32]) -> None:
        """Buffer a sent skeleton's links (L, 4, 4); the oldest gives way when the buffer is full."""
        slot = self._next_slot
        self._next_slot = (slot + 1) % len(self._times_ns)
        self._skeletons[slot], self._times_ns[slot] = T_world_link, capture_ns
        links = self._skeletons[slot : slot + 1]
        for pose in self._poses.values():
            pose.sigmas[slot] = distortion_scores(pose.edges, links, self._weights)[0]
        best = [float(distortion_scores(edges, links, self._weights)[0]) for edges in self._sent]
        best = best or [float(pose.sigmas[slot]) for pose in self._poses.values()]
        if best:
            self.threshold.follow(min(best))

    def add_pose(self, mesh: RiggedMesh) -> Admission:
        """DISPOSE §6.1: replace the poses it animates accurately; else add it if it does so for at least one buffered
        skeleton other than its own; else reject it."""
        pose = self._scored(mesh)
        replaced = self._animated_by(pose)
        others = (self._times_ns >= 0) & (self._times_ns != pose.capture_ns)
        if not replaced and not (pose.sigmas[others] < self.threshold.value).any():
            return Admission(Verdict.REJECTED, ())
        for pose_id in replaced:
            del self._poses[pose_id]
        self._poses[pose.pose_id] = pose
        removed = replaced + self._shrink()
        return Admission(Verdict.REPLACES if replaced else Verdict.ADDED, removed)

    def quotients(self) -> dict[int, float]:
        """χ of every pose in the set; 0 while no skeleton is buffered."""
        buffered = self._times_ns >= 0
        count = max(int(np.count_nonzero(buffered)), 1)
        limit = self.threshold.value
        return {
            pose_id: float(np.count_nonzero(pose.sigmas[buffered] < limit)) / count
            for pose_id, pose in self._poses.items()
        }

    def worth(self) -> Quotients:
        """χ of all poses, and the retained ones, for who sends them."""
        return Quotients(self.quotients(), self.retained())

    def retained(self) -> frozenset[int]:
        """Poses flagged for transmission when an earlier one was sent."""
        return frozenset(pose_id for pose_id, pose in self._poses.items() if pose.retained)

    def sent(self, pose_id: int, retain_threshold: float) -> Transmission:
        """A pose went out: drop earlier poses unless their χ exceeds RT, ``retain_threshold``, and flag those kept;
        drop the skeletons before it. A pose that has left the set meanwhile changes nothing."""
        pose = self._poses.pop(pose_id, None)
        if pose is None:
            return Transmission((), ())
        self._sent.append(pose.edges)
        retained: list[int] = []
        dropped: list[int] = []
        for other_id, chi in self.quotients().items():
            other = self._poses[other_id]
            if other.capture_ns > pose.capture_ns:
                continue
            other.retained = chi > retain_threshold
            (retained if other.retained else dropped).append(other_id)
        for other_id in dropped:
            del self._poses[other_id]
        self._times_ns[self._times_ns < pose.capture_ns] = -1
        return Transmission(tuple(retained), tuple(dropped))

    def _scored(self, mesh: RiggedMesh) -> _Pose:
        sigmas = distortion_scores(mesh.joint_edges, self._skeletons, self._weights)
        T_world_link = forward_kinematics(mesh.skeleton, mesh.pose)
        return _Pose(mesh.pose_id, mesh.capture_ns, mesh.joint_edges, T_world_link, sigmas)

    def _animated_by(self, new: _Pose) -> tuple[int, ...]:
        """Ids of the set's poses whose skeletons the new pose takes with low σ."""
        if not self._poses:
            return ()
        targets = np.stack([pose.T_world_link for pose in self._poses.values()])
        low = distortion_scores(new.edges, targets, self._weights) < self.threshold.value
        return tuple(pose_id for pose_id, is_low in zip(self._poses, low, strict=True) if is_low)

    def _shrink(self) -> tuple[int, ...]:
        """Remove the pose of lowest χ (the older of equals) while there are too many."""
        removed = []
        while len(self._poses) > self._settings.max_poses:
            chi = self.quotients()
            worst = min(self._poses.values(), key=lambda pose: (chi[pose.pose_id], pose.capture_ns))
            removed.append(worst.pose_id)
            del self._poses[worst.pose_id]
        return tuple(removed)
