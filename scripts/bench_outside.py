"""Two real Kinect v2 at once, 0, 45 and 90° apart: is their merged skeleton steadier than either, and not late?

``jitter_mm``: how far a joint lies from the line between its neighbours in time, over all joints and frames, scaled to
the noise of a single position; the mean is ruled by jumps, the median by the quiet frames. Sensors are judged by their
own frames at their own times (repeated ones left out). ``bone_length_sd_mm``: mean over the bones. ``lag_frames``: the
shift at which the joints' velocities agree best with the sensors' (frames of 1/30 s; the larger of the two).
``disagreement_mm``: median distance of the joints from the other sensor's, or of merged from both.
``published``: after the fit of our link tree, as it goes to the receivers.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scripts.run_bench import Row
from sender.capture.outside_skeleton import SkeletonRecording
from sender.capture.skeleton_recording import open_skeleton_recording
from sender.fitting.bone_lengths import bones_of
from sender.fitting.outside_joints import sensor_joints
from sender.fitting.outside_tracker import OutsideTracker
from sender.fitting.skeleton_merging import SkeletonMerger

Floats = NDArray[np.float64]

ANGLES = {"0": "0", "45": "1", "90": "2"}  # degrees → layout in the file names
FRAME_S = 1 / 30
GAP_S = 0.1  # neighbours in time are no farther apart
SHIFTS_S = np.arange(-0.08, 0.0801, 0.008)
FAST_M = 0.1  # a frame's step beyond this is a jump, not motion


@dataclass
class Motion:
    """``times_s`` (F,), strictly rising, and ``joints`` (F, J, 3) [m]."""

    times_s: Floats
    joints: Floats

    def residuals_mm(self) -> Floats:
        """(F', J) distances from the line between the neighbours in time, scaled to the noise of one position."""
        steps = np.diff(self.times_s)
        near = (steps[:-1] < GAP_S) & (steps[1:] < GAP_S)
        share = (steps[:-1] / (steps[:-1] + steps[1:]))[:, None, None]
        between = self.joints[:-2] * (1 - share) + self.joints[2:] * share
        off = (self.joints[1:-1] - between) / np.sqrt(1 + share**2 + (1 - share) ** 2)
        return np.asarray(np.linalg.norm(off, axis=2)[near] * 1e3)

    def steps(self, grid_s: Floats) -> Floats:
        """How far every coordinate goes between the times of a grid (G − 1, J·3); NaN where there are no data."""
        after = np.searchsorted(self.times_s, grid_s).clip(1, len(self.times_s) - 1)
        known = self.times_s[after] - self.times_s[after - 1] < GAP_S
        flat = self.joints.reshape(len(self.joints), -1)
        there = np.stack([np.interp(grid_s, self.times_s, column) for column in flat.T], axis=1)
        steps = np.diff(np.where(known[:, None], there, np.nan), axis=0)
        return np.where(np.abs(steps) < FAST_M, steps, np.nan)


def run(data: Path | None, seconds: float | None = None, clips: tuple[str, ...] = ()) -> list[Row]:
    """Rows for every angle; ``clips``: only these (``0``, ``45``, ``90``)."""
    if data is None:
        raise SystemExit("this bench needs --data, a folder with rgbd/kinect2_pair_skeletons")
    rows: list[Row] = []
    for angle in clips or ANGLES:
        if angle not in ANGLES:
            raise SystemExit(f"no angle {angle}; there are {', '.join(ANGLES)}")
        folder = data / "rgbd" / "kinect2_pair_skeletons"
        file = next(folder.glob(f"*_Kinect_{ANGLES[angle]}_*.csv"), None)
        if file is None:
            raise SystemExit(f"{folder}: no recording at {angle} degrees")
        rows += _angle(f"kinect2-pair/{angle}", open_skeleton_recording(file), seconds)
        print(f"{angle} degrees done", file=sys.stderr, flush=True)
    return rows


def _angle(case: str, recording: SkeletonRecording, seconds: float | None) -> list[Row]:
    count = len(recording.instants) if seconds is None else int(seconds / FRAME_S)
    instants = recording.instants[:count]
    sensors = [
        _motion([(s.capture_ns, s.joints) for instant in instants for s in instant if s.sensor == number])
        for number in range(len(recording.sensors))
    ]
    merger, tracker = (
        SkeletonMerger(recording.kind, recording.sensors),
        OutsideTracker(recording.kind, recording.sensors),
    )
    merged = _motion([(m.capture_ns, m.joints) for m in map(merger.merge, instants)])
    begun = time.thread_time()
    fits = [tracker.track(instant) for instant in instants]
    frame_ms = (time.thread_time() - begun) * 1e3 / len(instants)
    published = _motion(
        [
            (max(s.capture_ns for s in instant), sensor_joints(fit.skeleton, fit.pose, recording.kind))
            for instant, fit in zip(instants, fits, strict=True)
            if fit is not None
        ]
    )
    rows = []
    for number, motion in enumerate(sensors):
        others = sensors[:number] + sensors[number + 1 :]
        rows += _rows(f"{case}/sensor-{number}", motion, others, recording.kind)
    for name, motion in (("merged", merged), ("published", published)):
        rows += _rows(f"{case}/{name}", motion, sensors, recording.kind)
    return [*rows, _row(f"{case}/published", "ms_per_frame", frame_ms, "ms (CPU of the thread)")]


def _motion(frames: list[tuple[int, NDArray[np.floating]]]) -> Motion:
    """Frames in order of time; of repeated ones the first."""
    first = dict(reversed(frames))
    times_ns = sorted(first)
    return Motion(np.array(times_ns) * 1e-9, np.array([first[time_ns] for time_ns in times_ns], np.float64))


def _rows(case: str, motion: Motion, others: list[Motion], kind: str) -> list[Row]:
    bones = bones_of(kind)
    off = motion.residuals_mm()
    lengths = np.linalg.norm(motion.joints[:, bones[:, 0]] - motion.joints[:, bones[:, 1]], axis=2)
    return [
        _row(case, "jitter_mm", float(off.mean()), "mm"),
        _row(case, "jitter_median_mm", float(np.median(off)), "mm"),
        _row(case, "jitter_p99_mm", float(np.percentile(off, 99)), "mm"),
        _row(case, "bone_length_sd_mm", float(lengths.std(axis=0).mean() * 1e3), "mm"),
        _row(case, "lag_frames", max((_lag_frames(motion, other) for other in others), key=abs), "frames"),
        _row(case, "disagreement_mm", float(np.median([_apart_mm(motion, other) for other in others])), "mm"),
    ]


def _row(case: str, metric: str, value: float, unit: str) -> Row:
    return Row(case=case, metric=metric, value=value, unit=unit, reference=None, source="")


def _lag_frames(motion: Motion, other: Motion) -> float:
    """How much later ``motion`` is."""
    grid_s = np.arange(other.times_s[0], other.times_s[-1], FRAME_S)
    theirs = other.steps(grid_s)
    agreement = []
    for shift_s in SHIFTS_S:
        ours = motion.steps(grid_s + shift_s)
        both = np.isfinite(ours) & np.isfinite(theirs)
        a, b = ours[both], theirs[both]
        agreement.append(float(a @ b / np.sqrt((a @ a) * (b @ b))))
    best = int(np.clip(np.argmax(agreement), 1, len(SHIFTS_S) - 2))
    before, at, after = agreement[best - 1 : best + 2]
    peak = 0.5 * (before - after) / (before - 2 * at + after)  # of the parabola through the three
    return float((SHIFTS_S[best] + peak * (SHIFTS_S[1] - SHIFTS_S[0])) / FRAME_S)


def _apart_mm(motion: Motion, other: Motion) -> float:
    """Median distance of the joints from the other's, at the time of the frames nearest to each other."""
    after = np.searchsorted(other.times_s, motion.times_s).clip(1, len(other.times_s) - 1)
    before = after - 1
    earlier = motion.times_s - other.times_s[before] < other.times_s[after] - motion.times_s
    nearest = np.where(earlier, before, after)
    return float(np.median(np.linalg.norm(motion.joints - other.joints[nearest], axis=2)) * 1e3)
