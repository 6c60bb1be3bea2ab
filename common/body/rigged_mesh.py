"""DISPOSE's pose p = {M, S}: a captured mesh, the skeleton it was captured with, and the edges that joins deform.

Sender and receiver build it with this code from the same decoded views and the same decoded skeleton.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.body_regions import ScoreForm
from common.body.depth_mesher import mesh_view
from common.body.joint_edges import JointEdges, joint_edges
from common.body.link_segmentation import nearest_link
from common.body.region_growing import grown_regions
from common.body.rigging import DEFAULT_RIGGING, Rigging
from common.body.skeleton import LINK_COUNT, LINK_PARENTS, Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.body.vertex_blend import VertexBlend, vertex_blend
from common.body.vertex_regions import vertex_regions
from common.body.view import View
from common.body.zipper import zippered
from common.geometry.rigid_transform import inverse
from common.geometry.triangle_mesh import TriangleMesh

MESH_STRIDE = 2  # pixels from vertex to vertex: a quarter of the triangles, and the texture keeps every pixel's colour

# Triangles that count in σ but are not drawn: longer edges bridge an occlusion and hang like a skirt; links further
# apart in the tree only touch (a hand at the thigh), and a web spans between them when they part.
DRAWN_EDGE_M = 0.06
DRAWN_LINK_STEPS = 2


def _link_steps() -> NDArray[np.int64]:
    """Steps between any two links in the tree (L, L)."""
    steps = np.full((LINK_COUNT, LINK_COUNT), LINK_COUNT)
    np.fill_diagonal(steps, 0)
    for link, parent in enumerate(LINK_PARENTS[1:], start=1):  # parents come first: their rows are complete
        steps[link, :link] = steps[:link, link] = steps[parent, :link] + 1
    return steps


_LINK_STEPS = _link_steps()


@dataclass(frozen=True, slots=True, eq=False)
class RiggedMesh:
    """A captured person, ready to be moved.

    ``T_link_world`` (L, 4, 4) float64: world at capture → link frames. ``vertex_link`` (V,) uint8: its segment, which
    σ goes by; ``blend``: its neighbour's part, for skinning.
    ``mesh.faces`` holds every triangle; ``faces_drawn`` (F', 3) int32 are its first F', whose edges were at most 6 cm
    at capture and join links at most two steps apart. Views are one surface in it (zippered), but for what they paint:
    along a seam, places have a vertex for each view. Or they stay separate surfaces.
    """

    pose_id: int
    capture_ns: int
    skeleton: Skeleton
    pose: SkeletonPose
    T_link_world: NDArray[np.float64]
    mesh: TriangleMesh
    vertex_link: NDArray[np.uint8]
    blend: VertexBlend
    faces_drawn: NDArray[np.int32]
    joint_edges: JointEdges

    @property
    def nbytes(self) -> int:
        """Memory of the arrays [bytes]."""
        edges = self.joint_edges
        arrays = (
            self.mesh.vertices,
            self.mesh.faces,
            self.mesh.uv,
            self.mesh.texture,
            self.vertex_link,
            self.blend.other,
            self.blend.share,
            self.blend.joint,
            edges.vertices,
            edges.points,
        )
        return sum(a.nbytes for a in arrays)


def build_rigged_mesh(
    pose_id: int,
    capture_ns: int,
    skeleton: Skeleton,
    pose: SkeletonPose,
    views: Sequence[View],
    rigging: Rigging = DEFAULT_RIGGING,
    score_form: ScoreForm = "joining-edges",
) -> RiggedMesh:
    """Mesh all views of one instant and rig them to the skeleton of that instant: how, both ends must agree on
    (``rigging``); ``score_form`` of σ is each end's own.

    Raises:
        ValueError: the views hold no triangle that can be drawn.
    """
    if not views:
        raise ValueError(f"pose {pose_id}: no views")
    meshes = [mesh_view(view, MESH_STRIDE) for view in views]
    mesh = merged(meshes)
    if len(mesh.faces) == 0:
        raise ValueError(f"pose {pose_id}: its {len(views)} views hold no surface")
    T_world_link = forward_kinematics(skeleton, pose)
    T_link_world = inverse(T_world_link.astype(np.float64)).astype(np.float64)
    source = weld = np.arange(len(mesh.vertices), dtype=np.int32)
    if rigging.views == "zippered" and len(views) > 1:
        one = zippered(mesh, meshes, views, MESH_STRIDE)
        mesh, source, weld = one.mesh, one.source, one.weld
    if rigging.segmentation == "region-growing":
        grown = [grown_regions(v, m, MESH_STRIDE, skeleton, T_world_link) for v, m in zip(views, meshes, strict=True)]
        vertex_link = np.concatenate(grown)[source][weld]
    else:
        vertex_link = nearest_link(mesh.vertices, skeleton, T_world_link)
    mesh, drawn_count = _drawn_first(mesh, vertex_link)
    if drawn_count == 0:
        raise ValueError(f"pose {pose_id}: nothing of its {len(mesh.faces)} triangles can be drawn")
    vertex_region = vertex_regions(mesh.vertices, vertex_link, skeleton, T_link_world)
    edges = joint_edges(mesh.vertices, weld[mesh.faces], vertex_region, T_link_world, score_form)
    blend = vertex_blend(mesh.vertices, vertex_link, skeleton, T_world_link)
    drawn = mesh.faces[:drawn_count]
    return RiggedMesh(pose_id, capture_ns, skeleton, pose, T_link_world, mesh, vertex_link, blend, drawn, edges)


def merged(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """One mesh of one or more, their surfaces unconnected, their textures side by side in one atlas."""
    height, width = max(m.texture.shape[0] for m in meshes), sum(m.texture.shape[1] for m in meshes)
    atlas = np.empty((height, width, 3), np.uint8)
    vertices = np.concatenate([m.vertices for m in meshes])
    faces, uv = np.concatenate([m.faces for m in meshes]), np.concatenate([m.uv for m in meshes])
    vertex = face = left = 0
    for m in meshes:
        h, w = m.texture.shape[:2]
        atlas[:h, left : left + w] = m.texture
        atlas[h:, left : left + w] = m.texture[-1]  # below it goes on: a step would ring in a JPEG
        faces[face : face + len(m.faces)] += np.int32(vertex)
        u, v = uv[vertex : vertex + len(m.uv)].T
        u[:] = (u * np.float32(w) + np.float32(left)) / np.float32(width)
        v *= np.float32(h / height)
        vertex, face, left = vertex + len(m.uv), face + len(m.faces), left + w
    return TriangleMesh(vertices, faces, uv, atlas)


def _drawn_first(mesh: TriangleMesh, vertex_link: NDArray[np.uint8]) -> tuple[TriangleMesh, int]:
    """The mesh with its drawn triangles in front, and their number: what is drawn is then a slice, not a copy."""
    linked = _LINK_STEPS <= DRAWN_LINK_STEPS
    faces, count = _sorted(mesh.vertices, mesh.faces, vertex_link, linked, np.float32(DRAWN_EDGE_M**2))
    return TriangleMesh(mesh.vertices, faces, mesh.uv, mesh.texture), count


@njit(nogil=True, cache=True, error_model="numpy")
def _sorted(vertices, faces, vertex_link, linked, longest_squared):  # type: ignore[no-untyped-def]
    """The triangles (F, 3), those in front whose edges are short and join links of one limb; and how many these are."""
    out = np.empty_like(faces)
    front, back = 0, len(faces)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        drawn = True
        for p, q in ((a, b), (b, c), (c, a)):
            x, y, z = vertices[p, 0] - vertices[q, 0], vertices[p, 1] - vertices[q, 1], vertices[p, 2] - vertices[q, 2]
            drawn &= x * x + y * y + z * z <= longest_squared and linked[vertex_link[p], vertex_link[q]]
        back -= not drawn
        place = front if drawn else back
        out[place, 0], out[place, 1], out[place, 2] = a, b, c
        front += drawn
    return out, front
