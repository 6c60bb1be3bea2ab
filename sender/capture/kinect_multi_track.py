"""The tables of KinectMultiTrack: skeletons of two Kinect v2 at once (Wu, University of St Andrews, 2015).

A row is one skeleton, in the frame of a reference sensor (x to its left, y up, z away from it); the rows with one
``Tracker_Time`` belong together. The world's origin is put where the person first stands, on the floor.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from common.geometry.rigid_transform import rigid_transform, transform_points
from sender.capture.outside_skeleton import KINECT_V2_JOINTS, MAX_SENSORS, OutsideSkeleton, Sensor, SkeletonRecording

Floats = NDArray[np.float64]

_COLUMNS = ("Tracker_Time", "Skeleton_Time", "Skeleton_Init_Angle", "Skeleton_Init_Dist", "Kinect#", "Kinect_Height")
_TICK_NS, _MS_NS = 100, 1_000_000
_MOST_MS = 1 << 48  # since the year 1
_RATE_HZ = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """``joints`` (25, 3) [m, frame of the reference sensor]; ``angle_rad``: how far the person, at first, was turned
    from facing the sensor, ``distance_m`` from it."""

    tracker_ms: int
    skeleton_ticks: int
    angle_rad: float
    distance_m: float
    sensor: str
    height_m: float
    joints: Floats


def read_multi_track(lines: Iterable[str]) -> SkeletonRecording:
    """The skeletons of a table's lines; the tables tell no tracking state, so all joints count as tracked.

    Raises:
        ValueError: a column is missing, or a line malformed; the message names the line.
    """
    rows = list(_table_rows(csv.reader(lines, skipinitialspace=True)))
    if not rows:
        raise ValueError("no rows")
    names = sorted({row.sensor for row in rows})
    if len(names) > MAX_SENSORS:
        raise ValueError(f"{len(names)} sensors")
    # Each sensor has a clock of its own; the fastest delivery tells how it stands to the computer's.
    offset_ns = {name: min(_delay_ns(row) for row in rows if row.sensor == name) for name in names}
    T_world_reference = _origin_under(rows[0])

    def skeleton(row: _Row) -> OutsideSkeleton:
        capture_ns = row.skeleton_ticks * _TICK_NS + offset_ns[row.sensor]
        joints = transform_points(T_world_reference, row.joints).astype(np.float32)
        return OutsideSkeleton(capture_ns, names.index(row.sensor), joints, np.ones(len(joints), np.float32))

    instants = [tuple(skeleton(row) for row in together) for together in _in_order(rows)]
    firsts = [next(row for row in rows if row.sensor == name) for name in names]
    sensors = tuple(_placed(first, rows[0], T_world_reference) for first in firsts)
    return SkeletonRecording("kinect-v2", sensors, _RATE_HZ, tuple(instants))


def _in_order(rows: list[_Row]) -> Iterator[list[_Row]]:
    """The rows that belong together, by sensor. Now and then the tables give an older skeleton after a newer one: then
    the newer one still counts, and where that is all, there is nothing new."""
    newest: dict[str, _Row] = {}
    for _, group in groupby(rows, key=lambda row: row.tracker_ms):
        together = {row.sensor: row for row in group}
        news = False
        for name, row in together.items():
            news = news or name not in newest or row.skeleton_ticks > newest[name].skeleton_ticks
            if name not in newest or row.skeleton_ticks > newest[name].skeleton_ticks:
                newest[name] = row
        if news:
            yield [newest[name] for name in sorted(together)]


def _origin_under(first: _Row) -> Floats:
    """``T_world_reference`` (4, 4): turned to look along −Z of the world, the person of ``first`` over the origin."""
    turned = np.diag([-1.0, 1.0, -1.0])
    base = turned @ first.joints[KINECT_V2_JOINTS.index("spine_base")]
    return np.asarray(rigid_transform(turned, np.array([-base[0], first.height_m, -base[2]])), np.float64)


def _placed(row: _Row, first: _Row, T_world_reference: Floats) -> Sensor:
    """Where the sensor of ``row`` stands, if the person stood in the middle of its view. The reference sensor is the
    first row's (there the person's shoulders are turned by just the angle that the table gives)."""
    person = first.joints[KINECT_V2_JOINTS.index("spine_base")]
    turn = first.angle_rad - row.angle_rad
    backwards = np.array([np.sin(turn), 0.0, -np.cos(turn)])
    position = person + row.distance_m * backwards
    position[1] = 0.0
    x, y, z = transform_points(T_world_reference, position[None])[0]
    return Sensor(row.sensor, (float(x), float(y), float(z)))


def _table_rows(table: Iterator[list[str]]) -> Iterator[_Row]:
    head = next(table, [])
    wanted = [f"{_column_of(joint)}_{axis}" for joint in KINECT_V2_JOINTS for axis in "XYZ"]
    missing = [name for name in (*_COLUMNS, *wanted) if name not in head]
    if missing:
        raise ValueError(f"line 1: no column {missing[0]}")
    at = [head.index(name) for name in _COLUMNS]
    places = [head.index(name) for name in wanted]
    for number, cells in enumerate(table, start=2):
        try:
            if len(cells) != len(head):
                raise ValueError(f"{len(cells)} cells, not {len(head)}")
            joints = np.array([float(cells[place]) for place in places]).reshape(-1, 3)
            tracker, ticks, angle, distance, sensor, height = (cells[place] for place in at)
            row = _Row(int(tracker), int(ticks), float(angle), float(distance), sensor, float(height) / 100, joints)
            if not (abs(row.tracker_ms) < _MOST_MS and abs(row.skeleton_ticks) < _MOST_MS * _MS_NS // _TICK_NS):
                raise ValueError("a time is out of range")
            if not (np.isfinite([row.angle_rad, row.distance_m, row.height_m]).all() and np.isfinite(joints).all()):
                raise ValueError("a number is not finite")
            yield row
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None


def _column_of(joint: str) -> str:
    side, _, part = joint.partition("_")
    words = part if side in ("left", "right") else joint
    name = "".join(word.capitalize() for word in words.split("_"))
    return name + side.capitalize() if side in ("left", "right") else name


def _delay_ns(row: _Row) -> int:
    return row.tracker_ms * _MS_NS - row.skeleton_ticks * _TICK_NS
