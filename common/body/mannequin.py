"""A person of plain cylinders before a camera: what daemons rehearse on, so that their first real frame is not slow.

Numba's kernels are loaded, or compiled, when they are first called. A rehearsal calls them all before the daemon says
that it is ready.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, Skeleton, human_skeleton
from common.body.skeleton_pose import SkeletonPose, bone_segments, forward_kinematics, rest_pose
from common.geometry import quaternion
from common.geometry.camera_model import Camera, project
from common.geometry.rigid_transform import look_at

STATURE_M = 1.75
_AROUND, _ALONG = 24, 40  # points of each cylinder
_SPLAT = np.ones((5, 5), np.uint8)


def mannequin() -> tuple[Skeleton, SkeletonPose]:
    """An average person standing at the origin in an A-pose."""
    skeleton = human_skeleton(STATURE_M)
    pose = rest_pose(np.array([0, 0.53 * STATURE_M, 0], np.float32))
    rotations = pose.rotations.copy()
    for side, sign in (("left", -1.0), ("right", 1.0)):
        rotations[LINK_INDEX[f"{side}_upper_arm"]] = quaternion.from_rotation_vector(np.array([0, 0, sign * 0.8]))
    return skeleton, SkeletonPose(pose.root_position, rotations, pose.confidence)


def mannequin_camera() -> Camera:
    """A 320×240 camera that sees the mannequin from the front."""
    pose = look_at(np.array([0.0, 1.1, 2.7]), np.array([0.0, 0.95, 0.0]))
    return Camera("front", 320, 240, 260.0, 260.0, 159.5, 119.5, pose)


def mannequin_depth(camera: Camera) -> NDArray[np.uint16]:
    """Depth (H, W) uint16 [mm] of the mannequin, 0 around it."""
    skeleton, pose = mannequin()
    starts, ends = bone_segments(skeleton, forward_kinematics(skeleton, pose))
    pixels, z = project(camera, _cylinder_points(starts, ends, skeleton.radii))
    u, v = np.rint(pixels).astype(int).T
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    nearest = np.full((camera.height, camera.width), 65535, np.uint16)
    np.minimum.at(nearest, (v[inside], u[inside]), np.rint(1000 * z[inside]).astype(np.uint16))
    filled = cv2.erode(nearest, _SPLAT)  # the nearest of the neighbours: closes the gaps between points
    return np.where(filled == 65535, 0, filled).astype(np.uint16)


def _cylinder_points(
    starts: NDArray[np.float32], ends: NDArray[np.float32], radii: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Points (N, 3) [m, world] on the links' cylinders."""
    axis = (ends - starts).astype(np.float64)
    side = np.cross(axis, np.array([0.31, 0.17, 0.94]))  # along no bone
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(axis / np.linalg.norm(axis, axis=1, keepdims=True), side)
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    along = starts[:, None] + np.linspace(0, 1, _ALONG)[None, :, None] * axis[:, None]
    return (along[:, :, None] + radii[:, None, None, None] * ring[:, None]).reshape(-1, 3)
