"""Motion capture clips in the CMU database's format: a skeleton (ASF) and joint angles over time (AMC).

Kinematics of the format: ``C`` is the rotation of a bone's axes, ``E(x, y, z) = Rz(z) Ry(y) Rx(x)`` the rotation of
its angles; then ``R_bone = R_parent C E C^T`` and ``tail = tail_parent + R_bone · direction · length``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sender.capture.frame_set import CaptureError

Floats = NDArray[np.float64]

METRES_PER_UNIT = 2.54 / 100 / 0.45  # the files are in inches, scaled by the header's "length 0.45"
ROOT = "root"
_HEAD_PITCH_RAD = np.deg2rad(15.0)  # the database's head bones look some 15° down when people look ahead
_ROOT_ANGLES = 6  # TX TY TZ RX RY RZ


class MocapError(CaptureError):
    """A motion capture file is missing or malformed; the message names the file, the line and what was expected."""


@dataclass(frozen=True, slots=True, eq=False)
class MocapBone:
    """One bone at rest: unit ``direction`` (3,), ``length_m``, axes ``C`` (3, 3), its angles in the file's order."""

    direction: Floats
    length_m: float
    axes: Floats
    angles: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class MotionClip:
    """A skeleton in motion: F frames of B bones (``root`` first, parents before children).

    ``rotations`` (F, B, 3, 3): world rotation of every bone from its zero pose (T-pose, legs 20° outwards).
    ``tails`` (F, B, 3) [m, world, y up]: where every bone ends; the root's own position for ``root``.
    ``directions`` (B, 3): unit bone directions in the zero pose, zeros for the root. ``lengths_m`` (B,).
    ``head_pitch_rad``: how far the head bone pitches down while the person looks straight ahead.
    ``support`` (F, 2) or None: share of the weight on the left and the right foot, 0..1. Where given, the root's
    horizontal path follows from the feet that stand; else it is taken from ``tails``.
    """

    bones: tuple[str, ...]
    directions: Floats
    lengths_m: Floats
    frame_rate_hz: float
    rotations: Floats
    tails: Floats
    head_pitch_rad: float = 0.0
    support: Floats | None = None

    def bone(self, name: str) -> int:
        """Index of a bone along the B axes. Raises MocapError when the skeleton has no such bone."""
        if name not in self.bones:
            raise MocapError(f"the clip's skeleton has no bone {name!r}")
        return self.bones.index(name)


@dataclass(slots=True)
class _Skeleton:
    bones: dict[str, MocapBone] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)


def clip_names(folder: Path) -> tuple[str, ...]:
    """Motions listed in ``folder/clips.json``, sorted. Raises MocapError when the list cannot be read."""
    return tuple(sorted(_clip_table(folder)))


def read_clip(folder: Path, name: str) -> MotionClip:
    """The clip ``name`` of ``folder`` (its ``clips.json`` says which files make it up and their frame rate).

    Raises:
        MocapError: unknown clip (the message lists those there are), a missing file, or a malformed one.
    """
    table = _clip_table(folder)
    if name not in table:
        raise MocapError(f"no motion {name!r} in {folder}; there are: {', '.join(sorted(table))}")
    entry = table[name]
    try:
        skeleton_file, angle_file, rate = folder / entry["asf"], folder / entry["amc"], float(entry["fps"])
    except (KeyError, TypeError, ValueError) as error:
        raise MocapError(f"{folder / 'clips.json'}: motion {name!r} needs asf, amc and fps ({error!r})") from error
    skeleton = _read_skeleton(skeleton_file)
    order = _parents_first(skeleton, skeleton_file)
    return _forward_kinematics(skeleton, order, _read_angles(angle_file, skeleton), rate)


def _clip_table(folder: Path) -> dict[str, dict[str, str]]:
    try:
        table = json.loads((folder / "clips.json").read_text())
    except (OSError, ValueError) as error:
        raise MocapError(f"cannot read the list of motions {folder / 'clips.json'}: {error}") from error
    if not isinstance(table, dict):
        raise MocapError(f"{folder / 'clips.json'}: expected an object of motions by name")
    return table


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise MocapError(f"cannot read {path}: {error}") from error
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if words:
            yield number, words


def _numbers(words: list[str], count: int, where: str) -> Floats:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise MocapError(f"{where}: {error}") from error
    if len(values) != count or not np.isfinite(values).all():
        raise MocapError(f"{where}: expected {count} finite numbers, got {' '.join(words)!r}")
    return values


def _read_skeleton(path: Path) -> _Skeleton:
    """ASF: only ``:bonedata`` and ``:hierarchy`` matter here (units and axis order are the same in every file)."""
    skeleton, section, entry = _Skeleton(), "", dict[str, list[str]]()
    for number, words in _lines(path):
        if words[0].startswith(":"):
            section = words[0]
        elif section == ":bonedata" and words[0] == "begin":
            entry = {}
        elif section == ":bonedata" and words[0] == "end":
            name, bone = _bone(entry, f"{path}:{number}")
            skeleton.bones[name] = bone
        elif section == ":bonedata":
            entry[words[0]] = words[1:]
        elif section == ":hierarchy" and words[0] not in ("begin", "end"):
            skeleton.parents |= dict.fromkeys(words[1:], words[0])
    return skeleton


def _bone(entry: dict[str, list[str]], where: str) -> tuple[str, MocapBone]:
    missing = {"name", "direction", "length", "axis"} - entry.keys()
    if missing or not entry["name"]:
        raise MocapError(f"{where}: bone without {', '.join(sorted(missing)) or 'a name'}")
    angles = tuple(angle.removeprefix("r") for angle in entry.get("dof", []))
    if not set(angles) <= set("xyz"):
        raise MocapError(f"{where}: bone {entry['name'][0]} has angles {angles}, expected rx, ry, rz")
    direction = _numbers(entry["direction"], 3, where)
    length = float(_numbers(entry["length"], 1, where)[0]) * METRES_PER_UNIT
    if np.linalg.norm(direction) < 1e-6:
        raise MocapError(f"{where}: bone {entry['name'][0]} has no direction")
    axes = _euler(_numbers(entry["axis"][:3], 3, where))
    return entry["name"][0], MocapBone(direction / np.linalg.norm(direction), length, axes, angles)


def _parents_first(skeleton: _Skeleton, path: Path) -> list[str]:
    order, waiting = [ROOT], list(skeleton.bones)
    while waiting:
        ready = [bone for bone in waiting if skeleton.parents.get(bone) in order]
        if not ready:
            raise MocapError(f"{path}: the hierarchy does not connect {', '.join(waiting)} to the root")
        order += ready
        waiting = [bone for bone in waiting if bone not in ready]
    return order


def _read_angles(path: Path, skeleton: _Skeleton) -> dict[str, Floats]:
    """AMC: angles [deg] (F, number of angles) of every bone that moves; the root's six numbers as in the file."""
    counts = {ROOT: _ROOT_ANGLES} | {name: len(bone.angles) for name, bone in skeleton.bones.items() if bone.angles}
    values: dict[str, list[Floats]] = {name: [] for name in counts}
    frame = 0
    for number, words in _lines(path):
        if words[0].startswith(":"):
            continue
        if len(words) == 1 and words[0].isdigit():
            frame += 1
            continue
        name, where = words[0], f"{path}:{number}"
        if name not in values:
            raise MocapError(f"{where}: {name!r} is not a moving bone of the skeleton")
        if len(values[name]) != frame - 1:
            raise MocapError(f"{where}: {name} is out of place in frame {frame}")
        values[name].append(_numbers(words[1:], counts[name], where))
    short = [name for name, rows in values.items() if len(rows) != frame]
    if short or not frame:
        raise MocapError(f"{path}: {frame} frames, incomplete for {', '.join(short) or 'every bone'}")
    return {name: np.array(rows) for name, rows in values.items()}


def _euler(degrees: Floats) -> Floats:
    """``Rz(z) Ry(y) Rx(x)`` (..., 3, 3) of angles (..., 3) [deg]."""
    matrices: Floats = Rotation.from_euler("xyz", degrees.reshape(-1, 3), degrees=True).as_matrix()
    return matrices.reshape(*degrees.shape, 3)


def _forward_kinematics(
    skeleton: _Skeleton, order: list[str], angles: dict[str, Floats], frame_rate_hz: float
) -> MotionClip:
    frames = len(angles[ROOT])
    rotations, tails = np.empty((frames, len(order), 3, 3)), np.empty((frames, len(order), 3))
    rotations[:, 0] = _euler(angles[ROOT][:, 3:])
    tails[:, 0] = angles[ROOT][:, :3] * METRES_PER_UNIT
    for index, name in enumerate(order[1:], 1):
        bone, parent = skeleton.bones[name], order.index(skeleton.parents[name])
        xyz = np.zeros((frames, 3))
        for column, axis in enumerate(bone.angles):
            xyz[:, "xyz".index(axis)] = angles[name][:, column]
        rotations[:, index] = rotations[:, parent] @ bone.axes @ _euler(xyz) @ bone.axes.T
        tails[:, index] = tails[:, parent] + rotations[:, index] @ bone.direction * bone.length_m
    rest = [skeleton.bones[name] for name in order[1:]]
    return MotionClip(
        bones=tuple(order),
        directions=np.array([np.zeros(3), *(bone.direction for bone in rest)]),
        lengths_m=np.array([0.0, *(bone.length_m for bone in rest)]),
        frame_rate_hz=frame_rate_hz,
        rotations=rotations,
        tails=tails,
        head_pitch_rad=_HEAD_PITCH_RAD,
    )
