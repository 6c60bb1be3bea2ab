"""What a limb tracker is measured against: a skinned body's own joints, as links, angles and points of its limbs.

A link's frame is the body joint's frame turned by a constant, so that the bone lies where the link tree's rest pose has
it (arms along ±x, legs along −y) and the axis the performer's elbow really turns about is the link's y.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_NAMES, LINK_PARENTS, SIDES, Skeleton, human_skeleton
from common.geometry import quaternion
from common.geometry.rigid_transform import rigid_transform
from sender.capture.body_performer import PoseTrack
from sender.capture.skinned_body import SkinnedBody

Array = NDArray[Any]
Floats = NDArray[np.float64]

_CENTRAL = {"pelvis": "Hips", "lower_spine": "LowerBack", "upper_spine": "Spine1", "neck": "Neck", "head": "Head"}
_SIDE = {
    "clavicle": "Shoulder",
    "upper_arm": "Arm",
    "forearm": "ForeArm",
    "hand": "Hand",
    "fingers": "FingerBase",
    "thigh": "UpLeg",
    "shin": "Leg",
    "foot": "Foot",
    "toes": "ToeBase",
}
JOINT_OF_LINK = tuple(
    _CENTRAL[name] if name in _CENTRAL else name.partition("_")[0].capitalize() + _SIDE[name.partition("_")[2]]
    for name in LINK_NAMES
)


@dataclass(frozen=True, slots=True, eq=False)
class LinkedBody:
    """A skinned body read as the link tree. ``skeleton``: its own sizes, radii average for its stature. ``joints``
    (L,): the body's joint each link follows. ``R_joint_link`` (L, 3, 3)."""

    body: SkinnedBody
    skeleton: Skeleton
    joints: Array
    R_joint_link: Floats

    def link_transforms(self, T_world_joint: Floats) -> Floats:
        """``T_world_link`` (L, 4, 4) of posed joints (J, 3, 4)."""
        T = T_world_joint[self.joints]
        return np.asarray(rigid_transform(T[:, :, :3] @ self.R_joint_link, T[:, :, 3]))

    def faces_of(self, links: tuple[str, ...]) -> NDArray[np.int32]:
        """Triangles (F', 3) of the body's mesh whose corners are all moved most by joints of ``links``."""
        strongest = np.take_along_axis(self.body.skin_joints, self.body.skin_weights.argmax(1)[:, None], axis=1)[:, 0]
        joints = [self.joints[LINK_INDEX[name]] for name in links]
        member = np.isin(strongest, joints)[self.body.point_of_vertex]
        faces = self.body.mesh.faces
        return np.ascontiguousarray(faces[member[faces].all(axis=1)])


def linked_body(body: SkinnedBody, track: PoseTrack) -> LinkedBody:
    """The body's sizes, read off its rest pose, and its link frames; ``track`` shows the axes of the elbows."""
    joints = np.array([body.joint(name) for name in JOINT_OF_LINK])
    heads = body.heads[joints]
    R = np.tile(np.eye(3), (LINK_COUNT, 1, 1))
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        upper, fore, hand, thigh, shin, foot = (
            LINK_INDEX[f"{side}_{part}"] for part in ("upper_arm", "forearm", "hand", "thigh", "shin", "foot")
        )
        axis = _hinge_axis(track.local[:, joints[fore]])
        R[upper] = _frame(sign * (heads[fore] - heads[upper]), axis)
        R[fore] = R[hand] = R[LINK_INDEX[f"{side}_fingers"]] = _frame(sign * (heads[hand] - heads[fore]), axis)
        for link, child in ((thigh, shin), (shin, foot)):
            arc = quaternion.shortest_arc(np.array([0.0, -1.0, 0.0]), heads[child] - heads[link])
            R[link] = quaternion.to_matrix(arc)
    average = human_skeleton(float(np.ptp(body.points[:, 1])))
    parents = np.array(LINK_PARENTS[1:])
    offsets = np.zeros((LINK_COUNT, 3))
    offsets[1:] = np.einsum("lji,lj->li", R[parents], heads[1:] - heads[parents])
    tips = average.tips.astype(np.float64)
    for link, parent in enumerate(LINK_PARENTS):
        if link and LINK_NAMES[parent] not in ("pelvis", "upper_spine"):
            tips[parent] = offsets[link]
    skeleton = Skeleton(offsets.astype(np.float32), tips.astype(np.float32), average.radii)
    return LinkedBody(body, skeleton, joints, R)


def _hinge_axis(local: Floats) -> Floats:
    """Unit axis (3,), upwards, about which local rotations (F, 4) turn: of the widest turn from the first."""
    turns = quaternion.to_rotation_vector(quaternion.multiply(local, quaternion.conjugate(local[0])))
    widest = turns[np.linalg.norm(turns, axis=1).argmax()]
    return np.asarray(widest / np.linalg.norm(widest) * (1 if widest[1] > 0 else -1))


def _frame(x: Floats, near_y: Floats) -> Floats:
    """Right-handed axes (3, 3) as columns: the first along ``x``, the second as near ``near_y`` as it can be."""
    x = x / np.linalg.norm(x)
    y = near_y - x * (x @ near_y)
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def posed_joints(body: SkinnedBody, track: PoseTrack, rate_hz: float, seconds: float | None) -> Iterator[Floats]:
    """``T_world_joint`` (J, 3, 4) of the track's own poses (none between them) at ``rate_hz``, at most ``seconds``."""
    step = round(track.frame_rate_hz / rate_hz)
    last = len(track.root) if seconds is None else min(len(track.root), int(seconds * track.frame_rate_hz) + 1)
    for frame in range(0, last, step):
        yield body.joint_transforms(track.local[frame], track.root[frame])
