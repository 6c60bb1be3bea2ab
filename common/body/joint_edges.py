"""The edges between links, which alone change their length when a mesh is moved: what σ is made of (DISPOSE §5.2).

Of a fine mesh a sample will do, every so manieth along each seam: σ is a ratio of sums. Of 1,700 edges every second one
gives σ a standard deviation of 4 %, and the same choice among 36 poses in 96 of 100 frames, else one whose σ is a tiny
bit higher; σ then costs the same however fine the mesh is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.body_regions import REGION_COUNT, REGION_LINKS, ScoreForm

FIXED_EDGE_M = 0.05
EDGES_MOST = 1000  # of a mesh, and a few where a seam has less than so many


@dataclass(frozen=True, slots=True, eq=False)
class JointEdges:
    """E edges whose ends lie on different links, grouped by region pair (P pairs): all that σ needs of a mesh.

    ``vertices`` (E, 2) int32: the ends, in the pair's lower and higher region.
    ``points`` (6, E) float32 [m]: x y z of the lower region's end in its link's frame, then of the higher region's.
    ``rest_lengths`` (E,) float32 [m] at capture.
    ``pair_regions`` (P, 2) uint8, ``pair_links`` (P, 2) uint8: the links those move with; edges
    ``pair_starts[p]:pair_starts[p + 1]`` join pair p, ``pair_starts`` (P+1,) int32.
    ``region_lengths`` (R,) float32 [m]: what Eq. (1) divides by, Σ len(e) of each region, an edge counting in both its
    regions; 0 for a region that no edge joins to another link. Of a sample, what belongs to the sample.
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


def joint_edges(
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    vertex_region: NDArray[np.uint8],
    T_link_world: NDArray[np.float64],
    score_form: ScoreForm = "joining-edges",
    most: int = EDGES_MOST,
) -> JointEdges:
    """Collect the edges between links, each once, sorted by region pair; of more than ``most`` a sample.

    ``vertices`` (V, 3) [m, world], ``faces`` (F, 3), in which a place has one number also along seams;
    ``vertex_region`` (V,) uint8 (``vertex_regions``), ``T_link_world`` (L, 4, 4): as in ``RiggedMesh``.
    """
    keys = np.sort(_joining_edge_keys(faces, vertex_region, REGION_LINKS))
    ends, regions, points, lengths = _edges(keys, vertices, REGION_LINKS, T_link_world)
    kept = _sample(regions, most)
    region_lengths = _region_lengths(regions[kept], lengths[kept], score_form)
    if score_form == "all-edges":
        joining, sampled = _region_lengths(regions, lengths), _region_lengths(regions[kept], lengths[kept])
        share = np.divide(sampled, joining, out=np.zeros_like(sampled), where=joining > 0)
        region_lengths = share * _all_edge_lengths(vertices, faces, vertex_region, REGION_COUNT)
    regions = regions[kept]
    starts = _pair_starts(regions)
    return JointEdges(
        vertices=ends[kept],
        points=np.ascontiguousarray(points[:, kept]),
        rest_lengths=lengths[kept],
        pair_regions=np.ascontiguousarray(regions[starts]),
        pair_links=np.ascontiguousarray(REGION_LINKS[regions[starts]]),
        pair_starts=np.append(starts, len(regions)).astype(np.int32),
        region_lengths=region_lengths.astype(np.float32),
    )


def _pair_starts(regions: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Where in sorted edges of regions (E, 2) each pair begins."""
    return np.flatnonzero((np.diff(regions, axis=0, prepend=np.uint8(REGION_COUNT)) != 0).any(axis=1))


def _sample(regions: NDArray[np.uint8], most: int) -> NDArray[np.intp]:
    """Which edges of regions (E, 2) to keep: of each pair's the first and every so manieth after it."""
    starts = _pair_starts(regions)
    places = np.arange(len(regions))
    since_start = places - np.repeat(starts, np.diff(starts, append=len(regions)))
    return places[since_start % max(-(-len(regions) // most), 1) == 0]


def _region_lengths(
    edge_regions: NDArray[np.uint8], lengths: NDArray[np.float32], score_form: ScoreForm = "joining-edges"
) -> NDArray[np.float64]:
    """Σ len(e) (R,) [m] of each region, for edges (E,) of lengths [m] in regions (E, 2)."""
    counted = np.full(len(lengths), FIXED_EDGE_M) if score_form == "fixed-length" else lengths
    total = sum(np.bincount(edge_regions[:, k], weights=counted, minlength=REGION_COUNT) for k in (0, 1))
    return np.asarray(total, np.float64)


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
def _edges(keys, vertices, region_links, T_link_world):  # type: ignore[no-untyped-def]
    """What sorted keys stand for, each once: ends (E, 2), regions (E, 2), ``points`` (6, E) and lengths (E,)."""
    single = np.empty(len(keys), np.bool_)
    for n in range(len(keys)):
        single[n] = n == 0 or keys[n] != keys[n - 1]
    keys = keys[single]
    ends, regions = np.empty((len(keys), 2), np.int32), np.empty((len(keys), 2), np.uint8)
    points, lengths = np.empty((6, len(keys)), np.float32), np.empty(len(keys), np.float32)
    for e in range(len(keys)):
        pair, both = divmod(keys[e], len(vertices) * len(vertices))
        ends[e, 0], ends[e, 1] = divmod(both, len(vertices))
        regions[e, 0], regions[e, 1] = divmod(pair, len(region_links))
        squared = np.float32(0.0)
        for i in range(3):
            step = vertices[ends[e, 0], i] - vertices[ends[e, 1], i]
            squared += step * step
            for k in range(2):
                T, v = T_link_world[region_links[regions[e, k]]], vertices[ends[e, k]]
                points[3 * k + i, e] = T[i, 0] * v[0] + T[i, 1] * v[1] + T[i, 2] * v[2] + T[i, 3]
        lengths[e] = np.sqrt(squared)
    return ends, regions, points, lengths


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
