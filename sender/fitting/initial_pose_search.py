"""The automatic start from a person who does as they like: hypotheses carried on over frames until one is certain.

Every frame the human template is fitted from a few new starts (headings × typical poses) and from the best fits of the
frames before. Fits that face opposite ways are two sides; each frame adds how much better the better side explains the
cloud, and there is a start when one body explains nearly all of the cloud, nearly all of its own surface is seen, and
the sides are told apart (a sequential test; Wald 1945).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from common.geometry.point_cloud import PointCloud
from sender.fitting.body_template import ROOT, Template, human_template
from sender.fitting.initial_pose import EDGE_M, InitialPose, NoPose, Outline, judged, outline_of
from sender.fitting.start_poses import StartPoses
from sender.fitting.template_fit import SURFACE_M, TemplateFit, fit_template, unfitted

Floats = NDArray[np.float64]

COARSE_POINTS, COARSE_ITERATIONS, COARSE_GATES_M = 300, 9, (0.20, 0.05)
CARRIED_ITERATIONS, CARRIED_GATES_M = 9, (0.12, 0.04)
FINE_POINTS, FINE_ITERATIONS, FINE_GATES_M = 900, 8, (0.06, 0.03)
KEPT = 2  # fits of each side carried to the next frame
MEMORY = 0.9  # of the evidence, per frame


class InitialPoseSearch:
    """``step`` is called with each cloud until it returns a pose."""

    def __init__(self, floor_y: float | None = None) -> None:
        self._floor_y = floor_y
        self._template = human_template()
        self._starts = StartPoses(self._template)
        self._sides: tuple[list[TemplateFit], list[TemplateFit]] = ([], [])
        self._evidence = 0.0  # for the first side
        self.debug = []

    def step(self, cloud: PointCloud, capture_ns: int) -> InitialPose | NoPose:
        points, normals = cloud.positions.astype(np.float64), cloud.normals.astype(np.float64)
        outline = outline_of(points, normals, self._floor_y)
        if isinstance(outline, NoPose):
            return outline
        fits = self._fitted(points, normals, outline)
        self._divide(fits)
        return self._decided(outline, len(cloud))

    def _fitted(self, points, normals, outline):
        template = self._template
        used = np.ones(len(template.cone_links), np.bool_)

        def fits(starts, count, iterations, gates_m):
            step = max(len(points) // count, 1)
            few, few_normals = points[::step], normals[::step]
            out = [fit_template(template, few, few_normals, s, used, outline.floor_y, iterations, gates_m, EDGE_M) for s in starts]
            return sorted(out, key=lambda fit: fit.cost)

        carried = [_rebased(fit) for side in self._sides for fit in side]
        coarse = fits(self._starts.next(outline), COARSE_POINTS, COARSE_ITERATIONS, COARSE_GATES_M)
        coarse += fits(carried, COARSE_POINTS, CARRIED_ITERATIONS, CARRIED_GATES_M)
        coarse.sort(key=lambda fit: fit.cost)
        sides = _by_side(coarse)
        return fits([fit for side in sides for fit in _different(side, KEPT)], FINE_POINTS, FINE_ITERATIONS, FINE_GATES_M)

    def _divide(self, fits):
        first, second = _by_side(fits)
        if self._sides[0] and np.cos(facing(first[0]) - facing(self._sides[0][0])) < 0:
            first, second = second, first
        self._sides = first, second
        if first and second:
            self._evidence = MEMORY * self._evidence + second[0].cost - first[0].cost
        self.debug.append((first[0].cost if first else None, second[0].cost if second else None, self._evidence))

    def _decided(self, outline, count):
        better = self._sides[0] if self._evidence >= 0 else self._sides[1]
        if not better:
            return NoPose('no side')
        self.best = better[0]
        near = (self.best.cone >= 0) & (np.abs(self.best.distance_m) < SURFACE_M)
        self.near = near.mean()
        found = judged(self._template, self.best, outline, count)
        if isinstance(found, NoPose): return found
        self.found = found
        if self.near > 0.8 and self.best.unseen_share < 0.2 and abs(self._evidence) > 25:
            return found
        return NoPose(f'near {near.mean():.2f} unseen {self.best.unseen_share:.2f} evidence {self._evidence:.0f} cost {self.best.cost:.0f}')


def facing(fit: TemplateFit) -> float:
    return fit.heading + float(fit.theta[ROOT + 4])


def _by_side(fits):
    """Fits that face as the best one does, and those that face the other way."""
    out = [], []
    for fit in fits:
        out[int(np.cos(facing(fit) - facing(fits[0])) < 0)].append(fit)
    return out


def _different(fits, count):
    kept = []
    for fit in fits:
        if all(np.abs(fit.theta - other.theta)[ROOT + 3:].max() > 0.3 or abs(np.sin(facing(fit)-facing(other)))>0.4 for other in kept):
            kept.append(fit)
        if len(kept) == count: break
    return kept


def _rebased(fit: TemplateFit) -> TemplateFit:
    theta, prior = fit.theta.copy(), fit.prior.copy()
    heading = facing(fit)
    theta[ROOT + 4] = 0.0
    prior[ROOT : ROOT + 3] = theta[ROOT : ROOT + 3]
    return unfitted(theta, heading, prior)
