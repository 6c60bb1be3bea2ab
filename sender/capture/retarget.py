"""Plays a motion clip on a skinned body of other proportions and another rest pose.

Every body joint takes the world rotation of the bone that drives it, ``G_joint = R_bone A_joint``, where the constant
``A_joint`` turns the body's rest pose into the clip's zero pose. The middle of the hip joints follows the clip's,
scaled by the length of the legs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from common.geometry import quaternion
from sender.capture.body_performer import PoseTrack
from sender.capture.mocap import MotionClip
from sender.capture.skinned_body import SkinnedBody

Floats = NDArray[np.float64]

TRAVEL_M = 1.2  # clips that go further walk on the spot
_TREADMILL_S = 0.3  # standard deviation of the smoothed path that is taken away from them
_JUMP_RAD = np.pi / 2  # nobody turns a joint this far in one frame: the source's angles flipped
_FASTEST_RAD = np.deg2rad(25)  # per frame: at 60 frames/s as fast as a shoulder in a throw
_FLOOR_PERCENTILE = 10  # of the lowest foot point over a clip: the floor; feet sink and float by centimetres about it

# Body joints that do not swing to the clip's bone directions keep their rest orientation or their parent's.
SIDES = ("Left", "Right")
_UPRIGHT = {
    "Hips": "root",
    "LowerBack": "lowerback",
    "Spine": "upperback",
    "Spine1": "thorax",
    "Neck": "lowerneck",
    "Neck1": "upperneck",
    "Head": "head",
}
_SIDE = {
    "{T}HipJoint": "{c}hipjoint",
    "{S}UpLeg": "{c}femur",
    "{S}Leg": "{c}tibia",
    "{S}Foot": "{c}foot",
    "{S}ToeBase": "{c}toes",
    "{S}Shoulder": "{c}clavicle",
    "{S}Arm": "{c}humerus",
    "{S}ForeArm": "{c}radius",
    "{S}Hand": "{c}wrist",
    "{S}FingerBase": "{c}hand",
    "{S}HandFinger1": "{c}fingers",
    "{T}Thumb": "{c}thumb",
}
DRIVING_BONE = _UPRIGHT | {
    joint.format(S=side, T=side[0]): bone.format(c=side[0].lower()) for side in SIDES for joint, bone in _SIDE.items()
}
_SWINGING = ("UpLeg", "Leg", "Arm", "ForeArm", "Hand", "FingerBase")
_LIMBS = (("UpLeg", "Leg", "Foot"), ("Arm", "ForeArm", "Hand"))
_FOLLOWING = ("HandFinger1", "Thumb")


def retarget(body: SkinnedBody, clip: MotionClip, on_the_spot: bool = True) -> PoseTrack:
    """The clip as poses of the body, at the clip's frame rate.

    The person faces +Z in the first frame, stands on y = 0 and stays near the origin: clips that travel more than
    ``TRAVEL_M`` lose their smoothed horizontal path unless ``on_the_spot`` is False, others are centred. A clip with
    ``support`` is cyclic and its feet stand where they are put.

    Raises:
        CaptureError: the body has a joint no bone drives, or the clip lacks a bone.
    """
    world = _world_rotations(body, clip)
    local = _without_flips(_local_rotations(world, body.parents), body)
    hips = (body.heads[body.joint("LeftUpLeg")] + body.heads[body.joint("RightUpLeg")]) / 2
    offset = quaternion.to_matrix(local[:, 0]) @ (hips - body.heads[0])
    path = _hip_path(body, clip)
    start = path[0].copy()
    heading = _heading(local[0, 0])
    local[:, 0] = quaternion.multiply(heading, local[:, 0])
    root = (path - start - offset) @ quaternion.to_matrix(heading).T + start
    if clip.support is None:
        root[:, [0, 2]] -= _horizontal_path(root[:, [0, 2]], clip.frame_rate_hz, on_the_spot)
        root[:, 1] -= np.percentile(body.lowest_foot(local, root), _FLOOR_PERCENTILE)
    else:
        root[:, [0, 2]] = _path_of_standing_feet(body, local, clip.support)
        root[:, 1] -= body.lowest_foot(local, root)
    return PoseTrack(clip.frame_rate_hz, local, root, cyclic=clip.support is not None)


def _world_rotations(body: SkinnedBody, clip: MotionClip) -> Floats:
    """``G`` (F, J, 4): world rotation of every joint from the body's rest pose."""
    bones = [clip.bone(DRIVING_BONE.get(joint, joint)) for joint in body.joint_names]
    return quaternion.multiply(quaternion.from_matrix(clip.rotations[:, bones]), _alignment(body, clip))


def _alignment(body: SkinnedBody, clip: MotionClip) -> Floats:
    """``A`` (J, 4): the body's rest pose to the clip's zero pose."""
    alignment = np.tile(quaternion.IDENTITY, (len(body.joint_names), 1))
    for j, name in enumerate(body.joint_names):
        parent = alignment[body.parents[j]] if body.parents[j] >= 0 else quaternion.IDENTITY
        bone = DRIVING_BONE.get(name, name)
        if name.endswith(("Foot", "ToeBase")):  # feet are flat at rest but tilted with the legs in the zero pose
            shin = clip.directions[clip.bone(bone[0] + "tibia")]
            alignment[j] = quaternion.shortest_arc(np.array([0.0, -1.0, 0.0]), shin)
        elif name.endswith(_FOLLOWING):
            alignment[j] = parent
        elif name.endswith(_SWINGING):
            at_rest = quaternion.to_matrix(parent) @ (body.tails[j] - body.heads[j])
            alignment[j] = quaternion.multiply(
                quaternion.shortest_arc(at_rest, clip.directions[clip.bone(bone)]), parent
            )
        elif name == "Head":
            alignment[j] = quaternion.from_rotation_vector(np.array([-clip.head_pitch_rad, 0.0, 0.0]))
    return alignment


def _local_rotations(world: Floats, parents: NDArray[np.int32]) -> Floats:
    parent = np.where((parents >= 0)[:, None], world[:, parents], quaternion.IDENTITY)
    return quaternion.multiply(quaternion.conjugate(parent), world)


def _without_flips(local: Floats, body: SkinnedBody) -> Floats:
    """Rotations (F, J, 4) whose joints never turn faster than ``_FASTEST_RAD`` per frame.

    Marker gaps make the source's limbs flip: the knee swivels about the line from hip to ankle and back. There the
    limb is swivelled back so that its end stays where it was captured; any other joint that flips holds still. The
    frame in the middle of the clip is taken to be right.
    """
    local = local.copy()
    turns = quaternion.angle_between(local[1:], local[:-1]).max(axis=1)
    if turns.max() < _FASTEST_RAD:
        return local
    limbs = {
        body.joint(s + root): (body.joint(s + mid), body.joint(s + end)) for s in SIDES for root, mid, end in _LIMBS
    }
    middle = len(local) // 2
    for frames in (range(middle + 1, len(local)), range(middle - 1, -1, -1)):
        before = local[middle]
        for f in frames:
            target = local[f].copy()
            for j in np.flatnonzero(quaternion.angle_between(target, before) > _JUMP_RAD).tolist():
                target[j] = before[j]
                if j in limbs:
                    mid, end = limbs[j]
                    lower = quaternion.to_matrix(local[f, mid]) @ (body.heads[end] - body.heads[mid])
                    target[j] = _swivelled(local[f, j], before[j], body.heads[mid] - body.heads[j] + lower)
            turn = quaternion.angle_between(target, before)
            before = local[f] = quaternion.slerp(before, target, np.minimum(1, _FASTEST_RAD / np.maximum(turn, 1e-9)))
    return local


def _swivelled(rotation: Floats, towards: Floats, axis: Floats) -> Floats:
    """``rotation`` (4,) after the turn about ``axis`` (3,) that brings it nearest to ``towards`` (swing and twist)."""
    difference = quaternion.multiply(quaternion.conjugate(rotation), towards)
    twist = np.concatenate([difference[:1], (difference[1:] @ axis) * axis / (axis @ axis)])
    return quaternion.multiply(rotation, twist / max(np.linalg.norm(twist), 1e-9))


def _hip_path(body: SkinnedBody, clip: MotionClip) -> Floats:
    """Middle of the hip joints (F, 3) [m], scaled to the body's legs (the clips' root lies well above the hips)."""
    names = [body.joint(name) for name in ("LeftUpLeg", "LeftLeg", "LeftFoot")]
    leg = np.linalg.norm(np.diff(body.heads[names], axis=0), axis=1).sum()
    clip_leg = clip.lengths_m[[clip.bone("lfemur"), clip.bone("ltibia")]].sum()
    return leg / clip_leg * (clip.tails[:, clip.bone("lhipjoint")] + clip.tails[:, clip.bone("rhipjoint")]) / 2


def _heading(hips: Floats) -> Floats:
    """Rotation about y that makes hips with rotation ``hips`` (4,) face +Z."""
    forward = quaternion.to_matrix(hips)[:, 2]
    return quaternion.from_rotation_vector(np.array([0.0, -np.arctan2(forward[0], forward[2]), 0.0]))


def _horizontal_path(path: Floats, frame_rate_hz: float, on_the_spot: bool) -> Floats:
    """What to take off a horizontal path (F, 2) [m] so that it stays near the origin, or starts there."""
    low, high = path.min(axis=0), path.max(axis=0)
    if np.linalg.norm(high - low) <= TRAVEL_M:
        return np.broadcast_to((low + high) / 2, path.shape)
    if not on_the_spot:
        return np.broadcast_to(path[0], path.shape)
    return gaussian_filter1d(path, _TREADMILL_S * frame_rate_hz, axis=0, mode="reflect")


def _path_of_standing_feet(body: SkinnedBody, local: Floats, support: Floats) -> Floats:
    """Horizontal root path (F, 2) [m] on which the feet that carry the weight do not slide; it ends where it began."""
    origin = np.zeros(3)
    soles = [body.joint("LeftToeBase"), body.joint("RightToeBase")]
    feet = np.array([body.joint_transforms(pose, origin)[soles][:, [0, 2], 3] for pose in local])
    weights = (support[1:] + support[:-1]) / 2
    steps = -(np.diff(feet, axis=0) * (weights / weights.sum(axis=1, keepdims=True))[..., None]).sum(axis=1)
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    path -= np.linspace(0, 1, len(path))[:, None] * path[-1]
    return path - (path.min(axis=0) + path.max(axis=0)) / 2
