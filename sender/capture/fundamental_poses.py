"""The dataset of DISPOSE §7 made anew: twelve fundamental poses once (Fig. 5), then what the person likes to do.

The figure is a picture; the text names the T-pose, the arrow, folded arms and hands behind the back. The others are
what a person would add to show every joint. Each is held for a moment, with standing in between only where the way from
one to the next would lead through the body.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from common.geometry import quaternion
from sender.capture.body_performer import PoseTrack
from sender.capture.choreography import FOLDED, SQUAT, Pose, keyed_clip
from sender.capture.mocap import MotionClip

MOVE_S, HOLD_S, BETWEEN_S = 0.7, 0.4, 0.7
PREFIX = "dispose12+"  # before the motion that follows


def _arms(**angles: float) -> Pose:
    return {f"{side}_{name}": angle for side in ("left", "right") for name, angle in angles.items()}


FUNDAMENTAL_POSES: Mapping[str, Pose] = {
    "stand": {},
    "T-pose": _arms(lower=0, swing=0, elbow=0),
    "arrow": _arms(lower=45, swing=0, elbow=0),
    "arms up": _arms(lower=-70, swing=0, elbow=5),
    "arms forward": _arms(lower=0, across=85, swing=0, elbow=5),
    "hands on hips": _arms(lower=50, swing=-20, roll=60, elbow=95),
    "folded arms": FOLDED,
    "hands behind the back": _arms(lower=72, swing=-35, roll=40, elbow=60),
    "left leg up": {"left_flex": 60, "left_knee": 70, "left_flat": 0.3, "left_weight": 0, "left_lower": 60},
    "right leg up": {"right_flex": 60, "right_knee": 70, "right_flat": 0.3, "left_weight": 1, "right_lower": 60},
    "squat": SQUAT,
    "side bend": {"side": 28, "right_lower": -60, "right_elbow": 20},
}


FUNDAMENTAL_S = len(FUNDAMENTAL_POSES) * (HOLD_S + BETWEEN_S + MOVE_S)


def fundamental_poses() -> MotionClip:
    """The twelve poses one after the other as a clip that begins and ends standing."""
    keys: list[tuple[float, Pose]] = []
    time_s = 0.0
    for pose in FUNDAMENTAL_POSES.values():
        keys += [(time_s, pose), (time_s + HOLD_S, pose), (time_s + HOLD_S + BETWEEN_S, {})]
        time_s += HOLD_S + BETWEEN_S + MOVE_S
    return keyed_clip(keys)


def joined(first: PoseTrack, then: PoseTrack, blend_s: float = 1.0) -> PoseTrack:
    """Two tracks of one body and one frame rate as one that is played to and fro, with a blend between them.

    Raises:
        ValueError: the frame rates differ.
    """
    if first.frame_rate_hz != then.frame_rate_hz:
        raise ValueError(f"tracks of {first.frame_rate_hz:g} and {then.frame_rate_hz:g} frames/s")
    share = np.linspace(0, 1, round(blend_s * first.frame_rate_hz) + 1)[1:-1]
    share = share**2 * (3 - 2 * share)
    local = quaternion.slerp(first.local[-1:], then.local[:1], share[:, None])
    root = (1 - share)[:, None] * first.root[-1] + share[:, None] * then.root[0]
    return PoseTrack(
        first.frame_rate_hz,
        np.concatenate([first.local, local, then.local]),
        np.concatenate([first.root, root, then.root]),
        cyclic=False,
    )
