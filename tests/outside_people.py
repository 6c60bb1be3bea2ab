"""Skeletons as sensors with a tracker of their own would deliver them, of a person whose pose is known."""

from __future__ import annotations

import math

import numpy as np

from common.body.skeleton import LINK_INDEX
from common.body.skeleton_pose import SkeletonPose
from common.geometry import quaternion
from sender.capture.outside_skeleton import JOINTS_BY_KIND, OutsideSkeleton, Sensor, SkeletonRecording
from sender.fitting.outside_joints import sensor_joints
from tests.capsule_person import SKELETON, pose_at

FRAME_NS = 33_333_333
SENSORS = (Sensor("left", (1.0, 1.0, 2.5)), Sensor("right", (-1.0, 1.0, 2.5)))


def bent_pose(seed: int) -> SkeletonPose:
    """Turned anywhere, elbows and knees bent, every other joint of the limbs turned at will."""
    random = np.random.default_rng(seed)
    pose = pose_at(0.0)
    rotations = pose.rotations.astype(np.float64)

    def turn(name: str, vector: np.ndarray) -> None:
        rotations[LINK_INDEX[name]] = quaternion.from_rotation_vector(vector)

    turn("pelvis", np.array([0.3, 2.0, 0.2]) * random.uniform(-1, 1, 3))
    turn("upper_spine", 0.3 * random.uniform(-1, 1, 3) * (0, 1, 1))
    turn("head", 0.3 * random.uniform(-1, 1, 3) * (1, 0, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        turn(f"{side}_upper_arm", 0.8 * random.uniform(-1, 1, 3))
        turn(f"{side}_forearm", np.array([0.0, -sign * random.uniform(0.4, 1.8), 0.0]))
        turn(f"{side}_thigh", 0.6 * random.uniform(-1, 1, 3))
        turn(f"{side}_shin", np.array([random.uniform(0.4, 1.5), 0.0, 0.0]))
    return SkeletonPose(pose.root_position, rotations.astype(np.float32), pose.confidence)


def person_at(frame: int, kind: str = "kinect-v2") -> np.ndarray:
    """Joints (J, 3) [m] of the person who waves."""
    return sensor_joints(SKELETON, pose_at(frame * FRAME_NS / 1e9), kind)


def seen(
    frame: int, sensor: int, joints: np.ndarray, confidence: np.ndarray | None = None, age_ns: int = 0
) -> OutsideSkeleton:
    """A sensor's word at a frame."""
    sure = np.ones(len(joints), np.float32) if confidence is None else confidence
    return OutsideSkeleton(frame * FRAME_NS - age_ns, sensor, joints.astype(np.float32), sure.astype(np.float32))


def recording(frames: int = 30, kind: str = "kinect-v2") -> SkeletonRecording:
    """Two faultless sensors."""
    instants = tuple(tuple(seen(f, s, person_at(f, kind)) for s in (0, 1)) for f in range(frames))
    return SkeletonRecording(kind, SENSORS, 30.0, instants)


def row_of(joint: str, kind: str = "kinect-v2") -> int:
    """Where a joint stands among its kind's."""
    return JOINTS_BY_KIND[kind].index(joint)


def wobble(frame: int, size_m: float) -> np.ndarray:
    """An offset (3,) [m] that swings slowly."""
    return size_m * np.array([math.sin(frame / 40), 0.0, math.cos(frame / 40)])
