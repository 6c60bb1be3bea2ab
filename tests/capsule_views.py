"""The capsule person seen by small depth cameras: views and rigged meshes for tests of what is made from them."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from common.body.rigged_mesh import RiggedMesh, build_rigged_mesh
from common.body.skeleton import LINK_INDEX
from common.body.skeleton_pose import SkeletonPose, forward_kinematics, rest_pose
from common.body.view import View
from common.geometry.camera_model import Camera
from common.geometry.rasterizer import render_crop
from common.geometry.rigid_transform import look_at
from tests.capsule_person import SKELETON, capsule_person

FRAME_NS = 33_333_333


def ring_camera(index: int, count: int = 4) -> Camera:
    """One of ``count`` cameras of 480×360 pixels around the person, at 2.5 m; the first sees the front."""
    around = 2 * math.pi * index / count
    eye = np.array([2.5 * math.sin(around), 1.2, 2.5 * math.cos(around)])
    T_world_camera = look_at(eye, np.array([0.0, 0.9, 0.0])).astype(np.float64)
    return Camera(f"cam{index + 1}", 480, 360, 360.0, 360.0, 239.5, 179.5, T_world_camera)


def arms_down_by(angle_rad: float, turned_rad: float = 0.0) -> SkeletonPose:
    """T-pose with both arms lowered by an angle, the whole person turned about the vertical."""
    pose = rest_pose(np.array([0, 0.93, 0], np.float32))
    rotations = pose.rotations.copy()
    for side, sign in (("left", -1), ("right", 1)):
        rotations[LINK_INDEX[f"{side}_upper_arm"]] = [math.cos(angle_rad / 2), 0, 0, sign * math.sin(angle_rad / 2)]
    rotations[0] = [math.cos(turned_rad / 2), 0, math.sin(turned_rad / 2), 0]
    return SkeletonPose(pose.root_position, rotations, pose.confidence)


def links_of(pose: SkeletonPose) -> NDArray[np.float32]:
    """``T_world_link`` (L, 4, 4) of the capsule person in ``pose``."""
    return forward_kinematics(SKELETON, pose)


def capsule_views(pose: SkeletonPose, cameras: int = 4) -> tuple[View, ...]:
    """True depth and colour of the person in ``pose``."""
    person = capsule_person(pose=pose).mesh
    views = []
    for index in range(cameras):
        camera = ring_camera(index, cameras)
        crop = render_crop(person.vertices, person.faces, person.surface, camera)
        assert crop is not None
        depth_mm = np.rint(crop.depth * 1000).astype(np.uint16)
        views.append(View(camera, crop.u0, crop.v0, depth_mm, crop.colour))
    return tuple(views)


@cache
def captured(angle_rad: float, pose_id: int = 0, capture_ns: int = 0, cameras: int = 4) -> RiggedMesh:
    """The person captured with the arms lowered by ``angle_rad``."""
    pose = arms_down_by(angle_rad)
    return build_rigged_mesh(pose_id, capture_ns, SKELETON, pose, capsule_views(pose, cameras))
