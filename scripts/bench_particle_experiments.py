"""What Rao & Hodges report beside their filter: 2-D weights, random selection, crossover, PCA space, weights on a GPU.

Synthetic legs as in the paper (``particle_experiments``), at 15 frames/s; noise and components are learned from other
motions: from all other clips, or, for the built-in routine, from its first half (its second half is tracked).
``fig4/CLIP/…``: searches for the widest stride of a clip, started with the legs side by side, weighed by points in
space or by four images; the share that ends with the legs swapped. ``fig5/CLIP/…``: what selection does to the order of
the weights, and crossover to the variance of the particles. ``fig10/CLIP/…``: the filter on the first K principal
components of the angles. ``weights/…``: one layer of 81 particles, 6 ellipsoids, on each device there is.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from scripts.particle_experiments import (
    CAMERA_M,
    PAPER,
    LegMotion,
    leg_motion,
    pca_space,
    projection_error_deg,
    selection_inversions,
    swapped_share,
    tracked,
    tracked_in_pca,
    uniform_chi_square,
    weigh_points,
    weigh_reprojection,
    widest_stride,
    with_legs_swapped,
)
from scripts.run_bench import Row
from sender.capture.builtin_body import builtin_body
from sender.capture.choreography import routine
from sender.capture.mocap import clip_names, read_clip
from sender.capture.retarget import retarget
from sender.capture.skinned_body import load_body
from sender.fitting.annealed_particle_filter import Weigh
from sender.fitting.ellipsoid_body import quadrics
from sender.fitting.motion_noise import learned_noise
from sender.fitting.particle_weights import ParticleWeights, numba_weights
from sender.fitting.particle_weights_opencl import OpenClUnavailable, opencl_weights

RATE_HZ, STEP = 30, 2
SECONDS = 8.0
DEFAULT_CLIPS = ("16_15", "14_06")
RUNS, SEEDS, DRAWS = 40, 3, 300
STRIDE_S = 8 / 30  # between the legs side by side and the stride: the paper's 4 Hz
COMPONENTS = (2, 4, 6, 8)
CROSSOVER = 0.5  # share of the particles that are mixed
POINTS, TEXELS, REPEATS = 3000, 512 * 512, 5


def run(data: Path | None, seconds: float | None = None, clips: tuple[str, ...] = ()) -> list[Row]:
    """Rows for the routine of the built-in body and, with ``data``, for clips (default: two); progress on stderr."""
    rows = [_row("fig5/generator", "chi_square_per_dof", _generator(), "1", 1.0, 'Fig. 5 a: "only approximately"')]
    for name, motion, others in _motions(data, seconds or SECONDS, clips):
        for experiment in (_swapping, _selection, _crossover, _pca):
            begun = time.monotonic()
            found = experiment(name, motion, others)
            rows += found
            shown = "  ".join(f"{row['case']} {row['metric']} {row['value']:.3g}" for row in found)
            print(f"{shown}  ({time.monotonic() - begun:.0f} s)", file=sys.stderr, flush=True)
        if name == "routine":
            rows += _timings(motion)
    return rows


def _row(case: str, metric: str, value: float, unit: str, reference: float | None = None, source: str = "") -> Row:
    return {"case": case, "metric": metric, "value": value, "unit": unit, "reference": reference, "source": source}


def _motions(
    data: Path | None, seconds: float, clips: tuple[str, ...]
) -> Iterator[tuple[str, LegMotion, list[LegMotion]]]:
    """Clip, its motion, and others to learn from, all at ``RATE_HZ``."""
    if not clips or "routine" in clips:
        body = builtin_body()
        whole = leg_motion(body, retarget(body, routine()), RATE_HZ)
        half = len(whole.particles) // 2
        first, second = (
            replace(whole, particles=whole.particles[rows], carriers=whole.carriers[rows])
            for rows in (slice(half), slice(half, half + int(seconds * RATE_HZ)))
        )
        yield "routine", second, [first]
    if data is None:
        return
    body = load_body(min((data / "bodies").glob("*.npz")))
    motions = {
        name: leg_motion(body, retarget(body, read_clip(data / "mocap", name)), RATE_HZ, seconds)
        for name in clip_names(data / "mocap")
    }
    for clip in [name for name in clips if name != "routine"] or DEFAULT_CLIPS:
        if clip not in motions:
            raise SystemExit(f"no clip {clip}; there are: routine, {', '.join(motions)}")
        yield clip, motions[clip], [motion for name, motion in motions.items() if name != clip]


def _generator() -> float:
    return float(np.mean([uniform_chi_square(100_000, 100, seed) for seed in range(20)]))


def _swapping(clip: str, motion: LegMotion, others: list[LegMotion]) -> list[Row]:
    frame = widest_stride(motion)
    swapped = with_legs_swapped(motion.particles[frame])[None]
    sigma = learned_noise([other.particles for other in others]).after(STRIDE_S)
    points = motion.points(frame, np.random.default_rng(0))
    weights: dict[str, tuple[Weigh, float | None, str]] = {
        "points": (weigh_points(motion, frame, points), 0.0, 'Fig. 4 f: "does not happen"'),
        "reprojection": (weigh_reprojection(motion, frame, False), None, "Fig. 4 a–e: happens"),
        "reprojection-both-sides": (weigh_reprojection(motion, frame, True), None, "Fig. 4 a–e: happens"),
    }
    rows = []
    for name, (weigh, reference, source) in weights.items():
        share = swapped_share(motion, frame, weigh, sigma, PAPER, RUNS)
        how = f"{source}; cameras {CAMERA_M} m away, {RUNS} searches"
        rows.append(_row(f"fig4/{clip}/{name}", "swapped_share", share, "1", reference, how))
        rows.append(_row(f"fig4/{clip}/{name}", "weight_of_swapped_legs", float(weigh(swapped)[0]), "1"))
    return rows


def _selection(clip: str, motion: LegMotion, others: list[LegMotion]) -> list[Row]:
    noise = learned_noise([other.particles for other in others])
    frame, random = widest_stride(motion), np.random.default_rng(0)
    sigma = noise.after(STEP / RATE_HZ)
    particles = motion.particles[frame] + sigma * random.standard_normal((PAPER.particles, len(sigma)))
    weights = weigh_points(motion, frame, motion.points(frame, random))(particles).astype(np.float64)
    rows = []
    for name in ("random", "deterministic"):
        settings = replace(PAPER, selection=name)
        found = selection_inversions(weights, settings, DRAWS)
        case, reference = f"fig5/{clip}/{name}", 0.0 if name == "deterministic" else None
        rows += [
            _row(case, "draws_with_a_lighter_before_a_heavier_share", found.draws, "1", reference, "Fig. 5 b, c"),
            _row(case, "pairs_inverted_share", found.pairs, "1", reference, "Fig. 5 b, c"),
            _row(case, "heaviest_dropped_share", found.missed, "1"),
        ]
        errors = [tracked(motion.every(STEP), noise, settings, seed).errors_deg.mean() for seed in range(SEEDS)]
        rows.append(_row(case, "angle_error_mean_deg", float(np.mean(errors)), "deg"))
    return rows


def _crossover(clip: str, motion: LegMotion, others: list[LegMotion]) -> list[Row]:
    noise = learned_noise([other.particles for other in others])
    rows = []
    for selection in ("deterministic", "random"):
        plain = replace(PAPER, selection=selection)
        without = [tracked(motion.every(STEP), noise, plain, seed) for seed in range(SEEDS)]
        crossed = replace(plain, crossover=CROSSOVER)
        mixed = [tracked(motion.every(STEP), noise, crossed, seed) for seed in range(SEEDS)]
        last = [np.mean([run.variance[:, -1] for run in runs], axis=(0, 1)) for runs in (mixed, without)]
        ratio = last[0] / last[1]
        case = f"fig5/{clip}/crossover-{selection}"
        rows += [
            _row(case, "variance_ratio_mean", float(ratio.mean()), "1", None, "Fig. 5 d: above 1 in some angles"),
            _row(case, "variance_ratio_max", float(ratio.max()), "1", None, "Fig. 5 d: above 1 in some angles"),
            _row(case, "angles_with_more_variance_share", float((ratio > 1).mean()), "1"),
            _row(case, "angle_error_mean_deg", float(np.mean([run.errors_deg.mean() for run in mixed])), "deg"),
        ]
    return rows


def _pca(clip: str, motion: LegMotion, others: list[LegMotion]) -> list[Row]:
    learned = [other.particles for other in others]
    motion = motion.every(STEP)
    runs = [tracked(motion, learned_noise(learned), PAPER, seed) for seed in range(SEEDS)]
    rows = [_error_row(f"fig10/{clip}/angles", [run.errors_deg.mean() for run in runs])]
    for count in COMPONENTS:
        space = pca_space(learned, STEP, count)
        errors = [tracked_in_pca(motion, space, PAPER, seed).errors_deg.mean() for seed in range(SEEDS)]
        case = f"fig10/{clip}/pca-{count}"
        rows.append(_error_row(case, errors))
        rows.append(_row(case, "error_of_the_space_deg", projection_error_deg(motion, space), "deg"))
    return rows


def _error_row(case: str, errors: list[float]) -> Row:
    return _row(case, "angle_error_mean_deg", float(np.mean(errors)), "deg", None, "Fig. 10: not acceptable in PCA")


def _timings(motion: LegMotion) -> list[Row]:
    """Of one layer: the CPU time of the process (all threads) and the time that passes."""
    devices: list[tuple[str, ParticleWeights, str]] = [("numba", numba_weights, "one core")]
    try:
        opencl = opencl_weights()
        devices.append(("opencl", opencl, opencl.device_name))
    except OpenClUnavailable as error:
        print(f"weights/…/opencl: left out: {error}", file=sys.stderr)
    random = np.random.default_rng(0)
    particles = motion.particles[0] + 0.1 * random.standard_normal((PAPER.particles, motion.particles.shape[1]))
    maps = quadrics(motion.body, particles, motion.carriers[0])
    rows = []
    for count in (POINTS, TEXELS):
        points = np.resize(motion.points(0, random), (count, 3))
        for name, weights, device in devices:
            weigh = _weighed(weights, points, maps)
            weigh()  # compiles
            for metric, clock in (("ms_per_layer", time.perf_counter), ("cpu_ms_per_layer", time.process_time)):
                value = min(_timed(weigh, clock) for _ in range(REPEATS)) * 1e3
                rows.append(_row(f"weights/legs-{count}/{name}", metric, value, "ms", None, device))
    return rows


def _weighed(weights: ParticleWeights, points: np.ndarray, maps: np.ndarray) -> Callable[[], object]:
    expected = np.zeros(maps.shape[1], np.float32)
    return lambda: weights(points, maps, expected)


def _timed(action: Callable[[], object], clock: Callable[[], float]) -> float:
    begun = clock()
    action()
    return clock() - begun
