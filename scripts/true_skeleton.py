"""The performer's true skeleton: our links carried by the true surface. For benches; the tracker never sees it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.body.link_segmentation import nearest_link
from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_PARENTS, NAMED_JOINT_LINKS, Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.geometry import quaternion
from sender.capture.performer import Performer
from sender.fitting.start_joints import skeleton_from_joints

LEAST_VERTICES = 12  # of a link: with fewer it keeps its place on its parent


class TrueSkeleton:
    """Sizes from the true joints at the start; each link turned as its part of the surface turns (Kabsch)."""

    def __init__(self, performer: Performer) -> None:
        self._performer = performer
        surface = performer.surface(0.0)
        joints = performer.named_joints(0.0).astype(np.float64)
        self.skeleton: Skeleton
        self.skeleton, start = skeleton_from_joints(joints, float(np.ptp(surface[:, 1])))
        T_world_link = forward_kinematics(self.skeleton, start)
        links = nearest_link(np.ascontiguousarray(surface), self.skeleton, T_world_link)
        self._rows = [np.flatnonzero(links == link) for link in range(LINK_COUNT)]
        self._start = surface.astype(np.float64)
        self._turned = T_world_link[:, :3, :3].astype(np.float64)

    def pose(self, time_s: float) -> SkeletonPose:
        """The pose at ``time_s``; every confidence is 1."""
        surface = self._performer.surface(time_s).astype(np.float64)
        R = np.empty((LINK_COUNT, 3, 3))
        for link, rows in enumerate(self._rows):
            if len(rows) >= LEAST_VERTICES:
                R[link] = _rotation(self._start[rows], surface[rows]) @ self._turned[link]
            else:
                parent = LINK_PARENTS[link]
                R[link] = R[parent] @ self._turned[parent].T @ self._turned[link]
        self._aim(R, self._performer.named_joints(time_s).astype(np.float64))
        local = R.copy()
        parents = np.array(LINK_PARENTS[1:])
        local[1:] = np.swapaxes(R[parents], 1, 2) @ R[1:]
        root = self._performer.named_joints(time_s)[0].astype(np.float32)
        return SkeletonPose(root, quaternion.from_matrix(local).astype(np.float32), np.ones(LINK_COUNT, np.float32))

    def _aim(self, R: NDArray[np.float64], joints: NDArray[np.float64]) -> None:
        """Turn each link, parents first, the least that points it at the true joint at its end."""
        offsets = self.skeleton.offsets.astype(np.float64)
        at = np.zeros((LINK_COUNT, 3))
        at[0] = joints[0]
        for link in range(LINK_COUNT):
            if link > 0:
                at[link] = at[LINK_PARENTS[link]] + R[LINK_PARENTS[link]] @ offsets[link]
            child = _AIMS.get(link)
            if child is not None:
                bone, wanted = R[link] @ offsets[child], joints[_ROW[child]] - at[link]
                R[link] = quaternion.to_matrix(quaternion.shortest_arc(bone, wanted)) @ R[link]


_ROW = {int(link): row for row, link in enumerate(NAMED_JOINT_LINKS)}
_AIMS = {parent: child for child, parent in enumerate(LINK_PARENTS) if child in _ROW and parent > 0}
_AIMS[LINK_INDEX["upper_spine"]] = LINK_INDEX["neck"]  # of its three children


def _rotation(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation (3, 3) that turns points (N, 3) best into others (N, 3), both about their means."""
    U, _, Vt = np.linalg.svd((after - after.mean(axis=0)).T @ (before - before.mean(axis=0)))
    turned: NDArray[np.float64] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return turned
