"""Points on the ellipsoids of a known pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sender.fitting.ellipsoid_body import EllipsoidBody, quadrics


def surface_cloud(
    body: EllipsoidBody,
    particle: NDArray[np.float64],
    T_world_parent: NDArray[np.float64],
    per_ellipsoid: int,
    seed: int = 0,
    only: int | None = None,
) -> NDArray[np.float32]:
    """Points (E · n, 3) [m, world] on every ellipsoid (or ``only`` one) at ``particle`` (D,); those inside another
    ellipsoid are left out, as on a person."""
    random = np.random.default_rng(seed)
    Q = quadrics(body, particle[None], T_world_parent)[0].astype(np.float64)
    clouds = []
    for e in range(len(Q)) if only is None else [only]:
        ball = random.standard_normal((per_ellipsoid * 20, 3)) * body.axes[e] ** -0.5  # more evenly along the bone
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        points = np.linalg.solve(Q[e, :, :3], (ball - Q[e, :, 3]).T).T
        others = np.delete(Q, e, axis=0)
        inside = np.einsum("eij,nj->eni", others[:, :, :3], points) + others[:, None, :, 3]
        clouds.append(points[((inside**2).sum(axis=2) > 1).all(axis=0)][:per_ellipsoid])
    return np.concatenate(clouds).astype(np.float32)
