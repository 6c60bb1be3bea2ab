"""Annealed particle filter as Rao & Hodges §5 have it, after Deutscher 2000.

One frame: N particles around the last pose, M layers from the top (M − 1) to 0. A layer weighs its particles, keeps the
heaviest fraction, each survivor the same number of times, and spreads them with less noise than the layer above.
The pose is the weighted mean of layer 0's survivors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Floats = NDArray[np.float64]
Weigh = Callable[[Floats], NDArray[np.float32]]  # particles (P, D) → weights (P,) ≥ 0


@dataclass(frozen=True, slots=True)
class AnnealingSettings:
    """``particles``: N; ``layers``: M; ``survivors``: the fraction that is kept.

    ``smoothing``: β falls by this factor per layer upwards, the weight being w^β (β = 1 at layer 0); it is monotone, so
    it matters to random selection only. ``noise_shrink``: σ falls by this factor per layer downwards.
    ``selection``: the paper's, or Deutscher's draw in proportion to the weights. ``crossover``: share of the particles
    whose degrees of freedom are mixed from two survivors (Deutscher 2001; the paper leaves it out).
    """

    particles: int = 81
    layers: int = 3
    survivors: float = 0.5
    smoothing: float = 0.5
    noise_shrink: float = 0.6
    selection: Literal["deterministic", "random"] = "deterministic"
    crossover: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """What one layer did: ``particles`` (N, D), their unsmoothed ``weights`` (N,), and ``selected`` (N,): the row each
    particle of the next layer comes from, the heaviest survivor first."""

    particles: Floats
    weights: Floats
    selected: Array


@dataclass(frozen=True, slots=True, eq=False)
class Annealed:
    """One frame. ``pose`` (D,): weighted mean of layer 0's survivors. ``layers``: top first."""

    pose: Floats
    layers: tuple[Layer, ...]


def anneal(
    pose: Floats, sigma: Floats, weigh: Weigh, settings: AnnealingSettings, random: np.random.Generator
) -> Annealed:
    """Searches around ``pose`` (D,) [rad, m], or around several (S, D) taken in turn.

    ``sigma`` (D,): standard deviation of the noise at the top layer.
    """
    seeds = np.atleast_2d(pose)
    particles = seeds[np.arange(settings.particles) % len(seeds)]
    particles = particles + sigma * random.standard_normal(particles.shape)
    layers: list[Layer] = []
    for layer in reversed(range(settings.layers)):
        weights = weigh(particles).astype(np.float64)
        selected = select(weights ** (settings.smoothing**layer), settings, random)
        layers.append(Layer(particles, weights, selected))
        if layer > 0:
            sigma = sigma * settings.noise_shrink
            particles = _crossed(particles[selected], settings.crossover, random)
            particles = particles + sigma * random.standard_normal(particles.shape)
    last = layers[-1]
    return Annealed(survivor_mean(last, settings), tuple(layers))


def select(weights: Floats, settings: AnnealingSettings, random: np.random.Generator) -> Array:
    """Rows (N,) of the particles that go on, one per particle of the next layer.

    Deterministic: the ``survivors`` heaviest, heaviest first, each the same number of times; places left over (81 is
    not twice 40) go to the heaviest. Random: N draws in proportion to the weights (evenly where all are 0).
    """
    count = len(weights)
    if settings.selection == "random":
        total = weights.sum()
        share = weights / total if total > 0 else np.full(count, 1 / count)
        return np.asarray(random.choice(count, count, p=share))
    kept = np.argsort(-weights, kind="stable")[: max(int(count * settings.survivors), 1)]
    return np.asarray(kept[np.arange(count) % len(kept)])


def survivor_mean(layer: Layer, settings: AnnealingSettings) -> Floats:
    """Mean (D,) of a layer's selected particles, weighted; with weights all 0 the plain mean."""
    rows = np.unique(layer.selected) if settings.selection == "deterministic" else layer.selected
    weights = layer.weights[rows]
    if weights.sum() <= 0:
        weights = np.ones(len(rows))
    return np.asarray(np.average(layer.particles[rows], axis=0, weights=weights))


def _crossed(particles: Floats, share: float, random: np.random.Generator) -> Floats:
    """``share`` of the particles with each degree of freedom taken from themselves or another, evenly."""
    count = round(share * len(particles))
    if count == 0:
        return particles
    particles = particles.copy()
    rows = random.choice(len(particles), count, replace=False)
    others = random.integers(0, len(particles), count)
    mixed = random.random((count, particles.shape[1])) < 0.5
    particles[rows] = np.where(mixed, particles[rows], particles[others])
    return particles
