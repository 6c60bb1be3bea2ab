"""An average human as round cones on the link tree, with a few sizes and joint angles to fit.

A first pose is found by fitting this template to a cloud (``template_fit``). Every cone hangs on a link of
``human_skeleton`` (Lien 2009 §5.1.1 uses one cylinder per link; a trunk needs two side by side, a head and a foot
too). All numbers are fractions of stature from anthropometric tables (Drillis & Contini 1966; NASA-STD-3000 breadths
and depths, light clothing included). A size scales a group of them and is the same on both sides.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_NAMES, LINK_PARENTS, SIDES, Skeleton, human_skeleton
from common.body.skeleton_pose import SkeletonPose
from common.geometry import quaternion

Point = tuple[float, float, float]
Cone = tuple[Point, float, Point, float]

# (name, start, σ of the prior): factors of the tables, except stature [m].
SIZES = (
    ("stature", 1.70, 0.15),
    ("trunk_length", 1.0, 0.03),
    ("trunk_breadth", 1.0, 0.12),
    ("trunk_radius", 1.0, 0.12),
    ("neck", 1.0, 0.06),
    ("head", 1.0, 0.06),
    ("shoulder_width", 1.0, 0.06),
    ("upper_arm", 1.0, 0.06),
    ("forearm", 1.0, 0.06),
    ("hand", 1.0, 0.06),
    ("arm_radius", 1.0, 0.15),
    ("hip_width", 1.0, 0.06),
    ("thigh", 1.0, 0.03),
    ("shin", 1.0, 0.03),
    ("leg_radius", 1.0, 0.15),
    ("foot", 1.0, 0.06),
)
SIZE_INDEX = {name: index for index, (name, _, _) in enumerate(SIZES)}
ROOT = len(SIZES)  # θ = sizes, root position (3), joint angles (rotation vector components)

# Which size stretches a link's offset and cones along x, y, z ("" = stature alone).
_STRETCH = {
    "pelvis": ("trunk_breadth", "trunk_length", "trunk_radius"),
    "lower_spine": ("trunk_breadth", "trunk_length", "trunk_radius"),
    "upper_spine": ("trunk_breadth", "trunk_length", "trunk_radius"),
    "neck": ("neck", "neck", "neck"),
    "head": ("head", "head", "head"),
    "clavicle": ("shoulder_width", "", ""),
    "upper_arm": ("upper_arm", "arm_radius", "arm_radius"),
    "forearm": ("forearm", "arm_radius", "arm_radius"),
    "hand": ("hand", "hand", "hand"),
    "fingers": ("hand", "hand", "hand"),
    "thigh": ("leg_radius", "thigh", "leg_radius"),
    "shin": ("leg_radius", "shin", "leg_radius"),
    "foot": ("foot", "", "foot"),
    "toes": ("foot", "foot", "foot"),
}
_OFFSET_STRETCH = {"thigh": ("hip_width", "", ""), "clavicle": ("shoulder_width", "trunk_length", "")}
_RADIUS_SIZE = {
    "pelvis": "trunk_radius",
    "lower_spine": "trunk_radius",
    "upper_spine": "trunk_radius",
    "neck": "neck",
    "head": "head",
    "clavicle": "arm_radius",
    "upper_arm": "arm_radius",
    "forearm": "arm_radius",
    "hand": "hand",
    "fingers": "hand",
    "thigh": "leg_radius",
    "shin": "leg_radius",
    "foot": "foot",
    "toes": "foot",
}
# Joints that ``human_skeleton`` places only schematically. Heights over stature: xiphoid 0.74, cervicale 0.845, atlas
# 0.91, ankle in a shoe 0.05; upper arm of de Leva 1996.
_JOINTS = {
    "lower_spine": (0.0, 0.055, -0.010),
    "upper_spine": (0.0, 0.155, -0.010),
    "neck": (0.0, 0.105, 0.012),
    "head": (0.0, 0.065, 0.020),
    "left_clavicle": (0.015, 0.070, 0.018),
    "left_forearm": (0.162, 0.0, 0.0),
    "left_thigh": (0.060, 0.0, 0.0),
    "left_foot": (0.0, -0.235, 0.0),
}
_CROWN = (0.0, 0.090, -0.008)  # in the head's frame
_TRUNK_CONES: dict[str, tuple[Cone, ...]] = {
    "pelvis": (((0.034, -0.025, 0.006), 0.063, (0.030, 0.055, 0.006), 0.058),),
    "lower_spine": (((0.030, 0.0, 0.016), 0.058, (0.030, 0.155, 0.022), 0.061),),
    "upper_spine": (((0.030, 0.0, 0.032), 0.061, (0.034, 0.035, 0.024), 0.060),),
}
_CENTRAL_CONES: dict[str, tuple[Cone, ...]] = {
    "neck": (((0.0, -0.010, 0.0), 0.038, (0.0, 0.040, 0.012), 0.034),),
    "head": (
        ((0.0, 0.000, 0.014), 0.036, (0.0, 0.043, 0.004), 0.047),
        ((0.0, 0.015, -0.014), 0.042, (0.0, 0.043, -0.020), 0.047),
    ),
}
_LEFT_CONES: dict[str, tuple[Cone, ...]] = {
    "clavicle": (((0.0, -0.010, 0.0), 0.045, (0.082, -0.004, 0.0), 0.036),),
    "upper_arm": (((0.0, 0.0, 0.0), 0.035, (0.162, 0.0, 0.0), 0.026),),
    "forearm": (((0.0, 0.0, 0.0), 0.027, (0.146, 0.0, 0.0), 0.018),),
    "hand": (((0.0, 0.0, 0.0), 0.018, (0.052, 0.0, 0.0), 0.021),),
    "fingers": (((0.0, 0.0, 0.0), 0.020, (0.042, 0.0, 0.0), 0.012),),
    "thigh": (((-0.006, 0.0, 0.0), 0.055, (0.0, -0.245, 0.004), 0.036),),
    "shin": (
        ((0.0, 0.0, 0.004), 0.036, (0.0, -0.08, -0.008), 0.035),
        ((0.0, -0.08, -0.008), 0.035, (0.0, -0.235, 0.0), 0.026),
    ),
    "foot": (((0.0, -0.020, -0.022), 0.030, (0.004, -0.028, 0.078), 0.025),),
    "toes": (((-0.004, 0.002, 0.0), 0.021, (0.004, -0.002, 0.034), 0.018),),
}
# Free joint angles of the start pose: (link, axes, σ [rad]); the rest of the tree stays straight.
_SPINE_JOINTS = (("lower_spine", "xyz", 0.10), ("neck", "xz", 0.25))
_LEFT_JOINTS = (
    ("clavicle", "yz", 0.12),
    ("upper_arm", "xyz", 0.6),
    ("forearm", "y", 0.5),
    ("thigh", "xz", 0.3),
    ("thigh", "y", 0.15),
    ("shin", "x", 0.3),
    ("foot", "x", 0.2),
)


class Template(NamedTuple):
    """The tables as arrays for the kernels (L links, K cones, D joint angles, S sizes; P = S + 3 + D parameters).

    ``offsets`` (L, 3) and ``offset_sizes`` (L, 3) int: joint in the parent's frame and the size that stretches it
    (-1: none). ``ends`` (K, 2, 3), ``end_sizes`` (K, 3), ``radii`` (K, 2), ``radius_sizes``, ``cone_links`` (K,).
    ``angle_links``, ``angle_axes`` (D,): which component of which link's rotation vector each angle is.
    ``prior``, ``sigma`` (P,): start and spread of every parameter. ``tip_cones``: cones that end the body (crown,
    fingers, toes), ``sole_cones``: those that stand on the floor, ``leg_cones`` (K,): thigh to toes.
    ``lower_bounded``, ``upper_bounded``: angles in θ that do not turn below or above 0 (knees and elbows).
    """

    parents: NDArray[np.int64]
    offsets: NDArray[np.float64]
    offset_sizes: NDArray[np.int64]
    ends: NDArray[np.float64]
    end_sizes: NDArray[np.int64]
    radii: NDArray[np.float64]
    radius_sizes: NDArray[np.int64]
    cone_links: NDArray[np.int64]
    angle_links: NDArray[np.int64]
    angle_axes: NDArray[np.int64]
    prior: NDArray[np.float64]
    sigma: NDArray[np.float64]
    tip_cones: NDArray[np.int64]
    sole_cones: NDArray[np.int64]
    leg_cones: NDArray[np.bool_]
    lower_bounded: NDArray[np.int64]
    upper_bounded: NDArray[np.int64]


def _sizes_of(names: tuple[str, str, str]) -> list[int]:
    return [SIZE_INDEX[name] if name else -1 for name in names]


def _mirrored(cone: Cone) -> Cone:
    (ax, ay, az), ra, (bx, by, bz), rb = cone
    return (-ax, ay, az), ra, (-bx, by, bz), rb


def _cones() -> list[tuple[str, str, Cone]]:
    """All cones as (link, part it is listed under, cone)."""
    cones = [(part, part, twin) for part in _TRUNK_CONES for c in _TRUNK_CONES[part] for twin in (c, _mirrored(c))]
    cones += [(part, part, cone) for part in _CENTRAL_CONES for cone in _CENTRAL_CONES[part]]
    for side in SIDES:
        for part, entries in _LEFT_CONES.items():
            cones += [(f"{side}_{part}", part, c if side == "left" else _mirrored(c)) for c in entries]
    return cones


def human_template() -> Template:
    """The average human: ``human_skeleton``'s joints, the cones above, priors of sizes and angles."""
    offsets = human_skeleton(1.0).offsets.astype(np.float64)
    for name, (x, y, z) in _JOINTS.items():
        offsets[LINK_INDEX[name]] = x, y, z
        if name.startswith("left_"):
            offsets[LINK_INDEX[name.replace("left", "right")]] = -x, y, z
    parts = [name.partition("_")[2] if name.partition("_")[0] in SIDES else name for name in LINK_NAMES]
    offset_sizes = []
    for link, part in enumerate(parts):
        parent = parts[LINK_PARENTS[link]] if link else ""
        offset_sizes.append(_sizes_of(_OFFSET_STRETCH.get(part) or _STRETCH.get(parent, ("", "", ""))))
    cones = _cones()
    joints = [(link, axes, sigma) for link, axes, sigma in _SPINE_JOINTS]
    joints += [(f"{side}_{link}", axes, sigma) for side in SIDES for link, axes, sigma in _LEFT_JOINTS]
    angles = [(LINK_INDEX[link], "xyz".index(axis), sigma) for link, axes, sigma in joints for axis in axes]
    root = [(0, axis, 0.3 if axis == 1 else 0.12) for axis in range(3)]
    angles = root + angles
    cone_names = [link for link, _, _ in cones]

    def hinge(link: str, axis: str) -> int:
        return ROOT + 3 + [(LINK_NAMES[a], "xyz"[b]) for a, b, _ in angles].index((link, axis))

    return Template(
        parents=np.array(LINK_PARENTS),
        offsets=offsets,
        offset_sizes=np.array(offset_sizes),
        ends=np.array([[a, b] for _, _, (a, _, b, _) in cones]),
        end_sizes=np.array([_sizes_of(_STRETCH[part]) for _, part, _ in cones]),
        radii=np.array([[ra, rb] for _, _, (_, ra, _, rb) in cones]),
        radius_sizes=np.array([SIZE_INDEX[_RADIUS_SIZE[part]] for _, part, _ in cones]),
        cone_links=np.array([LINK_INDEX[link] for link, _, _ in cones]),
        angle_links=np.array([link for link, _, _ in angles]),
        angle_axes=np.array([axis for _, axis, _ in angles]),
        prior=np.array([start for _, start, _ in SIZES] + [0.0] * (3 + len(angles))),
        sigma=np.array([sigma for _, _, sigma in SIZES] + [0.3] * 3 + [sigma for _, _, sigma in angles]),
        tip_cones=np.array([k for k, name in enumerate(cone_names) if name.endswith(("head", "fingers", "toes"))]),
        sole_cones=np.array([k for k, name in enumerate(cone_names) if name.endswith(("foot", "toes"))]),
        leg_cones=np.array([name.endswith(("thigh", "shin", "foot", "toes")) for name in cone_names]),
        lower_bounded=np.array([hinge("right_forearm", "y"), hinge("left_shin", "x"), hinge("right_shin", "x")]),
        upper_bounded=np.array([hinge("left_forearm", "y")]),
    )


def angle_index(template: Template, link: str, axis: str) -> int:
    """Index in θ of the joint angle of ``link`` about its ``axis`` ("x", "y" or "z").

    Raises:
        ValueError: that angle is not free in the template.
    """
    match = (template.angle_links == LINK_INDEX[link]) & (template.angle_axes == "xyz".index(axis))
    if not match.any():
        raise ValueError(f"the template's {link} does not turn about {axis}")
    return ROOT + 3 + int(np.argmax(match))


def template_skeleton(template: Template, theta: NDArray[np.float64]) -> Skeleton:
    """The link tree with the sizes in θ (P,): offsets, tips and radii in metres."""
    factors = np.append(theta[:ROOT], 1.0)  # index -1: no size of its own
    offsets = template.offsets * factors[template.offset_sizes] * theta[0]
    offsets[0] = 0.0
    base = human_skeleton(float(theta[0]))
    tips, radii = base.tips.astype(np.float64), base.radii.astype(np.float64)
    tips[LINK_INDEX["head"]] = np.array(_CROWN) * theta[0]
    for link in range(LINK_COUNT):
        cone = int(np.argmax(template.cone_links == link))
        tips[link] *= factors[template.end_sizes[cone]]
        radii[link] *= factors[template.radius_sizes[cone]]
    for link in range(1, LINK_COUNT):  # a bone ends where the next one starts; pelvis and upper spine on the axis
        if LINK_NAMES[link].partition("_")[2] not in ("clavicle", "thigh"):
            tips[LINK_PARENTS[link]] = offsets[link]
    return Skeleton(offsets.astype(np.float32), tips.astype(np.float32), radii.astype(np.float32))


def template_pose(
    template: Template, theta: NDArray[np.float64], heading: float, confidence: NDArray[np.float32]
) -> SkeletonPose:
    """The pose in θ (P,) with per-link ``confidence`` (L,)."""
    vectors = np.zeros((LINK_COUNT, 3))
    vectors[template.angle_links, template.angle_axes] = theta[ROOT + 3 :]
    rotations = quaternion.from_rotation_vector(vectors)
    turn = quaternion.from_rotation_vector(np.array([0.0, heading, 0.0]))
    rotations[0] = quaternion.multiply(turn, rotations[0])
    return SkeletonPose(theta[ROOT : ROOT + 3].astype(np.float32), rotations.astype(np.float32), confidence)
