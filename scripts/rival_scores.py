"""Scores that DISPOSE rejects, to compare σ with: the holistic one (Fig. 3) and the dihedral angle (§8)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.body.rigged_mesh import RiggedMesh


def holistic_score(mesh: RiggedMesh, vertices: NDArray[np.floating]) -> float:
    """The change of all edges of a moved mesh over their length, whatever region: few bad edges go unnoticed (§5.2).

    ``vertices`` (V, 3) [m]: where ``animate`` moves the mesh's. An edge counts once for each triangle it bounds.
    """
    before, after = (_edge_lengths(points, mesh.mesh.faces) for points in (mesh.mesh.vertices, vertices))
    return float(np.abs(after - before).sum() / before.sum())


class DihedralScore:
    """How far the angle between neighbouring triangles turns when a mesh is moved: its mean over all edges [rad]."""

    def __init__(self, mesh: RiggedMesh) -> None:
        faces = mesh.mesh.faces
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        keys = edges[:, 0].astype(np.int64) * len(mesh.mesh.vertices) + edges[:, 1]
        order = np.argsort(keys, kind="stable")
        first = np.flatnonzero(keys[order][1:] == keys[order][:-1])
        self._faces = faces
        self._pairs = np.stack([order[first], order[first + 1]], axis=1) % len(faces)
        self._before = self._angles(mesh.mesh.vertices)

    def __call__(self, vertices: NDArray[np.floating]) -> float:
        """Of the mesh's vertices (V, 3) [m] as moved."""
        return float(np.abs(self._angles(vertices) - self._before).mean())

    def _angles(self, vertices: NDArray[np.floating]) -> NDArray[np.float64]:
        a, b, c = (vertices[self._faces[:, n]].astype(np.float64) for n in range(3))
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        cosine = np.einsum("ij,ij->i", normals[self._pairs[:, 0]], normals[self._pairs[:, 1]])
        return np.asarray(np.arccos(np.clip(cosine, -1, 1)))


def _edge_lengths(vertices: NDArray[np.floating], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    corners = vertices[faces].astype(np.float64)
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2))
