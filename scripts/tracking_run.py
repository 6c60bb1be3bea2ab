"""One tracker followed through one film, and its figures: e_t, lost frames, times, flips in the truth.

e_t of a frame is the mean distance of 16 joints ÷ R, R the radius of the ball about the true surface (Lien 2009
§6.2.1). It is raw: no alignment of any kind, and ``lost_share`` is judged by it, so that nothing learned from the truth
makes a frame look found. ``e_t_mean_aligned`` alone allows one constant offset per joint in its link's frame, fitted
over the run: where inside a clothed limb a joint is, a surface does not show.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import NAMED_JOINT_LINKS
from common.body.skeleton_pose import forward_kinematics
from common.geometry import quaternion
from scripts.fidelity import bounding_ball_radius, constant_offsets, joint_errors_m
from scripts.tracking_conditions import MOTION_BEGINS_S, Sight
from sender.capture.body_performer import BodyPerformer
from sender.fitting.start_joints import skeleton_from_joints
from sender.fitting.tracker import FitResult, Tracker

Array = NDArray[Any]

LOST_E_T = 0.05
FLIP_RATE_HZ = 60.0  # frames a second of motion capture in which flips are looked for
FLIP_RAD = np.deg2rad(24.0)  # 1,440° a second: the fastest throws reach that; retarget slows source flips down to 25°
CLEAN_SHARE = 0.02  # a clip whose joints flip in fewer of its frames is clean


@dataclass(frozen=True, slots=True)
class Case:
    """One film and the tracker that follows it."""

    tracker: str
    body: str
    clip: str
    condition: str
    data: Path | None
    seconds: float | None

    @property
    def name(self) -> str:
        return f"{self.tracker}/{self.body}/{self.clip}/{self.condition}"


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A case's figures, ``flipped`` of ``frames`` in its truth, and the error over time for pictures."""

    case: Case
    metrics: dict[str, float]
    flipped: int
    frames: int
    times_s: list[float]
    e_t: list[float]


@dataclass
class Run:
    """A tracked film from its first skeleton on: ``times_s``, ``estimated`` and ``truth`` (16, 3) [m, world],
    ``rotations`` (16, 3, 3) of the joints' links, ``radii_m``, and whether the skeleton was ``seen`` or is all guesses
    (every link's confidence 0, as when a tracker repeats its last pose). ``missing``: frames without any skeleton."""

    times_s: list[float] = field(default_factory=list)
    estimated: list[Array] = field(default_factory=list)
    rotations: list[Array] = field(default_factory=list)
    truth: list[Array] = field(default_factory=list)
    radii_m: list[float] = field(default_factory=list)
    seen: list[bool] = field(default_factory=list)
    missing: int = 0
    cpu_ms: list[float] = field(default_factory=list)

    def add(self, fit: FitResult | None, cpu_s: float, sight: Sight) -> None:
        """What came of one frame."""
        self.cpu_ms.append(cpu_s * 1e3)
        seen = fit is not None and bool(fit.pose.confidence.any())
        if not seen and not self.times_s:
            return
        if fit is None:
            self.missing += 1
            return
        T = forward_kinematics(fit.skeleton, fit.pose)[NAMED_JOINT_LINKS].astype(np.float64)
        self.times_s.append(sight.time_s)
        self.seen.append(seen)
        self.estimated.append(T[:, :3, 3])
        self.rotations.append(T[:, :3, :3])
        self.truth.append(sight.joints.astype(np.float64))
        self.radii_m.append(bounding_ball_radius(sight.surface))

    def e_t(self) -> Array:
        """Raw error (F,) of the frames with a skeleton."""
        return joint_errors_m(np.array(self.estimated), np.array(self.truth)) / np.array(self.radii_m)

    def e_t_aligned(self) -> Array:
        """Error (F,) after one constant offset per joint in its link's frame."""
        truth = np.array(self.truth)
        estimated = constant_offsets(np.array(self.estimated), np.array(self.rotations), truth)
        return joint_errors_m(estimated, truth) / np.array(self.radii_m)

    def metrics(self) -> dict[str, float]:
        """The figures by name; without any skeleton all there is to say is that every frame is lost."""
        times = {f"ms_per_frame_p{p}": float(np.percentile(self.cpu_ms, p)) for p in (50, 99)} if self.cpu_ms else {}
        if not self.times_s:
            return {"lost_share": 1.0} | times
        e_t = self.e_t()
        lost = (e_t > LOST_E_T) | ~np.array(self.seen)
        return {
            "e_t_mean": float(e_t.mean()),
            "e_t_mean_aligned": float(self.e_t_aligned().mean()),
            "e_t_max": float(e_t.max()),
            "lost_share": (self.missing + int(lost.sum())) / (self.missing + len(e_t)),
            "time_to_skeleton_s": self.times_s[0],
        } | times


def follow(tracker: Tracker, film: Iterable[Sight], given: bool) -> Run:
    """Every frame through the tracker. ``given``: sizes and pose of the first frame, which then is not judged, are the
    true ones."""
    run = Run()
    for number, sight in enumerate(film):
        capture_ns = round(sight.time_s * 1e9)
        if given and number == 0:
            skeleton, pose = skeleton_from_joints(sight.joints.astype(np.float64))
            tracker.start_from(skeleton, pose, sight.cloud, capture_ns)
            continue
        begun = time.thread_time()
        fit = tracker.track(sight.cloud, capture_ns)
        run.add(fit, time.thread_time() - begun, sight)
    return run


def flips(rotations: Array) -> Array:
    """Which steps (F − 1,) turn a joint faster than people can: ``rotations`` (F, J, 4) relative to the joint above, at
    ``FLIP_RATE_HZ``."""
    return np.asarray((quaternion.angle_between(rotations[1:], rotations[:-1]) > FLIP_RAD).any(axis=1))


def flips_of(performer: BodyPerformer) -> tuple[int, int]:
    """Frames of the true motion in which a joint flips, and how many frames it has."""
    times = np.arange(MOTION_BEGINS_S, performer.motion_s, 1 / FLIP_RATE_HZ)
    found = flips(np.array([performer.named_rotations(t) for t in times]))
    return int(found.sum()), len(found)


def is_clean(flipped: int, frames: int) -> bool:
    """Whether a clip's truth can be taken at its word."""
    return flipped < CLEAN_SHARE * frames
