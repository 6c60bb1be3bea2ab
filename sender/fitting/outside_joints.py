"""Which point of our link tree each joint of a sensor's skeleton is.

A sensor's joint is a link's joint, or a point along its bone. The Kinects' "shoulder centre" is the base of the neck,
their head the middle of the head, Kinect v2's neck lies above its "spine shoulder", and the feet end at the balls.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, SIDES, Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from sender.capture.outside_skeleton import JOINTS_BY_KIND

Floats = NDArray[np.float64]

HEAD_MIDDLE = 0.5  # of the head's bone
_LINK_OF = {
    "hip_centre": "pelvis",
    "spine": "lower_spine",
    "shoulder_centre": "neck",
    "spine_base": "pelvis",
    "spine_mid": "upper_spine",
    "spine_shoulder": "neck",
    "neck": "head",
    "head": "head",
    "shoulder": "upper_arm",
    "elbow": "forearm",
    "wrist": "hand",
    "hand": "fingers",
    "hand_tip": "fingers",
    "thumb": "hand",
    "hip": "thigh",
    "knee": "shin",
    "ankle": "foot",
    "foot": "toes",
}
_ALONG = {"head": HEAD_MIDDLE, "hand_tip": 1.0, "thumb": 0.5}  # share of the bone; the others sit at its joint
_THUMB_ASIDE = 0.5  # of the hand's length, to its front in the T-pose


def link_of(joint: str) -> str:
    """The link that carries a sensor's joint, named as in ``JOINTS_BY_KIND``."""
    side, _, part = joint.partition("_")
    return f"{side}_{_LINK_OF[part]}" if side in SIDES else _LINK_OF[joint]


def joint_links(kind: str) -> NDArray[np.int64]:
    """Links (J,) that carry the joints of ``kind``."""
    return np.array([LINK_INDEX[link_of(joint)] for joint in JOINTS_BY_KIND[kind]], np.int64)


def sensor_joints(skeleton: Skeleton, pose: SkeletonPose, kind: str) -> Floats:
    """Where a sensor that makes no errors would see the joints (J, 3) [m, world] of our pose."""
    names, links = JOINTS_BY_KIND[kind], joint_links(kind)
    parts = [name.removeprefix("left_").removeprefix("right_") for name in names]
    tips = skeleton.tips[links].astype(np.float64)
    local = np.array([_ALONG.get(part, 0.0) for part in parts])[:, None] * tips
    for row, part in enumerate(parts):
        if part == "thumb":
            local[row, 2] += _THUMB_ASIDE * np.linalg.norm(tips[row])
    T = forward_kinematics(skeleton, pose)[links].astype(np.float64)
    return np.asarray(T[:, :3, 3] + np.einsum("jab,jb->ja", T[:, :3, :3], local))
