"""ARTICP (Lien 2009 Alg. 5.1): ICP link by link from the torso outwards, each motion taken on by all descendants."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.link_segmentation import nearest_link
from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_PARENTS, SIDES, Skeleton
from common.geometry.point_cloud import PointCloud
from sender.fitting.clustered_kdtree import ClusterBins, ClusteredKdTree, colour_cells
from sender.fitting.link_icp import IcpStop, fit_link

Array = NDArray[Any]

# Links without a motion of their own, and the link that carries their points: the torso is one rigid link in the paper
# (§5.1.1), and what has too few points of its own cannot be fitted alone.
_CARRIED = {"lower_spine": "pelvis", "upper_spine": "pelvis", "head": "neck"} | {
    f"{side}_{part}": carrier
    for side in SIDES
    for part, carrier in (
        ("clavicle", "pelvis"), ("hand", f"{side}_forearm"), ("fingers", f"{side}_forearm"), ("toes", f"{side}_foot"),
    )
}  # fmt: skip


def _carriers() -> Array:
    return np.array([LINK_INDEX[_CARRIED.get(name, name)] for name in LINK_INDEX])


def _descendants() -> Array:
    """(L, L) bool: [l, d] = d is l or comes after it in the tree."""
    below = np.eye(LINK_COUNT, dtype=bool)
    for link in range(LINK_COUNT - 1, 0, -1):
        below[LINK_PARENTS[link]] |= below[link]
    return below


CARRIER = _carriers()
DESCENDANTS = _descendants()
CHILDREN = [[link for link, parent in enumerate(LINK_PARENTS) if parent == above] for above in range(LINK_COUNT)]


@dataclass(frozen=True, slots=True, eq=False)
class LinkState:
    """Where the links are: ``rotations`` (L, 3, 3) float64 and ``joints`` (L, 3) float64 [m], both in the world."""

    rotations: Array
    joints: Array


@dataclass(frozen=True, slots=True, eq=False)
class LinkPoints:
    """P_S: the initial cloud's points by link (§5.1.1), in the frame of the link that carries them. ``points`` (M, 3)
    float64 [m], ``normals`` (M, 3), ``colours`` (M,) int64 cells; rows ``first[l]`` to ``first[l + 1]`` are P_l."""

    points: Array
    normals: Array
    colours: Array
    first: Array

    def rows(self, link: int) -> slice:
        """Where P_l is."""
        return slice(self.first[link], self.first[link + 1])

    def posed(self, state: LinkState) -> tuple[Array, Array]:
        """All points (M, 3) [m, world] and normals (M, 3) in a pose."""
        links = np.repeat(np.arange(LINK_COUNT), np.diff(self.first))
        R = state.rotations[links]
        points = np.einsum("nij,nj->ni", R, self.points) + state.joints[links]
        return points, np.einsum("nij,nj->ni", R, self.normals)


def carriers_of(positions: Array, skeleton: Skeleton, state: LinkState) -> Array:
    """Segmentation F_e (§5.1.1, §5.1.4): the link (N,) whose point each of ``positions`` (N, 3) float32 [m] is."""
    T_world_link = np.zeros((LINK_COUNT, 4, 4), np.float32)
    T_world_link[:, :3, :3], T_world_link[:, :3, 3] = state.rotations, state.joints
    return np.asarray(CARRIER[nearest_link(positions, skeleton, T_world_link)])


def segmented(cloud: PointCloud, skeleton: Skeleton, state: LinkState, bins: ClusterBins) -> LinkPoints:
    """The cloud as the points P_l of a skeleton in its pose ``state``."""
    link = carriers_of(cloud.positions, skeleton, state)
    order = np.argsort(link, kind="stable")
    link = link[order]
    R = state.rotations[link]
    return LinkPoints(
        np.einsum("nji,nj->ni", R, cloud.positions[order] - state.joints[link]),
        np.einsum("nji,nj->ni", R, cloud.normals[order].astype(np.float64)),
        colour_cells(cloud.colours, bins)[order],
        np.concatenate([[0], np.cumsum(np.bincount(link, minlength=LINK_COUNT))]),
    )


def articp(
    model: LinkPoints, state: LinkState, tree: ClusteredKdTree, links: Array, stop: IcpStop, jointed: bool
) -> tuple[LinkState, int]:
    """Fits the ``links`` (L,) bool of a model in the pose ``state`` to the cloud of ``tree``; the pose found, and the
    ICP iterations spent. ``jointed``: every link but the root only turns about its joint; otherwise all move freely
    and come apart."""
    rotations, joints = state.rotations.copy(), state.joints.copy()
    iterations = 0
    queue = deque([0])
    while queue:
        link = queue.popleft()
        if links[link]:
            P_l, R = model.rows(link), rotations[link]
            joint = joints[link] if jointed and link > 0 else None
            T = fit_link(model.points[P_l] @ R.T + joints[link], model.normals[P_l] @ R.T, model.colours[P_l], joint,
                         tree, stop)  # fmt: skip
            moved = DESCENDANTS[link]
            rotations[moved] = T.rotation @ rotations[moved]
            joints[moved] = joints[moved] @ T.rotation.T + T.shift
            iterations += len(T.errors)
        queue.extend(CHILDREN[link])
    return LinkState(rotations, joints), iterations
