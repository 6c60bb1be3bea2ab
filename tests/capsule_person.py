"""A person made of capsules, one per link, each in a colour of its own: a rigged mesh for tests of what shows one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from common.body.joint_edges import joint_edges
from common.body.link_points import LinkPoints
from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton import LINK_COUNT, LINK_INDEX, Skeleton, human_skeleton
from common.body.skeleton_pose import SkeletonPose, bone_segments, forward_kinematics, joint_positions, rest_pose
from common.body.skinning import link_motion
from common.body.vertex_blend import vertex_blend
from common.body.vertex_regions import vertex_regions
from common.geometry.rigid_transform import inverse
from common.geometry.triangle_mesh import TriangleMesh
from receiver.viewer.viewer import ShownFrame

SKELETON: Skeleton = human_skeleton(1.75)
SHIRT, SKIN, TROUSERS = (60, 120, 220), (230, 170, 130), (90, 75, 65)
_PALETTE = (SHIRT, SKIN, TROUSERS)
_PATCH = 16  # pixels of each colour's square in the texture: whole JPEG blocks, which then keep the colour
_NOBODY = (255, 0, 255)  # where the texture holds no colour of the person: seen if it is mirrored or turned
_RINGS, _SEGMENTS = 10, 16


def pose_at(time_s: float) -> SkeletonPose:
    """Arms that wave, knees that bend: every second looks different."""
    pose = rest_pose(np.array([0.25 * math.sin(0.7 * time_s), 0.93, 0], np.float32))
    rotations = pose.rotations.copy()
    swing = 0.6 * math.sin(2 * time_s)
    for name, axis, angle in (
        ("left_upper_arm", 2, swing - 0.5),
        ("right_upper_arm", 2, swing + 0.5),
        ("left_forearm", 1, -0.5 - swing),
        ("left_thigh", 0, -0.3 + 0.4 * swing),
        ("left_shin", 0, 0.4),
        ("pelvis", 1, 0.5 * swing),
    ):
        rotations[LINK_INDEX[name]] = [math.cos(angle / 2), *(math.sin(angle / 2) * np.eye(3)[axis])]
    return SkeletonPose(pose.root_position, rotations, pose.confidence)


def capsule_person(pose_id: int = 0, pose: SkeletonPose | None = None) -> RiggedMesh:
    """The person as captured in ``pose`` (rest pose if None)."""
    pose = pose or rest_pose(np.array([0, 0.93, 0], np.float32))
    T_world_link = forward_kinematics(SKELETON, pose)
    starts, ends = bone_segments(SKELETON, T_world_link)
    vertices, faces = zip(*(_capsule(*bone) for bone in zip(starts, ends, SKELETON.radii, strict=True)), strict=True)
    per_link = len(vertices[0])
    mesh = TriangleMesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate([f + per_link * link for link, f in enumerate(faces)]).astype(np.int32),
        np.repeat([_patch_centre(_colour(link)) for link in range(LINK_COUNT)], per_link, axis=0).astype(np.float32),
        _texture(),
    )
    vertex_link = np.repeat(np.arange(LINK_COUNT, dtype=np.uint8), per_link)
    T_link_world = inverse(T_world_link.astype(np.float64))
    edges = joint_edges(
        mesh.vertices, mesh.faces, vertex_regions(mesh.vertices, vertex_link, SKELETON, T_link_world), T_link_world
    )
    blend = vertex_blend(mesh.vertices, vertex_link, SKELETON, T_world_link)
    return RiggedMesh(pose_id, 0, SKELETON, pose, T_link_world, mesh, vertex_link, blend, mesh.faces, edges)


def shown_frame(mesh: RiggedMesh | None, time_s: float, sequence: int = 0) -> ShownFrame:
    """What the receiver would show at ``time_s``; with no mesh, the joints alone."""
    pose = pose_at(time_s)
    links = forward_kinematics(SKELETON, pose)
    motion = None if mesh is None else link_motion(mesh, links)
    pose_id = None if mesh is None else mesh.pose_id
    joints = joint_positions(SKELETON, pose)
    return ShownFrame(
        int(time_s * 1e9), sequence, pose_id, motion, joints, 0.031, 0.9, pose.confidence, 42.0, links=links[:, :3]
    )


def link_points(person: RiggedMesh, every: int = 1) -> LinkPoints:
    """Its vertices as points on their links, coloured as the texture is there."""
    link = person.vertex_link[::every]
    T_link_world = person.T_link_world[link]
    vertices = person.mesh.vertices[::every]
    positions = np.einsum("nij,nj->ni", T_link_world[:, :3, :3], vertices) + T_link_world[:, :3, 3]
    height, width = person.mesh.texture.shape[:2]
    column, row = (person.mesh.uv[::every] * [width, height]).astype(int).clip(0, [width - 1, height - 1]).T
    return LinkPoints(positions.astype(np.float32), link, person.mesh.texture[row, column])


def _colour(link: int) -> tuple[int, int, int]:
    if link in _SKIN_LINKS:
        return SKIN
    return TROUSERS if link in _TROUSER_LINKS else SHIRT


def _patch_centre(colour: tuple[int, int, int]) -> tuple[float, float]:
    place = (_PALETTE.index(colour) + 0.5) / len(_PALETTE)
    return place, place


def _texture() -> NDArray[np.uint8]:
    """A square for each colour, down the diagonal."""
    side = _PATCH * len(_PALETTE)
    texture = np.full((side, side, 3), _NOBODY, np.uint8)
    for index, colour in enumerate(_PALETTE):
        square = slice(_PATCH * index, _PATCH * (index + 1))
        texture[square, square] = colour
    return texture


def _links(*parts: str) -> frozenset[int]:
    return frozenset(
        LINK_INDEX[name] for name in LINK_INDEX if name.removeprefix("left_").removeprefix("right_") in parts
    )


_SKIN_LINKS = _links("head", "neck", "forearm", "hand", "fingers")
_TROUSER_LINKS = _links("pelvis", "thigh", "shin")


def _capsule(
    start: NDArray[np.float32], end: NDArray[np.float32], radius: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and outward faces of a capsule around the bone from ``start`` to ``end`` [m]."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    across = np.cross(axis, side)
    latitude = np.linspace(-math.pi / 2, math.pi / 2, _RINGS)
    longitude = np.linspace(0, 2 * math.pi, _SEGMENTS, endpoint=False)
    centres = np.where(latitude[:, None] < 0, start, end) + radius * np.sin(latitude)[:, None] * axis
    around = np.cos(longitude)[:, None] * side + np.sin(longitude)[:, None] * across
    vertices = centres[:, None] + radius * np.cos(latitude)[:, None, None] * around
    ring, segment = np.meshgrid(np.arange(_RINGS - 1), np.arange(_SEGMENTS), indexing="ij")
    here, right = ring * _SEGMENTS + segment, ring * _SEGMENTS + (segment + 1) % _SEGMENTS
    up, up_right = here + _SEGMENTS, right + _SEGMENTS
    faces = np.stack([np.stack([here, right, up_right], -1), np.stack([here, up_right, up], -1)], -2)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)
