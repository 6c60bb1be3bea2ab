"""DISPOSE's distortion score σ: how much a mesh must deform to take another skeleton's pose (§5.2, Eq. 1–2).

Vertices move rigidly with their links, so only edges joining two links change length. For one pair of links the
change depends on their relative pose alone: σ needs the skeleton, not the animated mesh.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.body_regions import REGION_COUNT
from common.body.joint_edges import JointEdges
from common.body.rigged_mesh import RiggedMesh

START_THRESHOLD = 0.15  # DISPOSE §7.1; its edges are coarser than ours, so the session corrects it at once


def distortion_score(mesh: RiggedMesh, T_world_link: NDArray[np.float32], region_weights: NDArray[np.float32]) -> float:
    """σ of showing ``mesh`` with the links at ``T_world_link`` (L, 4, 4), with ω (R,); 0 for its own skeleton.

    Not commutative: what is hidden in this mesh stretches when it appears, not the other way round.
    """
    return float(distortion_scores(mesh.joint_edges, T_world_link[None], region_weights)[0])


def distortion_scores(
    edges: JointEdges, T_world_links: NDArray[np.float32], region_weights: NDArray[np.float32]
) -> NDArray[np.float32]:
    """σ (N,) float32 of one mesh's ``edges`` for N skeletons' links (N, L, 4, 4), with ω ``region_weights`` (R,).

    Eq. (1): σ_r = Σ|Δlen(e)| / Σ len(e) over the edges joining region r to other links, an edge counting in both its
    regions. Eq. (2): σ = (1/m) Σ ω_r σ_r over the m regions that have such edges. A mesh without a single one cannot
    be judged: its σ is infinite.
    """
    if len(edges) == 0:
        return np.full(len(T_world_links), np.inf, np.float32)
    return _scores(
        edges.points,
        edges.rest_lengths,
        edges.pair_regions,
        edges.pair_links,
        edges.pair_starts,
        edges.region_lengths,
        region_weights,
        T_world_links,
    )


def region_scores(mesh: RiggedMesh, T_world_link: NDArray[np.float32]) -> NDArray[np.float32]:
    """σ_r (R,) float32 of every region (``REGION_NAMES``), unweighted, for links ``T_world_link`` (L, 4, 4); Eq. (1).

    NaN for a region that no edge joins to another link: it was not seen, or is not the person's.
    """
    edges = mesh.joint_edges
    changes = _region_changes(
        edges.points,
        edges.rest_lengths,
        edges.pair_regions,
        edges.pair_links,
        edges.pair_starts,
        REGION_COUNT,
        T_world_link,
    )
    lengths = edges.region_lengths
    return np.where(lengths > 0, changes / np.where(lengths > 0, lengths, 1), np.nan).astype(np.float32)


class SessionThreshold:
    """The σ that counts as good in this session: the running mean of the best σ (DISPOSE §5.3).

    ``value`` starts at the paper's 0.15. A fixed threshold does not carry over between sessions: the finer the mesh,
    the shorter the edges at the joints and the larger the same gap's share of them.
    """

    def __init__(self, start: float = START_THRESHOLD, memory_frames: int = 300) -> None:
        self.value = start
        self.frames = 0
        self._memory_frames = memory_frames

    def follow(self, best_sigma: float) -> None:
        """Take in one frame's best σ; infinite ones are no information."""
        if not np.isfinite(best_sigma):
            return
        self.frames += 1
        self.value += (best_sigma - self.value) / min(self.frames, self._memory_frames)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _scores(points, rest, pair_regions, pair_links, pair_starts, region_lengths, omega, T):  # type: ignore[no-untyped-def]
    regions = 0
    for r in range(len(region_lengths)):
        regions += region_lengths[r] > 0
    out = np.zeros(len(T), np.float32)
    R, t = np.empty((3, 3), np.float32), np.empty(3, np.float32)
    for n in range(len(T)):
        for p in range(len(pair_links)):
            a, b = pair_regions[p, 0], pair_regions[p, 1]
            seen_from(T[n], pair_links[p, 0], pair_links[p, 1], R, t)
            change = length_change(points, rest, pair_starts[p], pair_starts[p + 1], R, t)
            out[n] += change * (omega[a] / region_lengths[a] + omega[b] / region_lengths[b]) / regions
    return out


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _region_changes(points, rest, pair_regions, pair_links, pair_starts, region_count, T):  # type: ignore[no-untyped-def]
    """Σ|Δlen(e)| (R,) [m] of each region's edges."""
    out = np.zeros(region_count, np.float32)
    R, t = np.empty((3, 3), np.float32), np.empty(3, np.float32)
    for p in range(len(pair_links)):
        seen_from(T, pair_links[p, 0], pair_links[p, 1], R, t)
        change = length_change(points, rest, pair_starts[p], pair_starts[p + 1], R, t)
        out[pair_regions[p, 0]] += change
        out[pair_regions[p, 1]] += change
    return out


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def seen_from(T, a, b, R, t):  # type: ignore[no-untyped-def]
    """Rotation ``R`` and place ``t`` of link b in the frame of link a, of links ``T`` (L, 4, 4). For kernels."""
    for i in range(3):
        t[i] = 0
        for k in range(3):
            t[i] += T[a, k, i] * (T[b, k, 3] - T[a, k, 3])
        for j in range(3):
            R[i, j] = T[a, 0, i] * T[b, 0, j] + T[a, 1, i] * T[b, 1, j] + T[a, 2, i] * T[b, 2, j]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def length_change(points, rest, start, end, R, t):  # type: ignore[no-untyped-def]
    """Σ|Δlen(e)| [m] over the edges start:end of one pair of links, the second at (R, t) in the first's frame."""
    ax, ay, az = points[0, start:end], points[1, start:end], points[2, start:end]
    bx, by, bz = points[3, start:end], points[4, start:end], points[5, start:end]
    lengths = rest[start:end]
    total = np.float32(0.0)
    for e in range(len(lengths)):
        x = R[0, 0] * bx[e] + R[0, 1] * by[e] + R[0, 2] * bz[e] + t[0] - ax[e]
        y = R[1, 0] * bx[e] + R[1, 1] * by[e] + R[1, 2] * bz[e] + t[1] - ay[e]
        z = R[2, 0] * bx[e] + R[2, 1] * by[e] + R[2, 2] * bz[e] + t[2] - az[e]
        total += abs(np.sqrt(x * x + y * y + z * z) - lengths[e])
    return total
