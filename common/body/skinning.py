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
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        out[v, 0], out[v, 1], out[v, 2] = _moved(motion, vertex_link[v], x, y, z)
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _linear(vertices, vertex_link, other, share, motion):  # type: ignore[no-untyped-def]
    out = np.empty_like(vertices)
    for v in range(len(vertices)):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        px, py, pz = _moved(motion, vertex_link[v], x, y, z)
        if share[v]:
            qx, qy, qz = _moved(motion, other[v], x, y, z)
            b = np.float32(share[v]) / np.float32(255.0)
            px, py, pz = px + b * (qx - px), py + b * (qy - py), pz + b * (qz - pz)
        out[v, 0], out[v, 1], out[v, 2] = px, py, pz
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _spherical(vertices, vertex_link, other, share, joint, motion, turns, joints):  # type: ignore[no-untyped-def]
    """QLERP of both links' quaternions (w, x, y, z) about the joint, whose own place is mixed linearly."""
    out = np.empty_like(vertices)
    for v in range(len(vertices)):
        m, n, j = vertex_link[v], other[v], joint[v]
        if share[v] == 0:
            x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
            out[v, 0], out[v, 1], out[v, 2] = _moved(motion, m, x, y, z)
            continue
        b = np.float32(share[v]) / np.float32(255.0)
        alike = turns[m, 0] * turns[n, 0] + turns[m, 1] * turns[n, 1]
        alike += turns[m, 2] * turns[n, 2] + turns[m, 3] * turns[n, 3]
        a, c = np.float32(1.0) - b, b if alike >= 0 else -b
        w, x = a * turns[m, 0] + c * turns[n, 0], a * turns[m, 1] + c * turns[n, 1]
        y, z = a * turns[m, 2] + c * turns[n, 2], a * turns[m, 3] + c * turns[n, 3]
        s = np.float32(2.0) / (w * w + x * x + y * y + z * z)
        jx, jy, jz = joints[j, 0], joints[j, 1], joints[j, 2]
        ax, ay, az = vertices[v, 0] - jx, vertices[v, 1] - jy, vertices[v, 2] - jz
        px, py, pz = _moved(motion, m, jx, jy, jz)
        qx, qy, qz = _moved(motion, n, jx, jy, jz)
        # v + 2/|q|² · u × (u × v + w v), u = (x, y, z)
        tx, ty, tz = y * az - z * ay + w * ax, z * ax - x * az + w * ay, x * ay - y * ax + w * az
        out[v, 0] = px + b * (qx - px) + ax + s * (y * tz - z * ty)
        out[v, 1] = py + b * (qy - py) + ay + s * (z * tx - x * tz)
        out[v, 2] = pz + b * (qz - pz) + az + s * (x * ty - y * tx)
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _moved(motion, link, x, y, z):  # type: ignore[no-untyped-def]
    """A point moved with its link."""
    return (
        motion[link, 0, 0] * x + motion[link, 0, 1] * y + motion[link, 0, 2] * z + motion[link, 0, 3],
        motion[link, 1, 0] * x + motion[link, 1, 1] * y + motion[link, 1, 2] * z + motion[link, 1, 3],
        motion[link, 2, 0] * x + motion[link, 2, 1] * y + motion[link, 2, 2] * z + motion[link, 2, 3],
    )
