"""Ellipsoids as thick and as long as the person is: measured on a cloud whose pose is known.

The link tree knows bones and average radii. A particle filter that counts points needs ellipsoids that hold them, and
one that measures distances needs ellipsoids that lie on the surface, so both start from the cloud of the first pose.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sender.fitting.ellipsoid_body import EllipsoidBody, link_transforms, quadrics

Array = NDArray[Any]
Floats = NDArray[np.float64]

FEWEST_POINTS = 30  # an ellipsoid that gets fewer keeps the sizes it has
# Semi-axes in standard deviations of points spread evenly over a long ellipsoid's surface: 2 along, √(8/3) across.
_LONG, _ACROSS = 2.0, 1.63


def measured(body: EllipsoidBody, points: Array, particle: Floats, T_world_parent: Floats) -> EllipsoidBody:
    """``body`` with centres, directions and semi-axes from ``points`` (N, 3) [m, world] taken at ``particle`` (D,).

    A point belongs to the ellipsoid it is deepest in, or nearest to in the ellipsoid's own measure. The ellipsoid has
    the points' second moments, scaled so that half of the points lie inside: it runs along the surface.
    """
    Q = quadrics(body, particle[None], T_world_parent)[0].astype(np.float64)
    local = np.einsum("eij,nj->eni", Q[:, :, :3], points) + Q[:, None, :, 3]
    owner = np.argmin((local**2).sum(axis=2), axis=0)
    T = link_transforms(body, particle[None], T_world_parent)[0, body.ellipsoid_link]
    centres, directions, axes = body.centres.copy(), body.directions.copy(), body.axes.copy()
    for e in range(len(axes)):
        own = (points[owner == e] - T[e, :, 3]) @ T[e, :, :3]
        if len(own) >= FEWEST_POINTS:
            centres[e], directions[e], axes[e] = _moments(own)
    return replace(body, centres=centres, directions=directions, axes=axes)


def _moments(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Centre, principal directions (columns; the longest second) and semi-axes of surface points (N, 3)."""
    centre = points.mean(axis=0)
    variances, directions = np.linalg.eigh(np.cov(points.T))
    order = [0, 2, 1]
    directions = directions[:, order] * np.array([1.0, 1.0, 1.0 if np.linalg.det(directions[:, order]) > 0 else -1.0])
    axes = np.sqrt(np.maximum(variances[order], 1e-8)) * np.array([_ACROSS, _LONG, _ACROSS])
    inside = (((points - centre) @ directions / axes) ** 2).sum(axis=1)
    return centre, directions, axes * np.sqrt(np.median(inside))
