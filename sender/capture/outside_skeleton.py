"""A skeleton that a sensor's or tracker's own software found: joints with their tracking state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_ARM, _LEG = ("shoulder", "elbow", "wrist", "hand"), ("hip", "knee", "ankle", "foot")
_LIMBS = tuple(f"{side}_{joint}" for limb in (_ARM, _LEG) for side in ("left", "right") for joint in limb)

# Joints in the order in which the sensors' software numbers them. Left is the person's.
KINECT_V1_JOINTS = ("hip_centre", "spine", "shoulder_centre", "head", *_LIMBS)
KINECT_V2_JOINTS = (
    *("spine_base", "spine_mid", "neck", "head"),
    *_LIMBS,
    *("spine_shoulder", "left_hand_tip", "left_thumb", "right_hand_tip", "right_thumb"),
)
JOINTS_BY_KIND = {"kinect-v1": KINECT_V1_JOINTS, "kinect-v2": KINECT_V2_JOINTS}
_KIND_BY_COUNT = {len(joints): kind for kind, joints in JOINTS_BY_KIND.items()}
MAX_SENSORS = 16
FAR_M = 100.0  # a joint farther from the world's origin is a fault of the software or of the file


@dataclass(frozen=True, slots=True, eq=False)
class OutsideSkeleton:
    """One person as one sensor sees them.

    ``capture_ns``: when, on the clock of all the source's data. ``sensor``: which of the source's. ``joints`` (J, 3)
    float32 [m, world], J = 20 (``KINECT_V1_JOINTS``) or 25 (``KINECT_V2_JOINTS``). ``confidence`` (J,) float32 in
    [0, 1]: 1 tracked, 0 not tracked, its place then means nothing; between them guessed from other joints.

    Raises:
        ValueError: another number of joints, a value that is not finite or absurd.
    """

    capture_ns: int
    sensor: int
    joints: NDArray[np.float32]
    confidence: NDArray[np.float32]

    def __post_init__(self) -> None:
        joints = np.ascontiguousarray(self.joints, np.float32)
        confidence = np.ascontiguousarray(self.confidence, np.float32)
        if joints.ndim != 2 or joints.shape[1] != 3 or len(joints) not in _KIND_BY_COUNT:
            raise ValueError(f"joints are {joints.shape}, not (20, 3) or (25, 3)")
        if confidence.shape != (len(joints),):
            raise ValueError(f"confidence is {confidence.shape} for {len(joints)} joints")
        if not (np.abs(joints) < FAR_M).all():  # NaN compares false
            raise ValueError(f"a joint is not finite, or {FAR_M:.0f} m away")
        if not ((confidence >= 0) & (confidence <= 1)).all():
            raise ValueError("a confidence lies outside 0..1")
        object.__setattr__(self, "joints", joints)
        object.__setattr__(self, "confidence", confidence)

    @property
    def kind(self) -> str:
        """``kinect-v1`` or ``kinect-v2``."""
        return _KIND_BY_COUNT[len(self.joints)]


@dataclass(frozen=True, slots=True)
class Sensor:
    """Where a sensor stands: ``position`` (x, y, z) [m, world]. What it sees from the side it sees badly."""

    name: str
    position: tuple[float, float, float]


Instant = tuple[OutsideSkeleton, ...]  # at most one of each sensor, taken together


@dataclass(frozen=True, slots=True, eq=False)
class SkeletonRecording:
    """``instants``: the skeletons that belong together, in order of time; times [ns] count from the first one."""

    kind: str
    sensors: tuple[Sensor, ...]
    frame_rate_hz: float
    instants: tuple[Instant, ...]
