"""A human surface that moves with a tree of joints: linear blend skinning.

At rest every joint frame is parallel to the world. A pose is one rotation per joint relative to its parent and the
root's position; a point moves as ``v' = sum_k w_k (G_k (v - head_k) + position_k)``, G_k the joint's world rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import NAMED_JOINTS, SIDES
from sender.capture.frame_set import CaptureError

Floats = NDArray[np.float64]
INFLUENCES = 4  # joints that move one point, at most

_CENTRAL_JOINTS = {"pelvis": "Hips", "chest": "Spine1", "neck": "Neck", "head": "Head"}
_SIDE_JOINTS = {
    "shoulder": "Arm",
    "elbow": "ForeArm",
    "wrist": "Hand",
    "hip": "UpLeg",
    "knee": "Leg",
    "ankle": "Foot",
}
BODY_JOINTS = _CENTRAL_JOINTS | {f"{s}_{j}": s.capitalize() + name for s in SIDES for j, name in _SIDE_JOINTS.items()}


@dataclass(frozen=True, slots=True, eq=False)
class PerformerMesh:
    """What does not change while a performer moves (V vertices, split at texture seams; F triangles).

    ``faces`` (F, 3) int32, counter-clockwise seen from outside. ``vertex_colours`` (V, 3) uint8 RGB.
    ``uv`` (V, 2) float32 texture coordinates 0..1, origin top left, or None. ``texture`` (h, w, 3) uint8 RGB or None.
    """

    faces: NDArray[np.int32]
    vertex_colours: NDArray[np.uint8]
    uv: NDArray[np.float32] | None
    texture: NDArray[np.uint8] | None


@dataclass(frozen=True, slots=True, eq=False)
class SkinnedBody:
    """A body at rest (upright A-pose on y = 0, facing +Z, left = +X) and what moves it.

    ``joint_names`` (J,), ``parents`` (J,) int32 (root -1, parents first), ``heads`` and ``tails`` (J, 3) float64
    [m, world]: both ends of the joint's bone at rest. ``points`` (P, 3) float32 [m]: the surface without duplicates;
    ``point_of_vertex`` (V,) int32: which point each mesh vertex is. ``skin_joints`` (P, 4) uint8, ``skin_weights``
    (P, 4) float32, summing to 1.
    """

    name: str
    mesh: PerformerMesh
    joint_names: tuple[str, ...]
    parents: NDArray[np.int32]
    heads: Floats
    tails: Floats
    points: NDArray[np.float32]
    point_of_vertex: NDArray[np.int32]
    skin_joints: NDArray[np.uint8]
    skin_weights: NDArray[np.float32]

    def joint(self, name: str) -> int:
        """Index of a joint along the J axis. Raises CaptureError when the body has no such joint."""
        if name not in self.joint_names:
            raise CaptureError(f"body {self.name} has no joint {name!r}")
        return self.joint_names.index(name)

    def joint_transforms(self, local: Floats, root: Floats) -> Floats:
        """``T_world_joint`` (J, 3, 4) of local rotations (J, 4) [quaternions] and root position (3,) [m]."""
        transforms = np.empty((len(self.parents), 3, 4))
        _joint_transforms(np.ascontiguousarray(local), root, self.parents, self.heads, transforms)
        return transforms

    def surface(self, T_world_joint: Floats) -> NDArray[np.float32]:
        """Mesh vertices (V, 3) float32 [m, world] of posed joints (J, 3, 4)."""
        moved = skin(self, self.points, self.skin_joints, self.skin_weights, T_world_joint)
        return np.take(moved, self.point_of_vertex, axis=0)

    def foot_points(self) -> NDArray[np.int64]:
        """Indices (K,) of the points that the feet and toes move most."""
        feet = [j for j, name in enumerate(self.joint_names) if name.endswith(("Foot", "ToeBase"))]
        strongest = np.take_along_axis(self.skin_joints, self.skin_weights.argmax(1)[:, None], axis=1)[:, 0]
        return np.flatnonzero(np.isin(strongest, feet))

    def lowest_foot(self, local: Floats, root: Floats) -> Floats:
        """Height (F,) [m] of the lowest foot point in F poses: rotations (F, J, 4), root positions (F, 3) [m]."""
        feet = self.foot_points()
        points, joints, weights = self.points[feet], self.skin_joints[feet], self.skin_weights[feet]
        low = [
            skin(self, points, joints, weights, self.joint_transforms(pose, position))[:, 1].min()
            for pose, position in zip(local, root, strict=True)
        ]
        return np.array(low, np.float64)


def skin(
    body: SkinnedBody,
    points: NDArray[np.float32],
    joints: NDArray[np.uint8],
    weights: NDArray[np.float32],
    T_world_joint: Floats,
) -> NDArray[np.float32]:
    """Rest points (P, 3) [m] moved by ``joints`` (P, 4) with ``weights`` (P, 4) to ``T_world_joint`` (J, 3, 4)."""
    motion = T_world_joint.astype(np.float32)
    motion[:, :, 3] -= np.einsum("jab,jb->ja", T_world_joint[:, :, :3], body.heads)
    moved = np.empty_like(points)
    _blend(points, joints, weights, motion, moved)
    return moved


def load_body(path: Path) -> SkinnedBody:
    """Body of an npz file; its texture is ``NAME_texture.jpg`` beside it, vertex colours alone where there is none.

    Raises:
        CaptureError: the file cannot be read or lacks an array.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            data = {key: arrays[key] for key in arrays.files}
    except (OSError, ValueError) as error:
        raise CaptureError(f"cannot read body {path}: {error}") from error
    try:
        return _body(path.stem, data, _texture(path.with_name(path.stem + "_texture.jpg")))
    except KeyError as error:
        raise CaptureError(f"body {path} has no array {error}") from error


def _body(name: str, data: dict[str, NDArray[Any]], texture: NDArray[np.uint8] | None) -> SkinnedBody:
    _, first, point_of_vertex = np.unique(data["weld"], return_index=True, return_inverse=True)
    uv = np.stack([data["uv"][:, 0], 1 - data["uv"][:, 1]], axis=1)  # the file's origin is bottom left
    mesh = PerformerMesh(
        faces=np.ascontiguousarray(data["faces"], np.int32),
        vertex_colours=np.ascontiguousarray(data["colors"], np.uint8),
        uv=None if texture is None else np.ascontiguousarray(uv, np.float32),
        texture=texture,
    )
    return SkinnedBody(
        name=name,
        mesh=mesh,
        joint_names=tuple(str(joint) for joint in data["joint_names"]),
        parents=np.ascontiguousarray(data["joint_parents"], np.int32),
        heads=np.ascontiguousarray(data["joint_heads"], np.float64),
        tails=np.ascontiguousarray(data["joint_tails"], np.float64),
        points=np.ascontiguousarray(data["vertices"][first], np.float32),
        point_of_vertex=point_of_vertex.astype(np.int32),
        skin_joints=np.ascontiguousarray(data["skin_joints"][first], np.uint8),
        skin_weights=np.ascontiguousarray(data["skin_weights"][first], np.float32),
    )


def _texture(path: Path) -> NDArray[np.uint8] | None:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.exists() else None
    return None if image is None else np.ascontiguousarray(image[:, :, ::-1], np.uint8)


def named_joint_indices(body: SkinnedBody) -> NDArray[np.int64]:
    """Joint (16,) of the body that stands at each of ``common.body.skeleton.NAMED_JOINTS``."""
    return np.array([body.joint(BODY_JOINTS[joint]) for joint, _ in NAMED_JOINTS])


@njit(nogil=True, cache=True)
def _joint_transforms(local: Any, root: Any, parents: Any, heads: Any, transforms: Any) -> None:
    rotation = np.empty((3, 3))
    for j in range(parents.shape[0]):
        w, x, y, z = local[j]
        rotation[0, 0], rotation[0, 1], rotation[0, 2] = (
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
        )
        rotation[1, 0], rotation[1, 1], rotation[1, 2] = (
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
        )
        rotation[2, 0], rotation[2, 1], rotation[2, 2] = (
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        )
        p = parents[j]
        for a in range(3):
            if p < 0:
                transforms[j, a, :3] = rotation[a]
                transforms[j, a, 3] = root[a]
                continue
            transforms[j, a, 3] = transforms[p, a, 3]
            for b in range(3):
                transforms[j, a, 3] += transforms[p, a, b] * (heads[j, b] - heads[p, b])
                transforms[j, a, b] = 0.0
                for c in range(3):
                    transforms[j, a, b] += transforms[p, a, c] * rotation[c, b]


@njit(nogil=True, cache=True, fastmath=True)
def _blend(points: Any, joints: Any, weights: Any, motion: Any, moved: Any) -> None:
    for i in range(points.shape[0]):
        x, y, z = points[i]
        sx, sy, sz = np.float32(0), np.float32(0), np.float32(0)
        for k in range(joints.shape[1]):
            m, w = motion[joints[i, k]], weights[i, k]
            sx += w * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3])
            sy += w * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3])
            sz += w * (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3])
        moved[i, 0], moved[i, 1], moved[i, 2] = sx, sy, sz
