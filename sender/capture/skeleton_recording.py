"""Recorded skeletons of one person from one or more sensors, one JSON object a line (docs/recordings.md)."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sender.capture.frame_set import CaptureError
from sender.capture.kinect_multi_track import read_multi_track
from sender.capture.outside_skeleton import (
    JOINTS_BY_KIND,
    MAX_SENSORS,
    Instant,
    OutsideSkeleton,
    Sensor,
    SkeletonRecording,
)

FORMAT, VERSION = "telepose skeletons", 1
SUFFIXES = (".jsonl", ".csv")
MAX_INSTANTS = 200_000  # two hours
_MAX_LINE = 64 * 1024
_MAX_TIME_NS = 1 << 62


def open_skeleton_recording(path: Path) -> SkeletonRecording:
    """The skeletons in ``path``, a ``.jsonl`` file of ours or a KinectMultiTrack ``.csv``.

    Raises:
        CaptureError: no such file, or malformed; the message names file, line and fault.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            recording = read_multi_track(_bounded(file)) if path.suffix == ".csv" else _read_lines(file)
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from None
    except (ValueError, csv.Error) as error:
        raise CaptureError(f"{path}: {error}") from None
    if not recording.instants:
        raise CaptureError(f"{path}: not a single skeleton")
    times_ns = [skeleton.capture_ns for instant in recording.instants for skeleton in instant]
    if max(times_ns) - min(times_ns) > _MAX_TIME_NS:
        raise CaptureError(f"{path}: its times are too far apart")
    return _from_zero(recording)


def write_skeleton_recording(path: Path, recording: SkeletonRecording) -> None:
    """Write the recording in our format; coordinates to 0.1 mm."""
    sensors = [{"name": sensor.name, "position": sensor.position} for sensor in recording.sensors]
    head = {"format": FORMAT, "version": VERSION, "joints": recording.kind}
    lines: list[dict[str, Any]] = [head | {"frame_rate_hz": recording.frame_rate_hz, "sensors": sensors}]
    for instant in recording.instants:
        skeletons = [
            {
                "sensor": skeleton.sensor,
                "time_ns": skeleton.capture_ns,
                "joints": [[round(float(v), 4) for v in joint] for joint in skeleton.joints],
                "confidence": [round(float(v), 3) for v in skeleton.confidence],
            }
            for skeleton in instant
        ]
        lines.append({"skeletons": skeletons})
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def _from_zero(recording: SkeletonRecording) -> SkeletonRecording:
    first_ns = min(skeleton.capture_ns for instant in recording.instants for skeleton in instant)
    instants = tuple(
        tuple(replace(skeleton, capture_ns=skeleton.capture_ns - first_ns) for skeleton in instant)
        for instant in recording.instants
    )
    return replace(recording, instants=instants)


def _bounded(lines: Iterable[str]) -> Iterator[str]:
    for number, line in enumerate(lines):
        if number > MAX_INSTANTS * MAX_SENSORS:
            raise ValueError(f"more than {MAX_INSTANTS} instants")
        if len(line) > _MAX_LINE:
            raise ValueError(f"line {number + 1}: longer than {_MAX_LINE} characters")
        yield line


def _read_lines(file: Iterable[str]) -> SkeletonRecording:
    lines = _bounded(file)
    try:
        kind, sensors, rate_hz = _head(json.loads(next(lines, "")))
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise ValueError(f"line 1: {_said(error)}") from None
    instants: list[Instant] = []
    for number, line in enumerate(lines, start=2):
        try:
            instants.append(_instant(json.loads(line), kind, len(sensors)))
            if len(instants) > 1 and _time_ns(instants[-1]) < _time_ns(instants[-2]):
                raise ValueError("earlier than the line before")
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise ValueError(f"line {number}: {_said(error)}") from None
    return SkeletonRecording(kind, sensors, rate_hz, tuple(instants))


def _said(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)


def _head(record: Any) -> tuple[str, tuple[Sensor, ...], float]:
    if not isinstance(record, dict) or record.get("format") != FORMAT or record.get("version") != VERSION:
        raise ValueError(f"not {FORMAT!r} version {VERSION}")
    kind, rate_hz = str(record["joints"]), float(record["frame_rate_hz"])
    if kind not in JOINTS_BY_KIND:
        raise ValueError(f"joints {kind!r}; known are {', '.join(JOINTS_BY_KIND)}")
    if not 0.1 <= rate_hz <= 1000:
        raise ValueError(f"frame rate {rate_hz} Hz")
    sensors = tuple(_sensor(each) for each in record["sensors"])
    if not 1 <= len(sensors) <= MAX_SENSORS:
        raise ValueError(f"{len(sensors)} sensors, 1 to {MAX_SENSORS} are possible")
    return kind, sensors, rate_hz


def _sensor(record: Any) -> Sensor:
    position = np.array(record["position"], np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise ValueError(f"sensor {record['name']}: position is not three finite numbers")
    return Sensor(str(record["name"]), (float(position[0]), float(position[1]), float(position[2])))


def _instant(record: Any, kind: str, sensors: int) -> Instant:
    skeletons = tuple(_skeleton(each, kind) for each in record["skeletons"])
    seen = [skeleton.sensor for skeleton in skeletons]
    if not skeletons or len(set(seen)) != len(seen) or not all(0 <= sensor < sensors for sensor in seen):
        raise ValueError(f"skeletons of sensors {seen}: one each of some of the {sensors} sensors is needed")
    return skeletons


def _skeleton(record: Any, kind: str) -> OutsideSkeleton:
    count = len(JOINTS_BY_KIND[kind])
    if len(record["joints"]) != count:
        raise ValueError(f"{len(record['joints'])} joints, {kind} has {count}")
    joints = np.array([(0.0, 0.0, 0.0) if joint is None else joint for joint in record["joints"]], np.float64)
    there = np.array([joint is not None for joint in record["joints"]], np.float64)
    given = record.get("confidence")
    confidence = there if given is None else np.array(given, np.float64)
    if confidence.shape == there.shape:
        confidence = confidence * there
    time_ns = int(record["time_ns"])
    if not 0 <= time_ns < _MAX_TIME_NS:
        raise ValueError(f"time_ns {time_ns}")
    return OutsideSkeleton(time_ns, int(record["sensor"]), _f32(joints), _f32(confidence))


def _f32(values: NDArray[np.float64]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such
        return values.astype(np.float32)


def _time_ns(instant: Instant) -> int:
    return max(skeleton.capture_ns for skeleton in instant)
