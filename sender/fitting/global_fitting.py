"""Global fitting (Lien 2009 §5.1.4): the links whose points do not look like themselves are fitted once more, to the
points that no well-fitted link claims."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, Skeleton
from common.geometry.point_cloud import PointCloud
from sender.fitting.articp import LinkPoints, LinkState, articp, carriers_of
from sender.fitting.clustered_kdtree import ClusterBins, build_clustered_tree
from sender.fitting.link_icp import IcpStop

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class GlobalFitting:
    """``acceptable``: global error of a link (Eq. 4, as a share of μ(P_l)) up to which it is in S⁺. ``rounds``: ARTICP
    runs on S⁻ and Q⁻ at most."""

    acceptable: float = 0.5
    rounds: int = 4


@dataclass(frozen=True, slots=True, eq=False)
class GlobalFit:
    """``errors`` (L,): global error of each link, 0 for those without points. ``links`` (N,): the segmentation of the
    cloud that they come from. ``iterations``: ICP iterations spent."""

    state: LinkState
    errors: Array
    links: Array
    iterations: int


@dataclass(frozen=True, slots=True, eq=False)
class LinkMoments:
    """``centres`` (L, 3) [m, link frame]: of P_l. ``moments`` (L, 3, 3) [m²]: second moments about them."""

    centres: Array
    moments: Array


def link_moments(model: LinkPoints) -> LinkMoments:
    """μ(P_l) of every link."""
    centres = np.zeros((LINK_COUNT, 3))
    for link in range(LINK_COUNT):
        P_l = model.points[model.rows(link)]
        if len(P_l):
            centres[link] = P_l.mean(axis=0)
    links = np.repeat(np.arange(LINK_COUNT), np.diff(model.first))
    at_rest = LinkState(np.tile(np.eye(3), (LINK_COUNT, 1, 1)), np.zeros((LINK_COUNT, 3)))
    return LinkMoments(centres, second_moments(model.points, links, at_rest, centres))


def global_errors(moments: LinkMoments, positions: Array, links: Array, state: LinkState) -> Array:
    """|μ(P_l) − μ(Q_l)| ÷ |μ(P_l)| (Eq. 4) of each link (L,), 0 for those without points; Q_l: ``positions`` (N, 3)
    [m, world] of ``links`` (N,), seen from the link in the pose ``state``."""
    seen = second_moments(positions.astype(np.float64), links, state, moments.centres)
    size = np.linalg.norm(moments.moments, axis=(1, 2))
    away = np.linalg.norm(moments.moments - seen, axis=(1, 2))
    return np.where(size > 0, away / np.maximum(size, 1e-12), 0.0)


def fit_globally(
    model: LinkPoints, moments: LinkMoments, skeleton: Skeleton, cloud: PointCloud, state: LinkState,
    bins: ClusterBins, stop: IcpStop, jointed: bool, settings: GlobalFitting,
) -> GlobalFit:  # fmt: skip
    """Fits the links in S⁻ to the points in Q⁻ again and again, until all are acceptable or nothing improves.

    ``moments``: of the whole initial cloud. ``state``: what ARTICP found for ``cloud``; the pose returned has no larger
    sum of global errors. The other arguments are those of ``articp`` and ``build_clustered_tree``.
    """
    fit = _judged(moments, skeleton, cloud, state, 0)
    for _ in range(settings.rounds):
        wrong = fit.errors > settings.acceptable  # S⁻
        left = wrong[fit.links]  # Q⁻
        if not left.any():
            break
        Q = PointCloud(cloud.positions[left], cloud.normals[left], cloud.colours[left])
        tried, iterations = articp(model, fit.state, build_clustered_tree(Q, bins), wrong, stop, jointed)
        again = _judged(moments, skeleton, cloud, tried, fit.iterations + iterations)
        if again.errors.sum() >= fit.errors.sum():
            break
        fit = again
    return fit


def _judged(
    moments: LinkMoments, skeleton: Skeleton, cloud: PointCloud, state: LinkState, iterations: int
) -> GlobalFit:
    links = carriers_of(cloud.positions, skeleton, state)
    return GlobalFit(state, global_errors(moments, cloud.positions, links, state), links, iterations)


def second_moments(points: Array, links: Array, state: LinkState, centres: Array) -> Array:
    """Second moments (L, 3, 3) [m²] of each link's ``points`` (N, 3) [m, world], x xᵗ with x from the link's centre
    (L, 3) [m, link frame]. The sum is divided by the number of all links' points: a link that has lost half its points
    has half the moment."""
    return np.asarray(_second_moments(points, links, state.rotations, state.joints, centres))


@njit(nogil=True, cache=True, error_model="numpy")
def _second_moments(points, links, rotations, joints, centres):  # type: ignore[no-untyped-def]
    moments, x = np.zeros((len(joints), 3, 3)), np.empty(3)
    for n in range(len(points)):
        link = links[n]
        for i in range(3):
            x[i] = -centres[link, i]
            for k in range(3):
                x[i] += rotations[link, k, i] * (points[n, k] - joints[link, k])
        for i in range(3):
            for j in range(3):
                moments[link, i, j] += x[i] * x[j]
    return moments / max(len(points), 1)
