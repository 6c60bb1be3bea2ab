"""Points on the cylinders of a posed person, with colours that follow the surface: what residual maps are made of."""

from __future__ import annotations

import numpy as np

from common.body.skeleton import LINK_COUNT, Skeleton
from common.body.skeleton_pose import SkeletonPose, bone_segments, forward_kinematics
from common.geometry.point_cloud import PointCloud
from common.wire.body_message import quantized_skeleton
from tests.capsule_person import SKELETON, pose_at

BODY: Skeleton = quantized_skeleton(SKELETON)


def posed_cloud(
    pose: SkeletonPose | None = None, count: int = 6000, noise_m: float = 0.0, seed: int = 0
) -> tuple[PointCloud, np.ndarray]:
    """A cloud of ``count`` points and the link of each (N,); the same seed gives the same points of the body."""
    rng = np.random.default_rng(seed)
    T_world_link = forward_kinematics(BODY, pose or pose_at(0.3))
    starts, ends = (bones.astype(np.float64) for bones in bone_segments(BODY, T_world_link))
    axes = ends - starts
    lengths = np.linalg.norm(axes, axis=1)
    links = rng.choice(LINK_COUNT, count, p=lengths * BODY.radii / (lengths * BODY.radii).sum())
    along, angle = rng.uniform(0.02, 0.98, count), rng.uniform(-np.pi, np.pi, count)
    side = T_world_link[links, :3, 0] * 0.3 + T_world_link[links, :3, 2] * 0.7  # turns with the link
    side = side - axes[links] * (np.einsum("nk,nk->n", side, axes[links]) / lengths[links] ** 2)[:, None]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(axes[links] / lengths[links, None], side)
    outward = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
    radius = BODY.radii[links] * (1 + 0.2 * np.sin(3 * angle)) + rng.normal(0, noise_m, count)
    positions = starts[links] + axes[links] * along[:, None] + outward * radius[:, None]
    colours = np.stack([130 + 80 * np.sin(angle), 128 + 90 * (along - 0.5), 60 + 5.0 * links], axis=1)
    cloud = PointCloud(positions.astype(np.float32), outward.astype(np.float32), colours.astype(np.uint8))
    return cloud, links.astype(np.uint8)
