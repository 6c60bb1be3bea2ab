"""Iterative closest points for one link (Lien 2009 Alg. 4.1), turning about its joint (§5.1.2).

A link's points look for partners in the clusters of their normal and colour at the start, the same in every
iteration, so the error never rises (Theorem 5.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sender.fitting.clustered_kdtree import STACK, ClusteredKdTree, nearest, normal_cells, squared_distance

Array = NDArray[Any]

LEAST_PAIRS = 4  # three define a motion; with no more than that it fits any three points


@dataclass(frozen=True, slots=True)
class IcpStop:
    """When ICP ends. ``tau_m``: once the RMS distance of the pairs [m] (the root of Eq. 1 ÷ n) is below it, or an
    iteration has lowered it by less than ``stall_m``: a local minimum."""

    tau_m: float = 0.002
    stall_m: float = 0.0001
    iterations: int = 30


@dataclass(frozen=True, slots=True, eq=False)
class LinkFit:
    """``rotation`` (3, 3) and ``shift`` (3,) [m]: the motion T found, p ↦ rotation · p + shift, in the world.
    ``errors`` (I,) [m²]: Eq. 1 ÷ n before each iteration's motion. ``pairs``: points with a partner."""

    rotation: Array
    shift: Array
    errors: Array
    pairs: int


def fit_link(
    points: Array, normals: Array, colours: Array, joint: Array | None, tree: ClusteredKdTree, stop: IcpStop
) -> LinkFit:
    """The motion that brings a link onto a cloud.

    ``points`` (M, 3) [m, world], ``normals`` (M, 3), ``colours`` (M,) int64 cells (``colour_cells``): the link, where
    it is now. ``joint`` (3,) [m, world]: what it turns about; None: it is free.
    """
    cells = normal_cells(normals, tree.latitudes, tree.longitudes) * tree.colour_cells + colours
    anchor = np.zeros(3) if joint is None else joint
    return LinkFit(
        *_iterate(points, cells, anchor, joint is not None, tree, stop.tau_m**2, stop.stall_m, stop.iterations)
    )


def partner_distances(points: Array, normals: Array, colours: Array, tree: ClusteredKdTree, within_m: float) -> Array:
    """Distances (M,) [m] to the points' partners; infinity where none is ``within_m``. The rest as for ``fit_link``."""
    cells = normal_cells(normals, tree.latitudes, tree.longitudes) * tree.colour_cells + colours
    return np.asarray(_distances(points, cells, tree, within_m))


@njit(nogil=True, cache=True, error_model="numpy")
def _distances(points: Array, cells: Array, tree: ClusteredKdTree, within_m: float) -> Array:
    distances = np.full(len(points), np.inf)
    stack, bounds = np.empty((STACK, 2), np.int64), np.empty(STACK)
    for m in range(len(points)):
        row, squared = nearest(tree, cells[m], points[m], -1, within_m**2, stack, bounds)
        if row >= 0:
            distances[m] = np.sqrt(squared)
    return distances


@njit(nogil=True, cache=True, error_model="numpy")
def _iterate(points, cells, joint, anchored, tree, tau_squared, stall_m, iterations):  # type: ignore[no-untyped-def]
    rotation, shift = np.eye(3), np.zeros(3)
    moved, partner = points.copy(), np.full(len(points), -1)
    errors = np.empty(iterations)
    stack, bounds = np.empty((STACK, 2), np.int64), np.empty(STACK)
    used, pairs = 0, 0
    for iteration in range(iterations):
        total, pairs = 0.0, 0
        for m in range(len(moved)):
            known = partner[m]
            squared = squared_distance(tree.points, known, moved[m]) if known >= 0 else np.inf
            partner[m], squared = nearest(tree, cells[m], moved[m], known, squared, stack, bounds)
            if partner[m] >= 0:
                total += squared
                pairs += 1
        if pairs < LEAST_PAIRS:
            break
        errors[iteration] = total / pairs
        used = iteration + 1
        stalled = iteration > 0 and np.sqrt(errors[iteration - 1]) - np.sqrt(errors[iteration]) < stall_m
        if errors[iteration] < tau_squared or stalled:
            break
        turn, move = best_motion(moved, tree.points, partner, joint, anchored)
        rotation, shift = turn @ rotation, turn @ shift + move
        for m in range(len(moved)):
            for i in range(3):
                moved[m, i] = shift[i]
                for j in range(3):
                    moved[m, i] += rotation[i, j] * points[m, j]
    return rotation, shift, errors[:used], pairs


@njit(nogil=True, cache=True, error_model="numpy")
def best_motion(points: Array, cloud: Array, partner: Array, joint: Array, anchored: bool) -> tuple[Array, Array]:
    """Rotation (3, 3) and shift (3,) [m] that minimise Eq. 1 over the pairs ``points[m]``, ``cloud[partner[m]]``
    (partner -1: none), by the cross-covariance of Eq. 2. ``anchored``: both centres are the ``joint`` (§5.1.2)."""
    centre, goal = joint.copy(), joint.copy()
    if not anchored:
        centre[:], goal[:] = 0.0, 0.0
        pairs = 0
        for m in range(len(points)):
            if partner[m] >= 0:
                centre += points[m]
                goal += cloud[partner[m]]
                pairs += 1
        centre /= pairs
        goal /= pairs
    covariance = np.zeros((3, 3))
    for m in range(len(points)):
        if partner[m] >= 0:
            for i in range(3):
                for j in range(3):
                    covariance[i, j] += (cloud[partner[m], i] - goal[i]) * (points[m, j] - centre[j])
    u, _, v = np.linalg.svd(covariance)
    if np.linalg.det(u) * np.linalg.det(v) < 0:
        u[:, 2] = -u[:, 2]
    rotation = u @ v
    return rotation, goal - rotation @ centre
