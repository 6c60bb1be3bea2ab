"""A pose of the link tree and its forward kinematics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_PARENTS, NAMED_JOINT_LINKS, Skeleton
from common.geometry import quaternion
from common.geometry.rigid_transform import rigid_transform


@dataclass(frozen=True, slots=True, eq=False)
class SkeletonPose:
    """``root_position`` (3,) float32 [m, world]: the pelvis joint. ``rotations`` (L, 4) float32: unit quaternion of
    each link relative to its parent (root: relative to the world). ``confidence`` (L,) float32 in [0, 1]:
    0 = not seen, a guess.

    Raises:
        ValueError: wrong shapes, values that are not finite, or quaternions far from unit length.
    """

    root_position: NDArray[np.float32]
    rotations: NDArray[np.float32]
    confidence: NDArray[np.float32]

    def __post_init__(self) -> None:
        for name, shape in (("root_position", (3,)), ("rotations", (LINK_COUNT, 4)), ("confidence", (LINK_COUNT,))):
            value = np.ascontiguousarray(getattr(self, name), np.float32)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"pose {name}: expected finite {shape}, got {value.shape}")
            object.__setattr__(self, name, value)
        if np.abs(np.linalg.norm(self.rotations, axis=1) - 1).max() > 1e-2:
            raise ValueError("pose rotations are not unit quaternions")


def rest_pose(root_position: NDArray[np.floating] | None = None) -> SkeletonPose:
    """The T-pose at ``root_position`` (3,) [m, world], all confidences 1."""
    return SkeletonPose(
        np.zeros(3, np.float32) if root_position is None else np.asarray(root_position, np.float32),
        np.tile(quaternion.IDENTITY.astype(np.float32), (LINK_COUNT, 1)),
        np.ones(LINK_COUNT, np.float32),
    )


def forward_kinematics(skeleton: Skeleton, pose: SkeletonPose) -> NDArray[np.float32]:
    """``T_world_link`` (L, 4, 4) float32 of every link: origin at its joint, axes turned by the pose."""
    local = rigid_transform(
        quaternion.to_matrix(pose.rotations.astype(np.float64)), skeleton.offsets.astype(np.float64)
    )
    local[0, :3, 3] = pose.root_position
    T = np.empty_like(local)
    T[0] = local[0]
    for link in range(1, LINK_COUNT):
        T[link] = T[LINK_PARENTS[link]] @ local[link]
    return T.astype(np.float32)


def joint_positions(skeleton: Skeleton, pose: SkeletonPose) -> NDArray[np.float32]:
    """World positions (L, 3) float32 [m] of all joints (link origins)."""
    return np.ascontiguousarray(forward_kinematics(skeleton, pose)[:, :3, 3])


def named_joint_positions(skeleton: Skeleton, pose: SkeletonPose) -> NDArray[np.float32]:
    """World positions (16, 3) float32 [m] of the joints accuracy is measured on (``NAMED_JOINTS`` order)."""
    return joint_positions(skeleton, pose)[NAMED_JOINT_LINKS]


def bone_segments(
    skeleton: Skeleton, T_world_link: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Bone ends (L, 3), (L, 3) float32 [m, world]: each link's joint and its tip."""
    starts = T_world_link[:, :3, 3]
    ends = starts + np.einsum("lij,lj->li", T_world_link[:, :3, :3], skeleton.tips)
    return starts.astype(np.float32), ends.astype(np.float32)
