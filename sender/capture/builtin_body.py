"""The built-in performer's body, modelled here from nothing: an adult of 1.79 m in T-shirt, trousers and trainers.

Tubes around the bones give the solid, its surface the mesh. Every point starts on the joint of its tube and the
weights are then smoothed over the mesh, so that they never leak through the air from one limb to another.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, diags

from sender.capture.builtin_texture import tiled_mesh
from sender.capture.implicit_surface import Solid, Tube, polygonise
from sender.capture.skinned_body import INFLUENCES, SkinnedBody

Floats = NDArray[np.float64]

BUILTIN = "builtin"
_SMOOTHINGS = 14  # rounds of averaging the skin weights with the neighbours'
_CELL_M, _TALL_CELL_M, _FINE_CELL_M = 0.016, 0.0205, 0.0115  # limbs are long: coarser along them than around
_HAND_LOW_M, _HAND_HIGH_M, _CHIN_M, _FACE_M = 0.88, 1.06, 1.53, 0.06  # where hands and face lie at rest

# Joints: name, parent, head, tail [m]; the left side stands for both.
_CENTRAL = (
    ("Hips", "", (0, 0.945, 0), (0, 1.02, -0.02)),
    ("LowerBack", "Hips", (0, 1.02, -0.02), (0, 1.13, -0.015)),
    ("Spine", "LowerBack", (0, 1.13, -0.015), (0, 1.24, -0.025)),
    ("Spine1", "Spine", (0, 1.24, -0.025), (0, 1.475, -0.03)),
    ("Neck", "Spine1", (0, 1.475, -0.03), (0, 1.565, -0.005)),
    ("Head", "Neck", (0, 1.565, -0.005), (0, 1.785, 0.01)),
)
_LEFT = (
    ("LeftUpLeg", "Hips", (0.086, 0.935, 0), (0.1, 0.49, 0.012)),
    ("LeftLeg", "LeftUpLeg", (0.1, 0.49, 0.012), (0.108, 0.093, -0.012)),
    ("LeftFoot", "LeftLeg", (0.108, 0.093, -0.012), (0.122, 0.035, 0.128)),
    ("LeftToeBase", "LeftFoot", (0.122, 0.035, 0.128), (0.13, 0.03, 0.205)),
    ("LeftShoulder", "Spine1", (0.025, 1.415, -0.01), (0.178, 1.4, -0.025)),
    ("LeftArm", "LeftShoulder", (0.178, 1.4, -0.025), (0.369, 1.209, -0.025)),
    ("LeftForeArm", "LeftArm", (0.369, 1.209, -0.025), (0.547, 1.031, 0.046)),
    ("LeftHand", "LeftForeArm", (0.547, 1.031, 0.046), (0.605, 0.973, 0.069)),
    ("LeftFingerBase", "LeftHand", (0.605, 0.973, 0.069), (0.673, 0.905, 0.096)),
    ("LThumb", "LeftHand", (0.562, 1.014, 0.072), (0.6, 0.985, 0.144)),
)


def _ball(share: float, radius: float, flat: float = 1.0) -> tuple[float, float, float, float]:
    return (share, radius, radius * flat, radius * flat)


_TORSO = (
    Tube(
        "torso",
        (0, 0.80, 0),
        (0, 1.51, -0.012),
        (
            (0.0, 0.05, 0.05, 0.05),
            (0.04, 0.125, 0.082, 0.100),
            (0.10, 0.158, 0.098, 0.122),
            (0.17, 0.168, 0.104, 0.124),
            (0.24, 0.163, 0.104, 0.110),
            (0.30, 0.154, 0.102, 0.098),
            (0.40, 0.146, 0.104, 0.092),
            (0.52, 0.152, 0.108, 0.100),
            (0.64, 0.166, 0.112, 0.112),
            (0.74, 0.172, 0.108, 0.118),
            (0.82, 0.158, 0.094, 0.112),
            (0.90, 0.110, 0.066, 0.092),
            (0.96, 0.068, 0.048, 0.070),
            (1.0, 0.04, 0.035, 0.045),
        ),
    ),
    Tube(
        "clavicle",
        (0.03, 1.435, -0.035),
        (0.185, 1.402, -0.025),
        (_ball(0, 0.045), _ball(0.3, 0.052), _ball(0.85, 0.056), _ball(1, 0.045)),
        blend_m=0.05,
    ),
)
_HEAD = (
    Tube("neck", (0, 1.42, -0.038), (0, 1.62, 0.0), (_ball(0, 0.064), _ball(0.5, 0.056), _ball(1, 0.054))),
    Tube(
        "head",
        (0, 1.545, 0.008),
        (0, 1.787, 0.008),
        (
            (0.0, 0.020, 0.070, 0.005),
            (0.04, 0.036, 0.084, 0.022),
            (0.11, 0.051, 0.091, 0.050),
            (0.20, 0.060, 0.0925, 0.072),
            (0.32, 0.067, 0.0925, 0.090),
            (0.46, 0.072, 0.0885, 0.098),
            (0.53, 0.074, 0.0905, 0.101),
            (0.60, 0.076, 0.0950, 0.103),
            (0.74, 0.075, 0.0900, 0.102),
            (0.86, 0.063, 0.0730, 0.086),
            (0.95, 0.040, 0.0450, 0.054),
            (1.0, 0.008, 0.010, 0.010),
        ),
        blend_m=0.03,
    ),
    Tube(
        "nose",
        (0, 1.675, 0.096),
        (0, 1.616, 0.106),
        ((0, 0.006, 0.004, 0.02), (0.5, 0.011, 0.012, 0.02), (0.82, 0.0175, 0.0185, 0.02), (1, 0.008, 0.006, 0.02)),
        blend_m=0.012,
    ),
    Tube(
        "lips", (0, 1.6, 0.096), (0, 1.574, 0.094), (_ball(0, 0.012, 0.5), _ball(0.5, 0.024, 0.4), _ball(1, 0.01, 0.5))
    ),
    Tube(
        "ear",
        (0.078, 1.692, -0.012),
        (0.072, 1.622, 0.002),
        ((0, 0.006, 0.008, 0.010), (0.4, 0.010, 0.016, 0.020), (1, 0.007, 0.008, 0.008)),
        blend_m=0.008,
    ),
    Tube(
        "hair",
        (0, 1.58, 0.0),
        (0, 1.803, 0.0),
        (
            (0.0, 0.050, 0.02, 0.088),
            (0.15, 0.070, 0.06, 0.104),
            (0.45, 0.084, 0.105, 0.117),
            (0.70, 0.086, 0.110, 0.117),
            (0.84, 0.074, 0.098, 0.099),
            (0.95, 0.046, 0.060, 0.060),
            (1.0, 0.010, 0.012, 0.010),
        ),
        blend_m=0.004,
        cut=((0.0, -0.735, 0.678), -1.2075),
    ),
)
_ARM = (
    Tube(
        "upper_arm",
        (0.150, 1.428, -0.025),
        (0.369, 1.209, -0.025),
        (
            _ball(0, 0.034),
            _ball(0.06, 0.052),
            _ball(0.2, 0.0625),
            _ball(0.4, 0.0595),
            _ball(0.655, 0.0585),
            _ball(0.70, 0.0455),
            _ball(0.85, 0.0420),
            _ball(1, 0.0405),
        ),
    ),
    Tube(
        "forearm",
        (0.355, 1.223, -0.0255),
        (0.547, 1.031, 0.046),
        (
            _ball(0, 0.040),
            _ball(0.25, 0.0435),
            _ball(0.55, 0.0375),
            (0.9, 0.0225, 0.028, 0.028),
            (1, 0.020, 0.027, 0.027),
        ),
        blend_m=0.03,
    ),
    Tube(
        "palm",
        (0.538, 1.040, 0.0424),
        (0.613, 0.965, 0.0722),
        ((0, 0.020, 0.026, 0.026), (0.4, 0.0185, 0.040, 0.037), (0.8, 0.0165, 0.043, 0.041), (1, 0.015, 0.042, 0.040)),
        blend_m=0.012,
    ),
    Tube(
        "fingers",
        (0.605, 0.973, 0.069),
        (0.675, 0.903, 0.0968),
        (
            (0, 0.0155, 0.042, 0.040),
            (0.5, 0.0135, 0.040, 0.038),
            (0.8, 0.0120, 0.034, 0.030),
            (0.95, 0.010, 0.022, 0.018),
            (1, 0.006, 0.01, 0.008),
        ),
        blend_m=0.006,
    ),
    Tube(
        "thumb",
        (0.556, 1.018, 0.066),
        (0.600, 0.985, 0.144),
        (_ball(0, 0.015), _ball(0.3, 0.0165), _ball(0.7, 0.0145), _ball(0.92, 0.0115), _ball(1, 0.005)),
        blend_m=0.014,
    ),
)
_LEG = (
    Tube(
        "thigh",
        (0.084, 0.985, -0.002),
        (0.1, 0.49, 0.012),
        (
            (0, 0.05, 0.06, 0.06),
            (0.1, 0.079, 0.085, 0.098),
            (0.25, 0.0855, 0.088, 0.104),
            (0.5, 0.079, 0.085, 0.088),
            (0.8, 0.063, 0.067, 0.064),
            (0.95, 0.056, 0.060, 0.055),
            (1, 0.050, 0.052, 0.048),
        ),
    ),
    Tube(
        "shin",
        (0.099, 0.505, 0.0115),
        (0.1084, 0.070, -0.0136),
        (
            (0, 0.050, 0.052, 0.048),
            (0.08, 0.0565, 0.056, 0.056),
            (0.3, 0.0575, 0.050, 0.073),
            (0.6, 0.0510, 0.047, 0.063),
            (0.92, 0.0500, 0.052, 0.060),
            (1, 0.0510, 0.054, 0.061),
        ),
        blend_m=0.03,
    ),
    Tube(
        "shoe",
        (0.102, 0.042, -0.078),
        (0.133, 0.042, 0.216),
        (
            (0, 0.010, 0.010, 0.03),
            (0.05, 0.028, 0.036, 0.05),
            (0.2, 0.0385, 0.056, 0.05),
            (0.4, 0.0385, 0.048, 0.05),
            (0.55, 0.0440, 0.034, 0.05),
            (0.72, 0.0485, 0.022, 0.05),
            (0.88, 0.0430, 0.016, 0.05),
            (0.97, 0.0230, 0.010, 0.05),
            (1, 0.008, 0.004, 0.04),
        ),
        front=(0, 1, 0),
        blend_m=0.006,
        cut=((0, -1, 0), 0.0),
    ),
)
_GROUPS = ((0.01, _TORSO), (0.025, _HEAD), (0.05, _ARM), (0.04, _LEG))
_TUBE_JOINT = {
    "clavicle": "LeftShoulder",
    "neck": "Neck",
    "head": "Head",
    "nose": "Head",
    "lips": "Head",
    "ear": "Head",
    "hair": "Head",
    "upper_arm": "LeftArm",
    "forearm": "LeftForeArm",
    "palm": "LeftHand",
    "fingers": "LeftFingerBase",
    "thumb": "LThumb",
    "thigh": "LeftUpLeg",
    "shin": "LeftLeg",
}


def builtin_body() -> SkinnedBody:
    """The built-in body at rest: A-pose, soles on y = 0, facing +Z."""
    solid = Solid(_GROUPS)
    points, quads = polygonise(solid, _grid())
    names, parents, heads, tails = _joints()
    joints, weights = _skin_weights(_rigid_joints(points, solid, names), quads, len(names))
    return SkinnedBody(
        name=BUILTIN,
        mesh=tiled_mesh(points, quads, solid.owner(points[quads].mean(axis=1))),
        joint_names=names,
        parents=parents,
        heads=heads,
        tails=tails,
        points=np.ascontiguousarray(points, np.float32),
        point_of_vertex=quads.reshape(-1),
        skin_joints=joints,
        skin_weights=weights,
    )


def _grid() -> tuple[Floats, Floats, Floats]:
    """Planes of the grid the surface is found on: finer over face and hands."""
    arm = np.concatenate([np.arange(0, 0.52, _CELL_M), np.arange(0.52, 0.71, _FINE_CELL_M)])
    height = np.concatenate(
        [
            np.arange(-0.02, _HAND_LOW_M, _TALL_CELL_M),
            np.arange(_HAND_LOW_M, _HAND_HIGH_M, _FINE_CELL_M),
            np.arange(_HAND_HIGH_M, _CHIN_M, _TALL_CELL_M),
            np.arange(_CHIN_M, 1.83, _FINE_CELL_M),
        ]
    )
    depth = np.concatenate([np.arange(-0.17, _FACE_M, _CELL_M), np.arange(_FACE_M, 0.26, _FINE_CELL_M)])
    side = np.concatenate([-arm[:0:-1], arm])
    return side, height, depth


def _joints() -> tuple[tuple[str, ...], NDArray[np.int32], Floats, Floats]:
    rows = [*_CENTRAL, *_LEFT, *(_mirrored(row) for row in _LEFT)]
    names = tuple(row[0] for row in rows)
    parents = np.array([names.index(row[1]) if row[1] else -1 for row in rows], np.int32)
    return names, parents, np.array([row[2] for row in rows], float), np.array([row[3] for row in rows], float)


_Row = tuple[str, str, tuple[float, float, float], tuple[float, float, float]]


def _mirrored(row: _Row) -> _Row:
    name, parent, head, tail = row
    return _right(name), _right(parent), (-head[0], *head[1:]), (-tail[0], *tail[1:])


def _right(name: str) -> str:
    return "RThumb" if name == "LThumb" else name.replace("Left", "Right")


def _rigid_joints(points: Floats, solid: Solid, names: tuple[str, ...]) -> NDArray[np.int64]:
    """Joint (P,) that would move each point (P, 3) if the body were made of rigid pieces."""
    spine = np.array([head[1] for name, _, head, _ in _CENTRAL if name != "Head"])
    joint = np.clip(np.searchsorted(spine, points[:, 1]) - 1, 0, 3)  # the torso, by height
    owner = solid.owner(points)
    left = points[:, 0] >= 0
    for tube, name in _TUBE_JOINT.items():
        joint[owner == tube] = names.index(name)
    joint[owner == "shoe"] = names.index("LeftFoot")
    joint[(owner == "shoe") & (points[:, 2] > 0.12)] = names.index("LeftToeBase")
    mirror = np.array([names.index(_right(name)) for name in names])
    return np.where(left, joint, mirror[joint])


def _skin_weights(
    rigid: NDArray[np.int64], quads: NDArray[np.int32], joint_count: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Joints (P, 4) and weights (P, 4) of the points: the rigid pieces' borders smoothed along the mesh."""
    count = len(rigid)
    a, b = quads.reshape(-1), np.roll(quads, -1, axis=1).reshape(-1)
    edges = coo_matrix((np.ones(2 * len(a)), (np.concatenate([a, b]), np.concatenate([b, a]))), (count, count)).tocsr()
    edges.data[:] = 1
    average = diags(1 / np.maximum(np.asarray(edges.sum(axis=1)).ravel(), 1)) @ edges
    weights = np.zeros((count, joint_count))
    weights[np.arange(count), rigid] = 1
    for _ in range(_SMOOTHINGS):
        weights = 0.4 * weights + 0.6 * (average @ weights)
    joints = np.argsort(-weights, axis=1)[:, :INFLUENCES]
    strongest = np.take_along_axis(weights, joints, axis=1)
    strongest /= strongest.sum(axis=1, keepdims=True)
    return joints.astype(np.uint8), strongest.astype(np.float32)
