"""Link sizes of a person from a sensor's joints, as medians over frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, LINK_PARENTS, SIDES, Skeleton, human_skeleton
from sender.capture.outside_skeleton import JOINTS_BY_KIND
from sender.fitting.bone_lengths import RunningMedian
from sender.fitting.outside_joints import HEAD_MIDDLE

Floats = NDArray[np.float64]

AVERAGE_STATURE_M = 1.70
_HEAD_JOINT = 0.4  # of the way from the base of the neck to the middle of the head; for sensors that do not see it
_CHAINS = (("arm", ("shoulder", "elbow", "wrist", "hand", "hand_tip")), ("leg", ("hip", "knee", "ankle", "foot")))
_LINKS = {"arm": ("forearm", "hand", "fingers", "fingers tip"), "leg": ("shin", "foot", "toes")}


class TrunkJoints:
    """The rows of the joints of ``kind`` that span the trunk, and its frames in any pose."""

    def __init__(self, kind: str) -> None:
        names = JOINTS_BY_KIND[kind]
        self.base = names.index("hip_centre" if kind == "kinect-v1" else "spine_base")
        self.middle = names.index("spine" if kind == "kinect-v1" else "spine_mid")
        self.top = names.index("shoulder_centre" if kind == "kinect-v1" else "spine_shoulder")
        self.middle_link = "lower_spine" if kind == "kinect-v1" else "upper_spine"
        self.hips = [names.index(f"{side}_hip") for side in SIDES]
        rest = human_skeleton(AVERAGE_STATURE_M).offsets[LINK_INDEX["neck"]].astype(np.float64)
        self._rest_chest = axes(np.array([1.0, 0.0, 0.0]), rest)
        self.shoulders = [names.index(f"{side}_shoulder") for side in SIDES]

    def pelvis_frame(self, joints: Floats) -> Floats:
        """Rotation (3, 3) of the pelvis: x through the hips, y up the spine."""
        return axes(joints[self.hips[0]] - joints[self.hips[1]], joints[self.middle] - joints[self.base])

    def chest_frame(self, joints: Floats) -> Floats:
        """Rotation (3, 3) of the chest: x through the shoulders, y up the spine, which leans back in our rest pose."""
        across = joints[self.shoulders[0]] - joints[self.shoulders[1]]
        seen = axes(across, joints[self.top] - joints[self.middle])
        return np.asarray(seen @ self._rest_chest.T)


def axes(x: Floats, near_y: Floats) -> Floats:
    """Right-handed axes (3, 3) as columns: the first along ``x``, the second as near ``near_y`` as it can be."""
    x = x / max(float(np.linalg.norm(x)), 1e-9)
    y = near_y - x * (x @ near_y)
    y = y / max(float(np.linalg.norm(y)), 1e-9)
    return np.stack([x, y, np.cross(x, y)], axis=1)


class OutsideSizes:
    """Sizes of one person's links from the joints of ``kind``; what the joints do not tell is average."""

    def __init__(self, kind: str) -> None:
        self._names = JOINTS_BY_KIND[kind]
        self._trunk = TrunkJoints(kind)
        self._sees_neck = "neck" in self._names
        self._bones = [
            (f"{side}_{link}", self._names.index(f"{side}_{a}"), self._names.index(f"{side}_{b}"))
            for side in SIDES
            for chain, joints in _CHAINS
            for link, a, b in zip(_LINKS[chain], joints, joints[1:], strict=False)
            if f"{side}_{b}" in self._names
        ]
        self._medians = RunningMedian(7 * 3 + 1 + len(self._bones))
        self.skeleton = human_skeleton(AVERAGE_STATURE_M)

    def update(self, joints: Floats) -> Skeleton:
        """The sizes after a frame's ``joints`` (J, 3) [m, world]; NaN for a joint that was not seen."""
        if self._medians.settled:
            return self.skeleton
        before = self._medians.value
        after = self._medians.update(self._measured(joints))
        if after is not before:
            self.skeleton = self._built(after)
        return self.skeleton

    def _measured(self, joints: Floats) -> Floats:
        """Hips and middle of the spine in the pelvis' frame, shoulders and neck in the chest's (7 × 3), length of the
        head with the neck's upper part, and the limbs' bones."""
        trunk = self._trunk
        lower = [*trunk.hips, trunk.middle]
        pelvis = (joints[lower] - joints[trunk.base]) @ trunk.pelvis_frame(joints)
        rows = [*trunk.shoulders, trunk.top, self._names.index("neck") if self._sees_neck else trunk.top]
        chest = (joints[rows] - joints[trunk.middle]) @ trunk.chest_frame(joints)
        head = np.linalg.norm(joints[self._names.index("head")] - joints[rows[3]])
        bones = [np.linalg.norm(joints[b] - joints[a]) for _, a, b in self._bones]
        return np.concatenate([pelvis.ravel(), chest.ravel(), [head], bones])

    def _built(self, medians: Floats) -> Skeleton:
        """The skeleton with these measures; NaN measures stay average."""
        places, head, bones = medians[:21].reshape(7, 3), float(medians[21]), medians[22:]
        average = human_skeleton(self._stature_m(bones))
        offsets, tips = average.offsets.astype(np.float64), average.tips.astype(np.float64)
        self._fill_trunk(offsets, places)
        self._fill_head(offsets, tips, places, head)
        for (link, _, _), length in zip(self._bones, bones, strict=True):
            sized = tips if link.endswith(" tip") else offsets
            bone = sized[LINK_INDEX[link.removesuffix(" tip")]]
            if np.isfinite(length):
                bone *= length / np.linalg.norm(bone)
        for row, parent in enumerate(LINK_PARENTS):
            if parent > 0 and parent != LINK_INDEX["upper_spine"]:
                tips[parent] = offsets[row]
        tips[0], tips[LINK_INDEX["upper_spine"]] = offsets[1], offsets[LINK_INDEX["neck"]]
        return Skeleton(offsets.astype(np.float32), tips.astype(np.float32), average.radii)

    def _stature_m(self, bones: Floats) -> float:
        """From the long bones that were measured, by average proportions."""
        average = human_skeleton(1.0)
        long = [
            length / np.linalg.norm(average.offsets[LINK_INDEX[link]])
            for (link, _, _), length in zip(self._bones, bones, strict=True)
            if link.endswith(("forearm", "_hand", "shin", "foot")) and np.isfinite(length)
        ]
        return float(np.clip(np.median(long), 0.5, 2.5)) if long else AVERAGE_STATURE_M

    def _fill_trunk(self, offsets: Floats, places: Floats) -> None:
        """Hips, spine and shoulders; a point of the spine that is not seen divides its part as on average."""
        lower, upper, neck = (LINK_INDEX[link] for link in ("lower_spine", "upper_spine", "neck"))
        for side, hip in zip(SIDES, places[:2], strict=True):
            _set(offsets, LINK_INDEX[f"{side}_thigh"], hip)
        if self._trunk.middle_link == "upper_spine":
            share = offsets[lower, 1] / (offsets[lower, 1] + offsets[upper, 1])
            _set(offsets, lower, share * places[2])
            _set(offsets, upper, (1 - share) * places[2])
            chest_m = places[5]
        else:
            share = offsets[upper, 1] / (offsets[upper, 1] + offsets[neck, 1])
            _set(offsets, lower, places[2])
            length = float(np.linalg.norm(places[5]))
            _set(offsets, upper, np.array([0.0, share * length, 0.0]))
            chest_m = (1 - share) * places[5]
            places = places - share * places[5]  # from the middle of the spine to the chest's joint
        _set(offsets, neck, chest_m)
        for side, shoulder in zip(SIDES, places[3:5], strict=True):
            clavicle = offsets[neck] + (shoulder - offsets[neck]) * (0.15, 0.8, 0.5)
            _set(offsets, LINK_INDEX[f"{side}_clavicle"], clavicle)
            _set(offsets, LINK_INDEX[f"{side}_upper_arm"], shoulder - clavicle)

    def _fill_head(self, offsets: Floats, tips: Floats, places: Floats, head_m: float) -> None:
        """``head_m``: from the head's joint to the middle of the head, or from the base of the neck when the sensor
        does not see that joint."""
        link = LINK_INDEX["head"]
        neck_m = float(np.linalg.norm(places[6] - places[5]))
        if not self._sees_neck:
            neck_m, head_m = _HEAD_JOINT * head_m, (1 - _HEAD_JOINT) * head_m
        if np.isfinite(neck_m) and np.isfinite(head_m):
            offsets[link] *= neck_m / np.linalg.norm(offsets[link])
            tips[link] *= head_m / HEAD_MIDDLE / np.linalg.norm(tips[link])


def _set(offsets: Floats, link: int, value: Floats) -> None:
    if np.isfinite(value).all():
        offsets[link] = value
