"""DISPOSE's pose p = {M, S}: a captured mesh, the skeleton it was captured with, and the edges that joins deform.

Sender and receiver build it with this code from the same decoded views and the same decoded skeleton.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.body_regions import REGION_COUNT, REGION_LINKS, vertex_regions
from common.body.depth_mesher import mesh_view
from common.body.link_segmentation import nearest_link
from common.body.skeleton import LINK_COUNT, LINK_PARENTS, Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.body.vertex_blend import VertexBlend, vertex_blend
from common.body.view import View
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


# What Eq. (1) divides the change of a region's edges by: their own length, as printed; that of all the region's edges,
# those within it too; or their number times a fixed length. The first grows as edges get shorter, and the paper's
# threshold of 0.15 belongs to it on meshes like the paper's; the last means the same on coarse meshes and fine ones.
ScoreForm = Literal["joining-edges", "all-edges", "fixed-length"]
FIXED_EDGE_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class JointEdges:
    """The E edges whose ends lie on different links, grouped by region pair (P pairs): all that σ needs of a mesh.

    ``vertices`` (E, 2) int32: the ends, in the pair's lower and higher region.
    ``points`` (6, E) float32 [m]: x y z of the lower region's end in its link's frame, then of the higher region's.
    ``rest_lengths`` (E,) float32 [m] at capture.
    ``pair_regions`` (P, 2) uint8, ``pair_links`` (P, 2) uint8: the links those move with; edges
    ``pair_starts[p]:pair_starts[p + 1]`` join pair p, ``pair_starts`` (P+1,) int32.
    ``region_lengths`` (R,) float32 [m]: what Eq. (1) divides by, Σ len(e) of each region, an edge counting in both its
    regions; 0 for a region that no edge joins to another link.
    """

    vertices: NDArray[np.int32]
    points: NDArray[np.float32]
    rest_lengths: NDArray[np.float32]
    pair_regions: NDArray[np.uint8]
    pair_links: NDArray[np.uint8]
    pair_starts: NDArray[np.int32]
    region_lengths: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.rest_lengths)


@dataclass(frozen=True, slots=True, eq=False)
class RiggedMesh:
    """A captured person, ready to be moved.

    ``T_link_world`` (L, 4, 4) float64: world at capture → link frames. ``vertex_link`` (V,) uint8: its segment, which
    σ goes by; ``blend``: its neighbour's part, for skinning.
    ``mesh.faces`` holds every triangle; ``faces_drawn`` (F', 3) int32 are its first F', whose edges were at most 6 cm
    at capture and join links at most two steps apart. The views stay separate surfaces in the one mesh.
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
    score_form: ScoreForm = "joining-edges",
) -> RiggedMesh:
    """Mesh all views of one instant and rig them to the skeleton of that instant; ``score_form`` of its σ.

    Raises:
        ValueError: the views hold no triangle that can be drawn.
    """
    if not views:
        raise ValueError(f"pose {pose_id}: no views")
    mesh = _merged([mesh_view(view, MESH_STRIDE) for view in views])
    if len(mesh.faces) == 0:
        raise ValueError(f"pose {pose_id}: its {len(views)} views hold no surface")
    T_world_link = forward_kinematics(skeleton, pose)
    T_link_world = inverse(T_world_link.astype(np.float64)).astype(np.float64)
    vertex_link = nearest_link(mesh.vertices, skeleton, T_world_link)
    mesh, drawn_count = _drawn_first(mesh, vertex_link)
    if drawn_count == 0:
        raise ValueError(f"pose {pose_id}: nothing of its {len(mesh.faces)} triangles can be drawn")
    vertex_region = vertex_regions(mesh.vertices, vertex_link, skeleton, T_link_world)
    edges = joint_edges(mesh, vertex_region, T_link_world, score_form)
    blend = vertex_blend(mesh.vertices, vertex_link, skeleton, T_world_link)
    drawn = mesh.faces[:drawn_count]
    return RiggedMesh(pose_id, capture_ns, skeleton, pose, T_link_world, mesh, vertex_link, blend, drawn, edges)


def joint_edges(
    mesh: TriangleMesh,
    vertex_region: NDArray[np.uint8],
    T_link_world: NDArray[np.float64],
    score_form: ScoreForm = "joining-edges",
) -> JointEdges:
    """Collect the edges between links, each once, sorted by region pair.

    ``vertex_region`` (V,) uint8 (``vertex_regions``), ``T_link_world`` (L, 4, 4): as in ``RiggedMesh``.
    """
    count = len(mesh.vertices)
    keys = np.unique(_joining_edge_keys(mesh.faces, vertex_region, REGION_LINKS))
    pair, ends = np.divmod(keys, count * count)
    vertices = np.stack(np.divmod(ends, count), axis=1).astype(np.int32)
    starts = np.flatnonzero(np.diff(pair, prepend=-1))
    regions = np.stack(np.divmod(pair, REGION_COUNT), axis=1).astype(np.uint8)
    links = REGION_LINKS[regions]
    a, b = (
        np.einsum("eij,ej->ei", T_link_world[links[:, k], :3, :3], mesh.vertices[vertices[:, k]])
        + T_link_world[links[:, k], :3, 3]
        for k in (0, 1)
    )
    lengths = np.linalg.norm(mesh.vertices[vertices[:, 0]] - mesh.vertices[vertices[:, 1]], axis=1)
    return JointEdges(
        vertices=vertices,
        points=np.ascontiguousarray(np.concatenate([a, b], axis=1).T, np.float32),
        rest_lengths=lengths.astype(np.float32),
        pair_regions=np.ascontiguousarray(regions[starts]),
        pair_links=np.ascontiguousarray(links[starts]),
        pair_starts=np.append(starts, len(keys)).astype(np.int32),
        region_lengths=_region_lengths(mesh, vertex_region, regions, lengths, score_form),
    )


def _region_lengths(
    mesh: TriangleMesh,
    vertex_region: NDArray[np.uint8],
    edge_regions: NDArray[np.uint8],
    lengths: NDArray[np.floating],
    score_form: ScoreForm,
) -> NDArray[np.float32]:
    """``JointEdges.region_lengths``, for edges (E,) of lengths [m] in regions (E, 2)."""
    if score_form == "fixed-length":
        lengths = np.full(len(lengths), FIXED_EDGE_M)
    total = sum(np.bincount(edge_regions[:, k], weights=lengths, minlength=REGION_COUNT) for k in (0, 1))
    if score_form == "all-edges":
        joined = np.asarray(total) > 0
        total = np.where(joined, _all_edge_lengths(mesh.vertices, mesh.faces, vertex_region, REGION_COUNT), 0)
    return np.asarray(total, np.float32)


def _merged(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """One mesh of one or more, their surfaces unconnected, their textures side by side in one atlas."""
    first = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])], dtype=np.int32)
    lefts = np.cumsum([0, *(m.texture.shape[1] for m in meshes[:-1])])
    height, width = max(m.texture.shape[0] for m in meshes), sum(m.texture.shape[1] for m in meshes)
    atlas = np.empty((height, width, 3), np.uint8)
    size = np.array([width, height], np.float32)
    uv = []
    for m, left in zip(meshes, lefts, strict=True):
        h, w = m.texture.shape[:2]
        atlas[:h, left : left + w] = m.texture
        atlas[h:, left : left + w] = m.texture[-1]  # below it goes on: a step would ring in a JPEG
        uv.append((m.uv * np.array([w, h], np.float32) + np.array([left, 0], np.float32)) / size)
    return TriangleMesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + offset for m, offset in zip(meshes, first, strict=True)]),
        np.concatenate(uv),
        atlas,
    )


def _drawn_first(mesh: TriangleMesh, vertex_link: NDArray[np.uint8]) -> tuple[TriangleMesh, int]:
    """The mesh with its drawn triangles in front, and their number: what is drawn is then a slice, not a copy."""
    drawn = _drawn(mesh.vertices, mesh.faces, vertex_link, _LINK_STEPS <= DRAWN_LINK_STEPS, np.float32(DRAWN_EDGE_M**2))
    faces = np.concatenate([mesh.faces[drawn], mesh.faces[~drawn]])
    return TriangleMesh(mesh.vertices, faces, mesh.uv, mesh.texture), int(np.count_nonzero(drawn))


@njit(nogil=True, cache=True, error_model="numpy")
def _drawn(vertices, faces, vertex_link, linked, longest_squared):  # type: ignore[no-untyped-def]
    """Mask (F,) of the triangles whose edges are short and join links of one limb."""
    out = np.ones(len(faces), np.bool_)
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            x = vertices[a, 0] - vertices[b, 0]
            y = vertices[a, 1] - vertices[b, 1]
            z = vertices[a, 2] - vertices[b, 2]
            if x * x + y * y + z * z > longest_squared or not linked[vertex_link[a], vertex_link[b]]:
                out[f] = False
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _joining_edge_keys(faces, vertex_region, region_links):  # type: ignore[no-untyped-def]
    """Keys (E',) int64 of the edges between links, twice where two triangles share one: region pair, and the ends."""
    vertex_count, region_count = np.int64(len(vertex_region)), np.int64(len(region_links))
    keys = np.empty(3 * len(faces), np.int64)
    count = 0
    for f in range(len(faces)):
        for k in range(3):
            a, b = np.int64(faces[f, k]), np.int64(faces[f, (k + 1) % 3])
            if region_links[vertex_region[a]] == region_links[vertex_region[b]]:
                continue
            if vertex_region[a] > vertex_region[b]:
                a, b = b, a
            pair = np.int64(vertex_region[a]) * region_count + np.int64(vertex_region[b])
            keys[count] = (pair * vertex_count + a) * vertex_count + b
            count += 1
    return keys[:count].copy()


@njit(nogil=True, cache=True, error_model="numpy")
def _all_edge_lengths(vertices, faces, vertex_region, region_count):  # type: ignore[no-untyped-def]
    """Σ len(e) (R,) [m] over the edges with an end in each region, each edge once."""
    totals = np.zeros(region_count)
    seen = set()
    for f in range(len(faces)):
        for k in range(3):
            a, b = np.int64(faces[f, k]), np.int64(faces[f, (k + 1) % 3])
            key = min(a, b) * len(vertices) + max(a, b)
            if key in seen:
                continue
            seen.add(key)
            x = vertices[a, 0] - vertices[b, 0]
            y = vertices[a, 1] - vertices[b, 1]
            z = vertices[a, 2] - vertices[b, 2]
            length = np.sqrt(x * x + y * y + z * z)
            totals[vertex_region[a]] += length
            if vertex_region[a] != vertex_region[b]:
                totals[vertex_region[b]] += length
    return totals
