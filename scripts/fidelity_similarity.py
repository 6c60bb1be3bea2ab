"""Selection by skeleton similarity in place of σ, which DISPOSE §5.1 and §8 say is no substitute."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton import NAMED_JOINT_LINKS, Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.body.skinning import link_motion
from receiver.config import RepositorySettings
from scripts.fidelity_methods import Dispose


def skeleton_distance_m(T_world_link: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Mean distance [m] of the 16 joints of two skeletons' links (L, 4, 4), each seen from its own pelvis."""
    return float(np.linalg.norm(_from_pelvis(T_world_link) - _from_pelvis(other), axis=1).mean())


def _from_pelvis(T_world_link: NDArray[np.floating]) -> NDArray[np.floating]:
    joints = T_world_link[NAMED_JOINT_LINKS, :3, 3] - T_world_link[0, :3, 3]
    return np.asarray(joints @ T_world_link[0, :3, :3])


class Similarity(Dispose):
    """What DISPOSE's sender sends; of that, the mesh whose skeleton is nearest is moved."""

    def __init__(self, rate_bps: float, own: bool) -> None:
        super().__init__(rate_bps, own)
        self._most = RepositorySettings().poses
        self._held: list[tuple[RiggedMesh, NDArray[np.float32]]] = []

    def _animate(self, k: int, fitted: tuple[Skeleton, SkeletonPose, float]) -> None:
        meshes = [pose.mesh for pose in self._arrived]
        self._arrived.clear()
        self._held += [(mesh, forward_kinematics(mesh.skeleton, mesh.pose)) for mesh in meshes]
        del self._held[: -self._most]
        if not self._held:
            return
        T_world_link = forward_kinematics(fitted[0], fitted[1])
        mesh, _ = min(self._held, key=lambda held: skeleton_distance_m(held[1], T_world_link))
        self._show(k, mesh, link_motion(mesh, T_world_link))
