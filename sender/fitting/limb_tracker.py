"""Follows legs or an arm with the annealed particle filter: as published (Rao & Hodges), and improved.

The limb's root is known in every frame: the transform of the pelvis for legs, of the clavicle for an arm. The points
are the limb's own: those of the torso or the hand among them pull a polished pose off by degrees. The improved tracker
scores both sides (an ellipsoid without its share of the points costs), takes more particles on fewer points, and brings
the best of them onto the surface by Gauss–Newton, once more and wider where that does not reach it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sender.fitting.annealed_particle_filter import Annealed, AnnealingSettings, anneal
from sender.fitting.ellipsoid_body import EllipsoidBody, link_transforms, quadrics
from sender.fitting.ellipsoid_gauss_newton import Polish, polished
from sender.fitting.ellipsoid_sizes import measured
from sender.fitting.motion_noise import MotionNoise
from sender.fitting.particle_weights import ParticleWeights, claimed_points, numba_weights

Array = NDArray[Any]
Floats = NDArray[np.float64]

COVER = 1.15  # the measured ellipsoids run along the surface; so much larger they hold some 95 % of its points
LONGEST_S = 1.0  # a pause longer than this is searched like one of this length


@dataclass(frozen=True, slots=True)
class LimbSettings:
    """``expected``: of the share of points an ellipsoid held at the start, how much it must hold to cost nothing; 0 =
    the published, one-sided score. ``finalists``: best particles that are polished beside the weighted mean; 0 = the
    weighted mean is the result, as published. ``weighed, polished``: at most about so many points are used."""

    annealing: AnnealingSettings
    expected: float
    finalists: int
    weighed: int
    polished: int


PUBLISHED = LimbSettings(AnnealingSettings(), expected=0.0, finalists=0, weighed=1 << 24, polished=0)
IMPROVED = LimbSettings(AnnealingSettings(particles=200), expected=0.7, finalists=4, weighed=1000, polished=1000)
_COARSE, _FINE, _AS_IT_IS = Polish(steps=5, sigma_m=0.08), Polish(steps=3), Polish(steps=0)
BAD = 1.3  # times the cost at the start: not the pose, so the search is repeated, wider and from both
SECOND_SEARCH = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class LimbFit:
    """``particle`` (D,) [rad, m]; ``T_world_link`` (K, 3, 4) of the limb's links; ``weight``: share of the points
    inside the ellipsoids, 0..1."""

    particle: Floats
    T_world_link: Floats
    weight: float


class LimbTracker:
    """One limb of one person. ``body``: the limb with the sizes of the skeleton; ``start_from`` measures the rest.

    The same seed and the same frames give the same poses.
    """

    def __init__(
        self,
        body: EllipsoidBody,
        noise: MotionNoise,
        settings: LimbSettings,
        seed: int = 0,
        weights: ParticleWeights = numba_weights,
    ) -> None:
        self.body = body
        self._noise = noise
        self._settings = settings
        self._weights = weights
        self._random = np.random.default_rng(seed)
        self._expected = np.zeros(len(body.axes), np.float32)
        self._start_cost = 0.0
        self._particle = np.zeros(body.dof_count)
        self._capture_ns = 0

    def start_from(self, points: Array, particle: Floats, T_world_parent: Floats, capture_ns: int) -> LimbFit:
        """Begins with the pose ``particle`` (D,) and the limb's ``points`` (N, 3) float32 [m, world] in it."""
        self.body = measured(self.body, points, particle, T_world_parent)
        self._particle, self._capture_ns = np.array(particle, np.float64), capture_ns
        Q = quadrics(self.body.scaled(COVER), self._particle[None], T_world_parent)
        held = claimed_points(points, Q)[0] / max(len(points), 1)
        self._expected = (held * self._settings.expected).astype(np.float32)
        _, costs = polished(self.body, points, self._particle[None], T_world_parent, _AS_IT_IS)
        self._start_cost = float(costs[0])
        return self._fit(points, T_world_parent)

    def track(self, points: Array, T_world_parent: Floats, capture_ns: int) -> LimbFit:
        """The limb in ``points`` (N, 3) float32 [m, world], carried by ``T_world_parent`` (4, 4); without points it
        stays as it was."""
        elapsed_s = min(max(capture_ns - self._capture_ns, 0) / 1e9, LONGEST_S)
        self._capture_ns = capture_ns
        if len(points) == 0:
            return self._fit(points, T_world_parent)
        sigma = self._noise.after(elapsed_s)
        if self._settings.finalists == 0:
            self._particle = self._anneal(self._particle, sigma, points, T_world_parent).pose
            return self._fit(points, T_world_parent)
        best, cost = self._finalist(self._particle, sigma, points, T_world_parent)
        if cost > BAD * self._start_cost:
            seeds = np.stack([self._particle, best])
            again, cost_again = self._finalist(seeds, SECOND_SEARCH * sigma, points, T_world_parent)
            best = again if cost_again < cost else best
        self._particle = best
        return self._fit(points, T_world_parent)

    def _anneal(self, seeds: Floats, sigma: Floats, points: Array, T_world_parent: Floats) -> Annealed:
        covering, weighed = self.body.scaled(COVER), _at_most(points, self._settings.weighed)

        def weigh(particles: Floats) -> NDArray[np.float32]:
            return self._weights(weighed, quadrics(covering, particles, T_world_parent), self._expected)

        return anneal(seeds, sigma, weigh, self._settings.annealing, self._random)

    def _finalist(self, seeds: Floats, sigma: Floats, points: Array, T_world_parent: Floats) -> tuple[Floats, float]:
        """The best polished pose of one search, and its cost."""
        found = self._anneal(seeds, sigma, points, T_world_parent)
        last = found.layers[-1]
        heaviest = last.particles[np.argsort(-last.weights, kind="stable")[: self._settings.finalists]]
        fine = _at_most(points, self._settings.polished)
        coarse = _at_most(fine, len(fine) // 2)
        finalists, costs = polished(
            self.body, coarse, np.concatenate([found.pose[None], heaviest]), T_world_parent, _COARSE
        )
        best, cost = polished(self.body, fine, finalists[[costs.argmin()]], T_world_parent, _FINE)
        return best[0], float(cost[0])

    def _fit(self, points: Array, T_world_parent: Floats) -> LimbFit:
        particle = self._particle[None]
        claimed = claimed_points(points, quadrics(self.body.scaled(COVER), particle, T_world_parent))
        weight = float(claimed.sum() / max(len(points), 1))
        return LimbFit(self._particle.copy(), link_transforms(self.body, particle, T_world_parent)[0], weight)


def _at_most(points: Array, count: int) -> Array:
    """Every k-th point, so that at most ``count`` are left."""
    step = -(-len(points) // max(count, 1))
    return np.ascontiguousarray(points[:: max(step, 1)])
