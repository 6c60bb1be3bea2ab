"""The joint edges of many poses in one block of memory, so that one call finds σ of them all for a skeleton.

A call per pose costs as much as the arithmetic in it; a search through a thousand poses has 10 ms (DISPOSE §5.3).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.distortion_score import length_change, seen_from
from common.body.joint_edges import JointEdges
from common.body.skeleton import LINK_COUNT

FIRST_EDGES, FIRST_PAIRS = 1 << 14, 1 << 8


class JointEdgeStore:
    """Poses by id. Each is a run of edges and a run of link pairs, those first that weigh most in σ; what leaves is
    closed up when it is half of all."""

    def __init__(self, region_weights: NDArray[np.float32]) -> None:
        self._weights = region_weights
        self._points = np.empty((6, FIRST_EDGES), np.float32)
        self._rest = np.empty(FIRST_EDGES, np.float32)
        self._links = np.empty((FIRST_PAIRS, 2), np.uint8)
        self._pair_edges = np.empty((FIRST_PAIRS, 2), np.int64)  # of each pair: its edges, from and to
        self._pair_weights = np.empty(FIRST_PAIRS, np.float32)  # σ per metre of changed length
        self._runs: dict[int, tuple[slice, slice]] = {}  # of each pose: edges, pairs
        self._edges = self._pairs = 0  # used, holes included
        self._edges_held = 0

    def __len__(self) -> int:
        return len(self._runs)

    def __contains__(self, pose_id: int) -> bool:
        return pose_id in self._runs

    @property
    def nbytes(self) -> int:
        """Memory of the block [bytes]."""
        return self._points.nbytes + self._rest.nbytes + self._pair_edges.nbytes

    def add(self, pose_id: int, edges: JointEdges) -> None:
        """Take in a pose's edges; one of the same id is replaced."""
        self.remove(pose_id)
        self._make_room(len(edges), len(edges.pair_links))
        run = slice(self._edges, self._edges + len(edges))
        pairs = slice(self._pairs, self._pairs + len(edges.pair_links))
        regions = max(int(np.count_nonzero(edges.region_lengths)), 1)
        with np.errstate(divide="ignore"):
            per_metre = np.where(edges.region_lengths > 0, self._weights / edges.region_lengths / regions, 0)
        weights, sizes = per_metre[edges.pair_regions].sum(axis=1), np.diff(edges.pair_starts)
        pair_of = np.repeat(np.arange(len(sizes)), sizes)
        order = np.argsort(-weights * np.bincount(pair_of, edges.rest_lengths, len(sizes)))
        in_order = np.argsort(np.argsort(order)[pair_of], kind="stable")
        self._points[:, run], self._rest[run] = edges.points[:, in_order], edges.rest_lengths[in_order]
        self._links[pairs], self._pair_weights[pairs] = edges.pair_links[order], weights[order]
        self._pair_edges[pairs, 1] = run.start + np.cumsum(sizes[order])
        self._pair_edges[pairs, 0] = self._pair_edges[pairs, 1] - sizes[order]
        self._runs[pose_id] = run, pairs
        self._edges, self._pairs = run.stop, pairs.stop
        self._edges_held += len(edges)

    def remove(self, pose_id: int) -> None:
        """Forget a pose; unknown ids are ignored."""
        run, _ = self._runs.pop(pose_id, (slice(0, 0), None))
        self._edges_held -= run.stop - run.start
        if self._edges > max(2 * self._edges_held, FIRST_EDGES):
            self._close_up()

    def clear(self) -> None:
        """Forget all."""
        self._runs.clear()
        self._edges = self._pairs = self._edges_held = 0

    def scores(
        self, pose_ids: list[int], T_world_link: NDArray[np.float32], limit: float = 0.0, best: int = 0
    ) -> NDArray[np.float32]:
        """σ (n,) float32 of the poses for links (L, 4, 4), in the order given, up to and with the first one below
        ``limit``: the others are not scored. A pose without edges cannot be judged: its σ is infinite.

        ``best``: so many of the lowest are right; of others σ may be what was added up when it passed those so far, for
        a sum of lengths only grows. 0: all are.
        """
        runs = [self._runs[pose_id][1] for pose_id in pose_ids]
        pairs = np.array([(run.start, run.stop) for run in runs], np.int64).reshape(-1, 2)
        found = np.empty(len(pairs), np.float32)
        count = _search(
            self._points, self._rest, self._links, self._pair_edges, self._pair_weights, pairs,
            np.ascontiguousarray(T_world_link, np.float32), np.float32(limit), best, found,
        )  # fmt: skip
        return found[:count]

    def _make_room(self, edges: int, pairs: int) -> None:
        while self._edges + edges > len(self._rest):
            self._points = np.concatenate([self._points, np.empty_like(self._points)], axis=1)
            self._rest = np.concatenate([self._rest, np.empty_like(self._rest)])
        while self._pairs + pairs > len(self._links):
            self._links = np.concatenate([self._links, np.empty_like(self._links)])
            self._pair_edges = np.concatenate([self._pair_edges, np.empty_like(self._pair_edges)])
            self._pair_weights = np.concatenate([self._pair_weights, np.empty_like(self._pair_weights)])

    def _close_up(self) -> None:
        """Move the runs together, in their order: none is written over before it has moved."""
        edge = pair = 0
        for pose_id, (run, pairs) in sorted(self._runs.items(), key=lambda item: item[1][0].start):
            to_run = slice(edge, edge + run.stop - run.start)
            to_pairs = slice(pair, pair + pairs.stop - pairs.start)
            self._points[:, to_run], self._rest[to_run] = self._points[:, run], self._rest[run]
            self._links[to_pairs], self._pair_weights[to_pairs] = self._links[pairs], self._pair_weights[pairs]
            self._pair_edges[to_pairs] = self._pair_edges[pairs] - (run.start - edge)
            self._runs[pose_id] = to_run, to_pairs
            edge, pair = to_run.stop, to_pairs.stop
        self._edges, self._pairs = edge, pair


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _search(points, rest, links, pair_edges, pair_weights, pose_pairs, T, limit, best, out):  # type: ignore[no-untyped-def]
    """Writes σ of each pose to ``out``; returns how many it scored."""
    R = np.empty((LINK_COUNT, LINK_COUNT, 3, 3), np.float32)
    t = np.empty((LINK_COUNT, LINK_COUNT, 3), np.float32)
    known = np.zeros((LINK_COUNT, LINK_COUNT), np.bool_)
    lowest = np.full(max(best, 1), np.inf, np.float32)  # so far, rising
    for n in range(len(pose_pairs)):
        sigma = np.float32(0.0)
        for p in range(pose_pairs[n, 0], pose_pairs[n, 1]):
            a, b = links[p, 0], links[p, 1]
            if not known[a, b]:
                known[a, b] = True
                seen_from(T, a, b, R[a, b], t[a, b])
            change = length_change(points, rest, pair_edges[p, 0], pair_edges[p, 1], R[a, b], t[a, b])
            sigma += change * pair_weights[p]
            if best > 0 and sigma > lowest[best - 1]:
                break
        out[n] = sigma if pose_pairs[n, 1] > pose_pairs[n, 0] else np.float32(np.inf)
        _insert(lowest, out[n])
        if out[n] < limit:
            return n + 1
    return len(pose_pairs)


@njit(nogil=True, cache=True, error_model="numpy")
def _insert(lowest, value):  # type: ignore[no-untyped-def]
    """Into a rising row, whose last value falls out."""
    place = len(lowest) - 1
    if value >= lowest[place]:
        return
    while place > 0 and lowest[place - 1] > value:
        lowest[place] = lowest[place - 1]
        place -= 1
    lowest[place] = value
