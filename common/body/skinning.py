"""DISPOSE §5.1, A(M, S_in, S_out): a captured mesh moved to another skeleton.

Rigid: each segment moves with its link, as σ assumes. Linear blend (LBS): near a joint the two links' motions are
mixed as matrices, which shrinks the joint. Spherical blend (Kavan and Žára 2005): their rotations are mixed as
quaternions, about the joint between them, which keeps the volume.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.rigged_mesh import RiggedMesh
from common.body.vertex_blend import VertexBlend
from common.geometry import quaternion

Skinning = Literal["rigid", "linear", "spherical"]


def link_motion(mesh: RiggedMesh, T_world_link: NDArray[np.float32]) -> NDArray[np.float32]:
    """How each link moved since the capture, (L, 3, 4) float32: ``T_world_link(out) · T_link_world(in)``.

    ``T_world_link`` (L, 4, 4) [m]: the skeleton to show. Applied to world points at capture it gives world points.
    """
    motion = T_world_link.astype(np.float64) @ mesh.T_link_world
    return np.ascontiguousarray(motion[:, :3], np.float32)


def captured_joints(mesh: RiggedMesh) -> NDArray[np.float32]:
    """Joints (L, 3) float32 [m, world] of the skeleton the mesh was captured with."""
    R = mesh.T_link_world[:, :3, :3]
    return np.ascontiguousarray(-np.einsum("lji,lj->li", R, mesh.T_link_world[:, :3, 3]), np.float32)


def animate(mesh: RiggedMesh, motion: NDArray[np.float32], skinning: Skinning = "spherical") -> NDArray[np.float32]:
    """Vertices (V, 3) float32 [m, world] at the links' ``motion`` (L, 3, 4)."""
    return move(mesh.mesh.vertices, mesh.vertex_link, mesh.blend, captured_joints(mesh), motion, skinning)


def move(
    vertices: NDArray[np.float32],
    vertex_link: NDArray[np.uint8],
    blend: VertexBlend,
    joints: NDArray[np.float32],
    motion: NDArray[np.float32],
    skinning: Skinning,
) -> NDArray[np.float32]:
    """``animate`` of a mesh's parts: ``vertices`` (V, 3) and ``joints`` (L, 3) [m, world] are those at capture."""
    if skinning == "rigid":
        return _move(vertices, vertex_link, motion)
    if skinning == "linear":
        return _linear(vertices, vertex_link, blend.other, blend.share, motion)
    turns = quaternion.from_matrix(motion[:, :, :3].astype(np.float64)).astype(np.float32)
    return _spherical(vertices, vertex_link, blend.other, blend.share, blend.joint, motion, turns, joints)


@njit(nogil=True, cache=True, error_model="numpy")
def _move(vertices, vertex_link, motion):  # type: ignore[no-untyped-def]
    out = np.empty_like(vertices)
    for v in range(len(vertices)):
        _apply(motion[vertex_link[v]], vertices[v], out[v])
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _linear(vertices, vertex_link, other, share, motion):  # type: ignore[no-untyped-def]
    out, second = np.empty_like(vertices), np.empty(3, np.float32)
    for v in range(len(vertices)):
        _apply(motion[vertex_link[v]], vertices[v], out[v])
        if share[v]:
            _apply(motion[other[v]], vertices[v], second)
            b = np.float32(share[v] / 255.0)
            for i in range(3):
                out[v, i] += b * (second[i] - out[v, i])
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _spherical(vertices, vertex_link, other, share, joint, motion, turns, joints):  # type: ignore[no-untyped-def]
    """QLERP of both links' quaternions (w, x, y, z) about the joint, whose own place is mixed linearly."""
    out, second = np.empty_like(vertices), np.empty(3, np.float32)
    arm, centre = np.empty(3, np.float32), np.empty(3, np.float32)
    for v in range(len(vertices)):
        if share[v] == 0:
            _apply(motion[vertex_link[v]], vertices[v], out[v])
            continue
        p, q, b = turns[vertex_link[v]], turns[other[v]], np.float32(share[v] / 255.0)
        c = b if p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3] >= 0 else -b
        w, x = (1 - b) * p[0] + c * q[0], (1 - b) * p[1] + c * q[1]
        y, z = (1 - b) * p[2] + c * q[2], (1 - b) * p[3] + c * q[3]
        s = 2 / (w * w + x * x + y * y + z * z)
        _apply(motion[vertex_link[v]], joints[joint[v]], centre)
        _apply(motion[other[v]], joints[joint[v]], second)
        for i in range(3):
            arm[i] = vertices[v, i] - joints[joint[v], i]
            centre[i] += b * (second[i] - centre[i])
        # v + 2/|q|² · u × (u × v + w v), u = (x, y, z)
        tx = y * arm[2] - z * arm[1] + w * arm[0]
        ty = z * arm[0] - x * arm[2] + w * arm[1]
        tz = x * arm[1] - y * arm[0] + w * arm[2]
        out[v, 0] = centre[0] + arm[0] + s * (y * tz - z * ty)
        out[v, 1] = centre[1] + arm[1] + s * (z * tx - x * tz)
        out[v, 2] = centre[2] + arm[2] + s * (x * ty - y * tx)
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _apply(m, point, out):  # type: ignore[no-untyped-def]
    x, y, z = point[0], point[1], point[2]
    out[0] = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
    out[1] = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
    out[2] = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
