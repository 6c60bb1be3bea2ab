"""A start from joints known from elsewhere (a sensor's own skeleton): sizes and pose that have exactly these joints."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import (
    LINK_COUNT,
    LINK_INDEX,
    LINK_PARENTS,
    NAMED_JOINT_LINKS,
    NAMED_JOINTS,
    SIDES,
    Skeleton,
    human_skeleton,
)
from common.body.skeleton_pose import SkeletonPose
from common.geometry import quaternion

Array = NDArray[Any]


HEAD_AND_SOLES_M = 0.26  # from the joint of the head to the crown, and from the ankles to the soles


def stature_of(joints: Array) -> float:
    """Stature [m] of the person with these ``joints`` (16, 3) [m], whatever the posture: the bones laid end to end."""
    at = {name: joints[row] for row, (name, _) in enumerate(NAMED_JOINTS)}
    bones = [("head", "neck"), ("neck", "chest"), ("chest", "pelvis"), ("left_hip", "left_knee"),
             ("left_knee", "left_ankle")]  # fmt: skip
    return HEAD_AND_SOLES_M + float(sum(np.linalg.norm(at[a] - at[b]) for a, b in bones))


def skeleton_from_joints(joints: Array, stature_m: float | None = None) -> tuple[Skeleton, SkeletonPose]:
    """Sizes and pose with exactly these ``joints`` (16, 3) [m, world; ``NAMED_JOINTS`` order].

    The person faces +Z with the trunk upright; what the joints do not tell (radii, hands, feet, clavicles) is average
    for the stature [m].
    """
    at = {name: joints[row] for row, (name, _) in enumerate(NAMED_JOINTS)}
    average = human_skeleton(stature_of(joints) if stature_m is None else stature_m)
    rotations = _link_rotations(at)
    origins = _link_origins(joints, at, rotations, average)
    parents = np.array(LINK_PARENTS[1:])
    offsets = np.zeros((LINK_COUNT, 3))
    offsets[1:] = np.einsum("lji,lj->li", rotations[parents], origins[1:] - origins[parents])
    tips = average.tips.copy()
    for row, parent in enumerate(LINK_PARENTS):
        if parent > 0 and parent != LINK_INDEX["upper_spine"]:
            tips[parent] = offsets[row]
    tips[LINK_INDEX["pelvis"]] = offsets[LINK_INDEX["lower_spine"]]
    tips[LINK_INDEX["upper_spine"]] = offsets[LINK_INDEX["neck"]]
    local = rotations.copy()
    local[1:] = np.swapaxes(rotations[parents], 1, 2) @ rotations[1:]
    root = origins[0].astype(np.float32)
    pose = SkeletonPose(root, quaternion.from_matrix(local).astype(np.float32), np.ones(LINK_COUNT, np.float32))
    return Skeleton(offsets.astype(np.float32), tips, average.radii), pose


def _link_rotations(at: dict[str, Array]) -> Array:
    """World rotations (L, 3, 3): arms and legs along their bones, all else upright."""
    rotations = np.tile(np.eye(3), (LINK_COUNT, 1, 1))
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        shoulder, elbow, wrist, hip, knee, ankle = (
            at[f"{side}_{joint}"] for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        )
        upper = _axes(sign * (elbow - shoulder), wrist - elbow)  # bent about y: the forearm lies in the x-z plane
        fore = _axes(sign * (wrist - elbow), np.cross(wrist - elbow, upper[:, 1]) * sign)
        rotations[LINK_INDEX[f"{side}_upper_arm"]] = upper
        for part in ("forearm", "hand", "fingers"):
            rotations[LINK_INDEX[f"{side}_{part}"]] = fore
        for part, bone in (("thigh", knee - hip), ("shin", ankle - knee)):
            down = np.array([0.0, -1.0, 0.0])
            rotations[LINK_INDEX[f"{side}_{part}"]] = quaternion.to_matrix(quaternion.shortest_arc(down, bone))
    return rotations


def _link_origins(joints: Array, at: dict[str, Array], rotations: Array, average: Skeleton) -> Array:
    """World positions (L, 3) of all links' joints: the given ones, and the rest placed among them."""
    origins = np.full((LINK_COUNT, 3), np.nan)
    origins[NAMED_JOINT_LINKS] = joints
    origins[LINK_INDEX["lower_spine"]] = (at["pelvis"] + at["chest"]) / 2
    for side in SIDES:
        origins[LINK_INDEX[f"{side}_clavicle"]] = at["neck"] + (at[f"{side}_shoulder"] - at["neck"]) * (0.15, 0.8, 0.5)
    for row, parent in enumerate(LINK_PARENTS):
        if np.isnan(origins[row, 0]):
            origins[row] = origins[parent] + rotations[parent] @ average.offsets[row]
    return origins


def _axes(x: Array, near_z: Array) -> Array:
    """Right-handed axes (3, 3) as columns: the first along ``x``, the third as near ``near_z`` as it can be."""
    x = x / np.linalg.norm(x)
    z = near_z - x * (x @ near_z)
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)
