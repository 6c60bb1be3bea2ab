"""Limbs followed by annealed particle filters: joint-angle error and time, as published and improved (Rao & Hodges §6).

Cases ``legs|arm/body/clip/published|improved``. The tracker gets 3,000 points a frame, spread evenly over the mesh of
the limb it tracks (thighs, shins, feet and toes of both sides; or upper arm and forearm of one side, without the hand),
30 frames/s, not labelled by link or side, and in every frame the true transform of the link that carries the limb
(pelvis, clavicle). Bone lengths, the first pose and the first cloud are given; it measures its ellipsoids on them.
``arm`` is both arms, each with its own tracker. Truth: the body's own joints in the same parametrisation.
``-262144`` is the paper's 512² points (the first second), ``-4fps`` the paper's frame rate.
The noise is learned from all other clips; without clips it is the default. ``all/clean`` are the clips without
glitches, whole, ``all/clean-opening`` their first six seconds.

Error: |estimated − true| per degree of freedom, wrapped, averaged over those of a frame; mean and largest over frames.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, SIDES
from scripts.limb_truth import LinkedBody, linked_body, posed_joints
from scripts.run_bench import Row
from scripts.tracking_conditions import surface_points
from sender.capture.body_performer import PoseTrack
from sender.capture.builtin_body import builtin_body
from sender.capture.choreography import routine
from sender.capture.mocap import clip_names, read_clip
from sender.capture.retarget import retarget
from sender.capture.skinned_body import SkinnedBody, load_body
from sender.fitting.ellipsoid_body import LEGS, EllipsoidBody, arm_links, ellipsoid_body, particle_of
from sender.fitting.limb_tracker import IMPROVED, PUBLISHED, LimbSettings, LimbTracker
from sender.fitting.motion_noise import MotionNoise, default_noise, learned_noise

Array = NDArray[Any]

FRAME_RATE_HZ = 30
POINTS, TEXELS = 3000, 512 * 512
CLEAN = ("16_15", "16_17", "127_04", "127_02", "14_06", "14_02", "02_10")
TEXEL_SECONDS = 1.0
OPENING_S = 6.0  # of a clip: before a tracker that is lost and stays lost has spoilt the mean
_TOES = tuple(f"{side}_toes" for side in SIDES)


@dataclass(frozen=True, slots=True)
class Limb:
    """``links``: what is tracked; ``carrier``: the link whose transform is given; ``surface``: whose mesh is seen."""

    links: tuple[str, ...]
    carrier: str
    surface: tuple[str, ...]


LIMBS = {
    "legs": (Limb(LEGS, "pelvis", LEGS + _TOES),),
    "arm": tuple(Limb(arm_links(side), f"{side}_clavicle", arm_links(side)) for side in SIDES),
}


@dataclass(frozen=True, slots=True)
class Variant:
    """``limbs``: which limbs it is run on; ``stride``: every so many frames of 1/30 s; ``seconds``: at most."""

    name: str
    settings: LimbSettings
    points: int = POINTS
    stride: int = 1
    seconds: float | None = None
    limbs: tuple[str, ...] = ("legs", "arm")


VARIANTS = (
    Variant("published", PUBLISHED),
    Variant("improved", IMPROVED),
    Variant("published-262144", PUBLISHED, points=TEXELS, seconds=TEXEL_SECONDS, limbs=("legs",)),
    Variant("published-4fps", PUBLISHED, stride=8),
    Variant("improved-4fps", IMPROVED, stride=8),
)
_REFERENCES = {
    "angle_error_mean_deg": (7.73, "Rao & Hodges §6 (clips not named)"),
    "angle_error_max_deg": (19.31, "Rao & Hodges §6 (clips not named)"),
    "ms_per_frame_p50": (250.0, "Rao & Hodges §6: 250 on the GPU, 5,000 on the CPU (512² points)"),
}


@dataclass
class Run:
    """``errors_deg``: per frame the mean over the degrees of freedom; ``cpu_ms``: per frame and tracker."""

    errors_deg: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)

    def add(self, other: Run) -> None:
        self.errors_deg += other.errors_deg
        self.cpu_ms += other.cpu_ms

    def first(self, seconds: float, stride: int) -> Run:
        """The beginning of it, of every ``stride``-th frame."""
        frames = round(seconds * FRAME_RATE_HZ / stride)
        return Run(self.errors_deg[:frames], self.cpu_ms[:frames])

    def metrics(self) -> dict[str, tuple[float, str]]:
        return {
            "angle_error_mean_deg": (float(np.mean(self.errors_deg)), "deg"),
            "angle_error_max_deg": (float(np.max(self.errors_deg)), "deg"),
            "ms_per_frame_p50": (float(np.percentile(self.cpu_ms, 50)), "ms (CPU of the thread)"),
            "ms_per_frame_p99": (float(np.percentile(self.cpu_ms, 99)), "ms (CPU of the thread)"),
        }


def add_options(parser: argparse.ArgumentParser) -> None:
    """This bench's own options."""
    names = ", ".join(variant.name for variant in VARIANTS)
    parser.add_argument("--variants", default="", help=f"only these, separated by commas, of {names}")


def run(data: Path | None, seconds: float | None = None, clips: tuple[str, ...] = (), variants: str = "") -> list[Row]:
    """Rows for every body and clip, and for the built-in performer (clip ``routine``); progress on stderr.
    ``variants``: only these; all when empty."""
    chosen = set(filter(None, variants.split(","))) or {variant.name for variant in VARIANTS}
    unknown = chosen - {variant.name for variant in VARIANTS}
    if unknown:
        raise SystemExit(f"no variant {', '.join(sorted(unknown))}")
    rows: list[Row] = []
    clean: dict[str, Run] = {}
    noises = _Noises(data)
    for name, body, clip, track in _cases(data, clips):
        linked = linked_body(body, track)
        for kind, limbs in LIMBS.items():
            for variant in VARIANTS:
                if kind not in variant.limbs or variant.name not in chosen:
                    continue
                begun = time.monotonic()
                result, opening = Run(), Run()
                for limb in limbs:
                    noise = noises.without(clip, limb, ellipsoid_body(linked.skeleton, limb.links))
                    of_limb = follow(linked, track, limb, variant, noise, seconds)
                    result.add(of_limb)
                    opening.add(of_limb.first(OPENING_S, variant.stride))
                rows += _rows(f"{kind}/{name}/{clip}/{variant.name}", result, begun)
                if clip in CLEAN:
                    clean.setdefault(f"{kind}/all/clean/{variant.name}", Run()).add(result)
                    clean.setdefault(f"{kind}/all/clean-opening/{variant.name}", Run()).add(opening)
    for case, result in clean.items():
        rows += _rows(case, result, time.monotonic())
    return rows


def follow(
    linked: LinkedBody,
    track: PoseTrack,
    limb: Limb,
    variant: Variant,
    noise: MotionNoise,
    seconds: float | None,
) -> Run:
    """One tracker on one limb over the track."""
    body = ellipsoid_body(linked.skeleton, limb.links)
    tracker = LimbTracker(body, noise, variant.settings)
    faces, random = linked.faces_of(limb.surface), np.random.default_rng(0)
    bound = min((s for s in (seconds, variant.seconds) if s is not None), default=None)
    result = Run()
    rate_hz = FRAME_RATE_HZ / variant.stride
    for frame, T_world_joint in enumerate(posed_joints(linked.body, track, rate_hz, bound)):
        T_carrier, truth = _truth(linked, body, limb, T_world_joint)
        vertices = linked.body.surface(T_world_joint)
        colours = linked.body.mesh.vertex_colours
        points = surface_points(vertices, faces, colours, variant.points, random).positions
        capture_ns = round(frame / rate_hz * 1e9)
        if frame == 0:
            tracker.start_from(points, truth, T_carrier, capture_ns)
            continue
        begun_s = time.thread_time()
        fit = tracker.track(points, T_carrier, capture_ns)
        result.cpu_ms.append((time.thread_time() - begun_s) * 1e3)
        away = (fit.particle - truth + np.pi) % (2 * np.pi) - np.pi
        result.errors_deg.append(float(np.degrees(np.abs(away)).mean()))
    return result


def _truth(linked: LinkedBody, body: EllipsoidBody, limb: Limb, T_world_joint: Array) -> tuple[Array, Array]:
    """The carrier's transform (4, 4) and the limb's true degrees of freedom (D,)."""
    T = linked.link_transforms(T_world_joint)
    T_carrier = T[LINK_INDEX[limb.carrier]]
    return T_carrier, particle_of(body, T[[LINK_INDEX[name] for name in limb.links]], T_carrier)


class _Noises:
    """Motion noise learned from all clips but one, by the first body there is; the default without clips."""

    def __init__(self, data: Path | None) -> None:
        self._data = data
        self._angles: dict[tuple[str, ...], dict[str, Array]] = {}
        self._tracks: dict[str, tuple[LinkedBody, PoseTrack]] = {}

    def without(self, clip: str, limb: Limb, body: EllipsoidBody) -> MotionNoise:
        if self._data is None:
            return default_noise(body)
        if limb.links not in self._angles:
            self._angles[limb.links] = {name: self._of(name, limb) for name in clip_names(self._data / "mocap")}
        return learned_noise([angles for name, angles in self._angles[limb.links].items() if name != clip])

    def _of(self, clip: str, limb: Limb) -> Array:
        if clip not in self._tracks:
            assert self._data is not None
            skinned = load_body(min((self._data / "bodies").glob("*.npz")))
            track = retarget(skinned, read_clip(self._data / "mocap", clip))
            self._tracks[clip] = linked_body(skinned, track), track
        linked, track = self._tracks[clip]
        body = ellipsoid_body(linked.skeleton, limb.links)
        return np.array([_truth(linked, body, limb, T)[1] for T in posed_joints(linked.body, track, 30, None)])


def _cases(data: Path | None, clips: tuple[str, ...]) -> Iterator[tuple[str, SkinnedBody, str, PoseTrack]]:
    """Body's name, body, clip's name, its poses."""
    if not clips or "routine" in clips:
        body = builtin_body()
        yield "builtin", body, "routine", retarget(body, routine())
    if data is None:
        return
    there = json.loads((data / "mocap" / "clips.json").read_text())
    unknown = set(clips) - set(there) - {"routine"}
    if unknown:
        raise SystemExit(f"no clip {', '.join(sorted(unknown))}; there are: routine, {', '.join(sorted(there))}")
    for path in sorted((data / "bodies").glob("*.npz")):
        body = load_body(path)
        for clip in [name for name in there if not clips or name in clips]:
            yield path.stem, body, clip, retarget(body, read_clip(data / "mocap", clip))


def _rows(case: str, result: Run, begun: float) -> list[Row]:
    rows: list[Row] = []
    for metric, (value, unit) in result.metrics().items():
        reference, source = _REFERENCES.get(metric, (None, ""))
        rows.append(
            {"case": case, "metric": metric, "value": value, "unit": unit, "reference": reference, "source": source}
        )
    summary = "  ".join(f"{row['metric']} {row['value']:.2f}" for row in rows)
    print(f"{case}: {summary}  ({time.monotonic() - begun:.0f} s)", file=sys.stderr, flush=True)
    return rows
