"""A pose of the link tree from a sensor's joints.

The trunk's frames come from hips and shoulders, every other link is turned until its end points at the joint that was
seen, by the smallest turn from where its parent carries it. The twist of arms and legs comes from the bend of elbow and
knee, that of the hand from the thumb; a straight limb keeps what its parent carries.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_PARENTS, SIDES, Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.geometry import quaternion
from sender.capture.outside_skeleton import JOINTS_BY_KIND
from sender.fitting.outside_joints import HEAD_MIDDLE, joint_links
from sender.fitting.outside_sizes import TrunkJoints

Floats = NDArray[np.float64]

STRAIGHT = 0.15  # sine of the bend at which carried and seen twist weigh the same


class OutsidePose:
    """Poses from the joints of ``kind``. ``trunk_rows``: the joints without which there is no pose."""

    def __init__(self, kind: str) -> None:
        self._names = JOINTS_BY_KIND[kind]
        self._trunk = TrunkJoints(kind)
        self._links = joint_links(kind)
        self.trunk_rows = [
            self._trunk.base,
            self._trunk.middle,
            self._trunk.top,
            *self._trunk.hips,
            *self._trunk.shoulders,
        ]

    def fit(self, skeleton: Skeleton, joints: Floats, confidence: Floats) -> SkeletonPose:
        """The pose of ``skeleton`` whose joints are nearest to ``joints`` (J, 3) [m, world; NaN: never seen; the trunk
        always], with each
        link's confidence from those of its two ends, ``confidence`` (J,)."""
        fitting = _Fitting(skeleton, dict(zip(self._names, joints, strict=True)))
        fitting.trunk(self._trunk, joints)
        for side, along in zip(SIDES, (1.0, -1.0), strict=True):
            fitting.arm(side, along)
            fitting.leg(side)
        world = fitting.world
        local = world.copy()
        local[1:] = np.swapaxes(world[list(LINK_PARENTS[1:])], 1, 2) @ world[1:]
        rotations = quaternion.from_matrix(local).astype(np.float32)
        root = fitting.origins[0].astype(np.float32)
        return SkeletonPose(root, rotations, self._link_confidence(confidence))

    def _link_confidence(self, confidence: Floats) -> NDArray[np.float32]:
        """(L,): the less certain of the joints at a link's two ends; a link without any has its parent's."""
        least = np.full(LINK_COUNT, np.inf)
        for row, link in enumerate(self._links):
            for end in (link, LINK_PARENTS[link]):
                if end >= 0:
                    least[end] = min(least[end], confidence[row])
        for link in range(LINK_COUNT):
            if not np.isfinite(least[link]):
                least[link] = least[LINK_PARENTS[link]]
        return least.astype(np.float32)


class _Fitting:
    """One pose being put together from the root outwards: ``world`` (L, 3, 3) rotations, ``origins`` (L, 3) [m]."""

    def __init__(self, skeleton: Skeleton, seen: dict[str, Floats]) -> None:
        self._offsets = skeleton.offsets.astype(np.float64)
        self._tips = skeleton.tips.astype(np.float64)
        self._seen = seen
        self.world = np.tile(np.eye(3), (LINK_COUNT, 1, 1))
        self.origins = np.zeros((LINK_COUNT, 3))

    def trunk(self, trunk: TrunkJoints, joints: Floats) -> None:
        """Pelvis to head, and the clavicles."""
        self.origins[0] = joints[trunk.base]
        self.world[0] = trunk.pelvis_frame(joints)
        self._place("lower_spine")
        if trunk.middle_link == "lower_spine":
            self._aim("lower_spine", np.array([0.0, 1.0, 0.0]), joints[trunk.top])
        self._place("upper_spine")
        self.world[LINK_INDEX["upper_spine"]] = trunk.chest_frame(joints)
        self._place("neck")
        head = self._seen.get("neck", self._seen["head"])
        self._aim("neck", self._offsets[LINK_INDEX["head"]], head)
        self._place("head")
        self._aim("head", HEAD_MIDDLE * self._tips[LINK_INDEX["head"]], self._seen["head"])
        for side in SIDES:
            self._place(f"{side}_clavicle")
            shoulder = self._offsets[LINK_INDEX[f"{side}_upper_arm"]]
            self._aim(f"{side}_clavicle", shoulder, self._seen[f"{side}_shoulder"])

    def arm(self, side: str, along: float) -> None:
        """``along``: +1 when the arm lies along +x at rest, else −1. The elbow bends the forearm towards +z."""
        bone = np.array([along, 0.0, 0.0])
        elbow, wrist, hand = (self._seen[f"{side}_{joint}"] for joint in ("elbow", "wrist", "hand"))
        self._place(f"{side}_upper_arm")
        self._aim(f"{side}_upper_arm", bone, elbow)
        self._twist(f"{side}_upper_arm", bone, wrist - elbow, np.array([0.0, 0.0, 1.0]))
        self._place(f"{side}_forearm")
        self._aim(f"{side}_forearm", bone, wrist)
        thumb = self._seen.get(f"{side}_thumb")
        if thumb is not None:
            self._twist(f"{side}_forearm", bone, thumb - wrist, np.array([0.0, 0.0, 1.0]))
        self._place(f"{side}_hand")
        self._aim(f"{side}_hand", bone, hand)
        self._place(f"{side}_fingers")
        if f"{side}_hand_tip" in self._seen:
            self._aim(f"{side}_fingers", bone, self._seen[f"{side}_hand_tip"])

    def leg(self, side: str) -> None:
        """The knee bends the shin towards −z."""
        bone = np.array([0.0, -1.0, 0.0])
        knee, ankle = self._seen[f"{side}_knee"], self._seen[f"{side}_ankle"]
        self._place(f"{side}_thigh")
        self._aim(f"{side}_thigh", bone, knee)
        self._twist(f"{side}_thigh", bone, ankle - knee, np.array([0.0, 0.0, -1.0]))
        self._place(f"{side}_shin")
        self._aim(f"{side}_shin", bone, ankle)
        self._place(f"{side}_foot")
        self._aim(f"{side}_foot", self._offsets[LINK_INDEX[f"{side}_toes"]], self._seen[f"{side}_foot"])
        self._place(f"{side}_toes")

    def _place(self, name: str) -> None:
        """The link where its parent carries it."""
        link = LINK_INDEX[name]
        parent = LINK_PARENTS[link]
        self.world[link] = self.world[parent]
        self.origins[link] = self.origins[parent] + self.world[parent] @ self._offsets[link]

    def _aim(self, name: str, local: Floats, target: Floats) -> None:
        """Turn the link by the smallest turn that brings the direction ``local`` (3,) of its frame onto ``target``."""
        link = LINK_INDEX[name]
        wanted = target - self.origins[link]
        if np.linalg.norm(wanted) > 1e-6:  # False for NaN
            self.world[link] = _shortest_turn(self.world[link] @ local, wanted) @ self.world[link]

    def _twist(self, name: str, bone: Floats, towards: Floats, local: Floats) -> None:
        """Turn the link about its ``bone`` so that ``towards`` lies on the side of the direction ``local`` (3,) of its
        frame; the more so, the more it stands off the bone."""
        link = LINK_INDEX[name]
        axis, carried = self.world[link] @ bone, self.world[link] @ local
        length = float(np.linalg.norm(towards))
        if not length > 1e-6:
            return
        aside = towards / length - axis * (axis @ towards) / length
        blended = aside + STRAIGHT * carried * min(1.0, STRAIGHT / max(float(np.linalg.norm(aside)), 1e-6))
        blended -= axis * (axis @ blended)
        if np.linalg.norm(blended) > 1e-6:
            self.world[link] = _shortest_turn(carried, blended) @ self.world[link]


def _shortest_turn(a: Floats, b: Floats) -> Floats:
    """The smallest rotation (3, 3) of direction ``a`` (3,) onto ``b``; as ``quaternion.shortest_arc``, for one pair."""
    scale = float(np.sqrt((a @ a) * (b @ b)))
    cosine = float(a @ b) / scale
    if cosine < -0.999999:
        return np.asarray(quaternion.to_matrix(quaternion.shortest_arc(a, b)))
    x, y, z = (
        (a[1] * b[2] - a[2] * b[1]) / scale,
        (a[2] * b[0] - a[0] * b[2]) / scale,
        (a[0] * b[1] - a[1] * b[0]) / scale,
    )
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))
