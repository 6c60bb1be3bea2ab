"""The built-in performer's routine: 30 seconds of an exercise class, keyed in joint angles.

Angles are in degrees from a T-pose with straight legs. Between keys every angle follows a monotone cubic (C1, no
overshoot), so nothing starts or stops with a jerk.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from common.geometry import quaternion
from sender.capture.mocap import ROOT, MotionClip

Floats = NDArray[np.float64]
Pose = Mapping[str, float]

ROUTINE_S = 30.0
_RATE_HZ = 60.0
_TURN_START_S, _TURN_STEPS, _TURN_STEP_S = 15.0, 8, 0.6
_TURN_END_S = _TURN_START_S + _TURN_STEPS * _TURN_STEP_S

# Arms: ``lower`` from horizontal, ``swing`` forwards about the shoulder axis, ``across`` horizontally to the front,
# ``roll`` about the arm (turns the elbow's plane inwards), ``elbow``. Legs: ``flex``, ``out``, ``knee``; ``flat`` 1
# keeps the sole on the floor whatever the leg does. ``left_weight``: share of the weight on the left foot.
_LIMB: Pose = {"lower": 77, "swing": 3, "across": 0, "roll": 0, "elbow": 14, "flex": 0, "out": 3, "knee": 0, "flat": 1}
_STAND: dict[str, float] = {
    **dict.fromkeys(("yaw", "lean", "bend", "side", "twist", "nod", "look"), 0.0),
    "left_weight": 0.5,
    **{f"{side}_{name}": angle for side in ("left", "right") for name, angle in _LIMB.items()},
}


def _both(**angles: float) -> Pose:
    return {f"{side}_{name}": angle for side in ("left", "right") for name, angle in angles.items()}


def _right(**angles: float) -> Pose:
    return {f"right_{name}": angle for name, angle in angles.items()}


def _left(**angles: float) -> Pose:
    return {f"left_{name}": angle for name, angle in angles.items()}


_WAVE = {**_right(lower=-15, across=25, roll=-85, elbow=75), "look": -8}
FOLDED = {
    **_left(lower=74, swing=36, roll=78, elbow=104),
    **_right(lower=74, swing=25, roll=72, elbow=106),
}
SQUAT = {**_both(flex=95, knee=100, swing=80, lower=82, elbow=5, out=6), "lean": 28, "bend": 12, "nod": -25}
_STEPPING = {"flex": 32.0, "knee": 55.0, "flat": 0.4}  # a leg in the air
_KICKER = {"left_out": -3.0, "left_weight": 1.0, "right_flat": 0.1}
_SIDE_LEFT = {**_both(out=14), "left_weight": 0.5}
_FORWARD = {**_left(flex=20, knee=4, swing=-12), **_right(flex=-16, knee=8, flat=0.7, swing=16), "left_weight": 0.5}


def _turn() -> list[tuple[float, Pose]]:
    """A full turn to the left on the spot, one foot after the other."""
    keys: list[tuple[float, Pose]] = []
    angle = 360 / _TURN_STEPS
    for step in range(_TURN_STEPS):
        lifted = _left(**_STEPPING) if step % 2 == 0 else _right(**_STEPPING)
        middle_s, on_left = _TURN_START_S + (step + 0.5) * _TURN_STEP_S, float(step % 2)
        keys.append((middle_s, {**lifted, "yaw": angle * (step + 0.5), "left_weight": on_left}))
        keys.append((middle_s + _TURN_STEP_S / 2, {"yaw": angle * (step + 1), "left_weight": 0.5}))
    return keys


def _keys() -> list[tuple[float, Pose]]:
    """(time [s], what differs from standing), in order; it begins and ends standing."""
    waving = [(3.0 + 0.3 * k, {**_WAVE, "right_elbow": 50 + 45 * (k % 2)}) for k in range(6)]
    return [
        (0.0, {}),
        (2.0, {}),
        *waving,
        (5.4, {}),
        (6.4, _both(lower=0, swing=0, elbow=0)),
        (7.4, _both(lower=0, swing=0, elbow=0)),
        (8.6, {}),
        (9.6, FOLDED),
        (10.9, FOLDED),
        (11.9, {}),
        (13.1, SQUAT),
        (13.5, SQUAT),
        (14.7, {}),
        *_turn(),
        (20.2, {**_left(**_STEPPING), "left_out": 16, "left_weight": 0}),
        (20.6, _SIDE_LEFT),
        (21.0, {**_right(**_STEPPING), "right_out": 8, "left_weight": 1}),
        (21.4, {}),
        (21.8, {**_right(**_STEPPING), "right_out": 16, "left_weight": 0.95}),
        (22.2, _SIDE_LEFT),
        (22.6, {**_left(**_STEPPING), "left_out": 8, "left_weight": 0}),
        (23.0, {}),
        (23.4, {**_left(**_STEPPING), "left_weight": 0, "right_flex": -6}),
        (23.8, _FORWARD),
        (24.2, {**_right(**_STEPPING), "left_weight": 1}),
        (24.6, {}),
        (25.0, {**_right(**_STEPPING), "left_weight": 1, "left_flex": 8}),
        (25.4, _FORWARD),
        (25.8, {**_left(**_STEPPING), "left_weight": 0}),
        (26.2, {}),
        (26.8, {**_right(flex=-14, knee=65, swing=22), **_KICKER, "left_swing": -12}),
        (27.2, {**_right(flex=26, knee=72), **_KICKER}),
        (27.55, {**_right(flex=66, knee=10, swing=-22), **_KICKER, "left_swing": 30, "lean": -8}),
        (28.2, {**_right(flex=30, knee=62), **_KICKER}),
        (28.9, {}),
        (ROUTINE_S, {}),
    ]


def routine() -> MotionClip:
    """The routine as a clip."""
    turned = {"yaw": 360.0}  # after the turn: not back again
    return keyed_clip([(time, (turned if time > _TURN_END_S else {}) | dict(pose)) for time, pose in _keys()])


def keyed_clip(keys: Sequence[tuple[float, Pose]]) -> MotionClip:
    """A clip through ``keys``, each a time [s] and what differs from standing there, in order; it must begin and end
    standing: it is cyclic, at 60 frames/s, with the weight on each foot instead of a path."""
    times = np.arange(round(keys[-1][0] * _RATE_HZ) + 1) / _RATE_HZ
    angles = _angles(times, keys)
    bones = _rotations(angles)
    names = tuple(bones)
    weight = np.clip(angles["left_weight"], 0, 1)
    return MotionClip(
        bones=names,
        directions=np.array([_direction(name) for name in names]),
        lengths_m=np.ones(len(names)),
        frame_rate_hz=_RATE_HZ,
        rotations=quaternion.to_matrix(np.stack(list(bones.values()), axis=1)),
        tails=np.zeros((len(times), len(names), 3)),
        support=np.stack([weight, 1 - weight], axis=1),
    )


def _angles(times: Floats, keys: Sequence[tuple[float, Pose]]) -> dict[str, Floats]:
    """Every angle (F,) [degrees] at times (F,) [s]; breathing and a small sway on top of the keys."""
    at = [time for time, _ in keys]
    poses = [_STAND | dict(pose) for _, pose in keys]
    angles = {name: PchipInterpolator(at, [pose[name] for pose in poses])(times) for name in _STAND}
    phase = 2 * np.pi * times / ROUTINE_S  # of the routine; a clip of another length sways as slowly
    angles["bend"] += 0.8 * np.sin(8 * phase)  # a breath every 3.75 s
    angles["side"] += 1.2 * np.sin(5 * phase)
    angles["look"] += 5.0 * np.sin(3 * phase)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        angles[f"{side}_lower"] += 0.8 * np.sin(8 * phase)
        angles[f"{side}_swing"] += 2.0 * sign * np.sin(5 * phase)
    return angles


def _about(axis: str, degrees: Floats) -> Floats:
    """Rotations (F, 4) about "x", "y" or "z"."""
    vector = np.zeros((len(degrees), 3))
    vector[:, "xyz".index(axis)] = np.deg2rad(degrees)
    return quaternion.from_rotation_vector(vector)


def _chain(*rotations: Floats) -> Floats:
    product = rotations[0]
    for rotation in rotations[1:]:
        product = quaternion.multiply(product, rotation)
    return product


def _rotations(a: Mapping[str, Floats]) -> dict[str, Floats]:
    """World rotations (F, 4) of the bones of a motion clip, the root first."""
    bones = {ROOT: _chain(_about("y", a["yaw"]), _about("x", a["lean"]))}
    vertebra = _chain(_about("y", a["twist"] / 3), _about("x", a["bend"] / 3), _about("z", -a["side"] / 3))
    parent = ROOT
    for name in ("lowerback", "upperback", "thorax"):
        bones[name], parent = _chain(bones[parent], vertebra), name
    nod = _chain(_about("y", a["look"] / 3), _about("x", a["nod"] / 3))
    for name in ("lowerneck", "upperneck", "head"):
        bones[name], parent = _chain(bones[parent], nod), name
    for side, mirror in (("left", (1, 1, 1, 1)), ("right", (1, 1, -1, -1))):  # reflection in the plane x = 0
        limb = {name.removeprefix(side + "_"): angle for name, angle in a.items() if name.startswith(side + "_")}
        bones |= _limbs(side[0], np.array(mirror, float), limb, bones)
    return bones


def _limbs(c: str, mirror: Floats, a: Mapping[str, Floats], trunk: Mapping[str, Floats]) -> dict[str, Floats]:
    shrug = _about("z", np.clip(20 - a["lower"], 0, 60) / 6) * mirror
    arm = _chain(_about("y", -a["across"]), _about("x", -a["swing"]), _about("z", -a["lower"]), _about("x", a["roll"]))
    forearm = _about("y", -a["elbow"]) * mirror
    thigh = _chain(_about("x", -a["flex"]), _about("z", a["out"])) * mirror
    bones = {c + "hipjoint": trunk[ROOT], c + "femur": _chain(trunk[ROOT], thigh)}
    bones[c + "tibia"] = _chain(bones[c + "femur"], _about("x", a["knee"]))
    forward = quaternion.to_matrix(trunk[ROOT])[:, :, 2]
    on_floor = _about("y", np.rad2deg(np.arctan2(forward[:, 0], forward[:, 2])))
    bones[c + "foot"] = bones[c + "toes"] = quaternion.slerp(bones[c + "tibia"], on_floor, a["flat"])
    bones[c + "clavicle"] = _chain(trunk["thorax"], shrug)
    bones[c + "humerus"] = _chain(trunk["thorax"], arm * mirror)
    bones[c + "radius"] = _chain(bones[c + "humerus"], forearm)
    return bones | {c + name: bones[c + "radius"] for name in ("wrist", "hand", "fingers", "thumb")}


def _direction(bone: str) -> tuple[float, float, float]:
    """Where a limb's bone points in the T-pose."""
    if bone[1:] in ("femur", "tibia"):
        return (0.0, -1.0, 0.0)
    return (1.0 if bone[0] == "l" else -1.0, 0.0, 0.0)
