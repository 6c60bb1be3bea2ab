"""DISPOSE §5.1, A(M, S_in, S_out): a captured mesh moved to another skeleton, each link's vertices rigidly."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.rigged_mesh import RiggedMesh


def link_motion(mesh: RiggedMesh, T_world_link: NDArray[np.float32]) -> NDArray[np.float32]:
    """How each link moved since the capture, (L, 3, 4) float32: ``T_world_link(out) · T_link_world(in)``.

    ``T_world_link`` (L, 4, 4) [m]: the skeleton to show. Applied to world points at capture it gives world points.
    """
    motion = T_world_link.astype(np.float64) @ mesh.T_link_world
    return np.ascontiguousarray(motion[:, :3], np.float32)


def animate_rigid(mesh: RiggedMesh, motion: NDArray[np.float32]) -> NDArray[np.float32]:
    """Vertices (V, 3) float32 [m, world] moved by their link's ``motion`` (L, 3, 4)."""
    return _move(mesh.mesh.vertices, mesh.vertex_link, motion)


@njit(nogil=True, cache=True, error_model="numpy")
def _move(vertices, vertex_link, motion):  # type: ignore[no-untyped-def]
    out = np.empty_like(vertices)
    for v in range(len(vertices)):
        m = motion[vertex_link[v]]
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        out[v, 0] = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
        out[v, 1] = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
        out[v, 2] = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    return out
