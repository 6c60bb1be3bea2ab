"""How long a person's bones are, from joints measured over many frames: medians, settled ever more seldom."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sender.capture.outside_skeleton import JOINTS_BY_KIND

Floats = NDArray[np.float64]

SAMPLES = 512  # frames the medians are taken over
_TRUNK = {
    "kinect-v1": (("hip_centre", "spine"), ("spine", "shoulder_centre"), ("shoulder_centre", "head")),
    "kinect-v2": (
        ("spine_base", "spine_mid"),
        ("spine_mid", "spine_shoulder"),
        ("spine_shoulder", "neck"),
        ("neck", "head"),
    ),
}
_ENDS = {"kinect-v1": ("hip_centre", "shoulder_centre"), "kinect-v2": ("spine_base", "spine_shoulder")}
_LIMBS = (("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "hand"), ("hip", "knee"), ("knee", "ankle"),
          ("ankle", "foot"))  # fmt: skip
_FINGERS = (("hand", "hand_tip"), ("wrist", "thumb"))


def bones_of(kind: str) -> NDArray[np.int64]:
    """The bones (B, 2) between the joints of ``kind``: a tree, parent first, from the hips outwards."""
    hips, shoulders = _ENDS[kind]
    bones = list(_TRUNK[kind])
    for side in ("left", "right"):
        bones += [(shoulders, f"{side}_shoulder"), (hips, f"{side}_hip")]
        limbs = _LIMBS + (_FINGERS if kind == "kinect-v2" else ())
        bones += [(f"{side}_{a}", f"{side}_{b}") for a, b in limbs]
    names = JOINTS_BY_KIND[kind]
    return np.array([(names.index(a), names.index(b)) for a, b in bones], np.int64)


class RunningMedian:
    """The median over frames of a vector (N,): the estimate is renewed after 1, 2, 4, 8 ... frames, so that it changes
    seldom, and after ``SAMPLES`` no more. What a frame does not show is NaN."""

    def __init__(self, size: int) -> None:
        self._samples = np.empty((SAMPLES, size))
        self.count = 0
        self.value: Floats = np.full(size, np.nan)

    @property
    def settled(self) -> bool:
        """Whether the estimate is final."""
        return self.count >= SAMPLES

    def update(self, sample: Floats) -> Floats:
        """The estimate (N,) after this frame; NaN of what no frame has shown."""
        if not self.settled:
            self._samples[self.count] = sample
            self.count += 1
            if self.count & (self.count - 1) == 0:  # a power of two
                self.value = _medians(self._samples[: self.count])
        return self.value


def _medians(samples: Floats) -> Floats:
    seen = np.isfinite(samples).any(axis=0)
    value = np.full(samples.shape[1], np.nan)
    value[seen] = np.nanmedian(samples[:, seen], axis=0)
    return value
