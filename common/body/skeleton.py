"""The link tree: a person as cylinders joined in a tree (Lien 2009 §5.1.1).

Rest pose: T-pose, person facing +Z, the person's left at +X, y up; at rest every link frame is parallel to the
world. A link's frame sits at its joint (the end nearer the root).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SIDES = ("left", "right")
_SIDE_CHAINS = (
    ("clavicle", "upper_spine"),
    ("upper_arm", "clavicle"),
    ("forearm", "upper_arm"),
    ("hand", "forearm"),
    ("fingers", "hand"),
    ("thigh", "pelvis"),
    ("shin", "thigh"),
    ("foot", "shin"),
    ("toes", "foot"),
)


def _human_tree() -> tuple[tuple[str, ...], tuple[int, ...]]:
    names = ["pelvis", "lower_spine", "upper_spine", "neck", "head"]
    parents = [-1, 0, 1, 2, 3]
    for side in SIDES:
        for link, parent in _SIDE_CHAINS:
            parent_name = parent if parent in names else f"{side}_{parent}"
            parents.append(names.index(parent_name))
            names.append(f"{side}_{link}")
    return tuple(names), tuple(parents)


LINK_NAMES, LINK_PARENTS = _human_tree()
LINK_COUNT = len(LINK_NAMES)
LINK_INDEX = {name: index for index, name in enumerate(LINK_NAMES)}

# The 16 joints accuracy is measured on, as (joint name, link whose origin it is).
NAMED_JOINTS: tuple[tuple[str, str], ...] = (
    ("pelvis", "pelvis"),
    ("chest", "upper_spine"),
    ("neck", "neck"),
    ("head", "head"),
    *((f"{s}_{joint}", f"{s}_{link}") for s in SIDES for joint, link in (
        ("shoulder", "upper_arm"),
        ("elbow", "forearm"),
        ("wrist", "hand"),
        ("hip", "thigh"),
        ("knee", "shin"),
        ("ankle", "foot"),
    )),
)  # fmt: skip
NAMED_JOINT_LINKS = np.array([LINK_INDEX[link] for _, link in NAMED_JOINTS])


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """Sizes of one person's link tree (topology: ``LINK_NAMES``, ``LINK_PARENTS``; L = 23 links, parents first).

    ``offsets`` (L, 3) float32 [m]: joint of link l in its parent's frame (root: zeros).
    ``tips`` (L, 3) float32 [m]: far end of the link's bone in its own frame; |tip| is the cylinder length L_l.
    ``radii`` (L,) float32 [m]: cylinder radius R_l.
    """

    offsets: NDArray[np.float32]
    tips: NDArray[np.float32]
    radii: NDArray[np.float32]

    def __post_init__(self) -> None:
        for name, shape in (("offsets", (LINK_COUNT, 3)), ("tips", (LINK_COUNT, 3)), ("radii", (LINK_COUNT,))):
            value = np.ascontiguousarray(getattr(self, name), np.float32)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"skeleton {name}: expected finite {shape}, got {value.shape}")
            object.__setattr__(self, name, value)
        if (self.radii <= 0).any():
            raise ValueError("skeleton radii must be positive")


# Fractions of stature (Drillis & Contini's segment tables, joint centres): (offset, tip, radius).
_CENTRAL = {
    "pelvis": ((0, 0, 0), (0, 0.055, 0), 0.085),
    "lower_spine": ((0, 0.055, 0), (0, 0.10, 0), 0.080),
    "upper_spine": ((0, 0.10, 0), (0, 0.145, -0.01), 0.088),
    "neck": ((0, 0.145, -0.01), (0, 0.045, 0.012), 0.035),
    "head": ((0, 0.045, 0.012), (0, 0.125, 0.01), 0.048),
}
_LEFT = {
    "clavicle": ((0.015, 0.125, -0.005), (0.088, -0.008, 0), 0.040),
    "upper_arm": ((0.088, -0.008, 0), (0.168, 0, 0), 0.028),
    "forearm": ((0.168, 0, 0), (0.146, 0, 0), 0.022),
    "hand": ((0.146, 0, 0), (0.052, 0, 0), 0.020),
    "fingers": ((0.052, 0, 0), (0.053, 0, 0), 0.016),
    "thigh": ((0.052, 0, 0), (0, -0.245, 0), 0.045),
    "shin": ((0, -0.245, 0), (0, -0.240, 0), 0.030),
    "foot": ((0, -0.240, 0), (0, -0.030, 0.085), 0.024),
    "toes": ((0, -0.030, 0.085), (0, 0, 0.040), 0.018),
}


def human_skeleton(stature_m: float) -> Skeleton:
    """Average adult proportions for a person of the given stature [m]: where fitting starts, never its result."""
    offsets, tips, radii = [], [], []
    for name in LINK_NAMES:
        side, _, part = name.partition("_")
        offset, tip, radius = _LEFT[part] if side in SIDES else _CENTRAL[name]
        mirror = np.array([-1.0 if side == "right" else 1.0, 1.0, 1.0])
        offsets.append(np.array(offset) * mirror)
        tips.append(np.array(tip) * mirror)
        radii.append(radius)
    return Skeleton(
        np.array(offsets, np.float32) * np.float32(stature_m),
        np.array(tips, np.float32) * np.float32(stature_m),
        np.array(radii, np.float32) * np.float32(stature_m),
    )
