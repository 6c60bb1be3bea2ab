"""The (n, c)-clustered k-d tree (Lien 2009 §5.1.3, Fig. 4): points with like normals and colours, one k-d tree each.

A normal falls into a cell of latitude and longitude, a colour into one of hue and saturation. A point looks for its
partner in its own cluster and the neighbouring ones. While the cluster it is given stays the same, the partners come
from the same set, and ICP converges monotonically (Theorem 5.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.geometry.point_cloud import PointCloud

Array = NDArray[Any]

LEAF = 8  # ranges this short are searched point by point
STACK = 64  # a balanced tree of 2**31 points is less deep
DARK = 40  # the brightest channel of a colour below which its hue and saturation are noise


@dataclass(frozen=True, slots=True)
class ClusterBins:
    """How finely normals and colours are told apart. ``latitudes``: bands from pole to pole, the two at the poles are
    one cell each; ``longitudes``: cells of each other band; ``saturations``: rings around the one cell of all greys;
    ``hues``: cells of each ring. 1 everywhere: one k-d tree of all points."""

    latitudes: int = 6
    longitudes: int = 10
    saturations: int = 2
    hues: int = 6

    def __post_init__(self) -> None:
        for name, high in (("latitudes", 16), ("longitudes", 32), ("saturations", 8), ("hues", 24)):
            if not 1 <= getattr(self, name) <= high:
                raise ValueError(f"{name}: {getattr(self, name)} is outside 1..{high}")

    @property
    def normal_cells(self) -> int:
        return 1 if self.latitudes == 1 else 2 + (self.latitudes - 2) * self.longitudes

    @property
    def colour_cells(self) -> int:
        return 1 + (self.saturations - 1) * self.hues


class ClusteredKdTree(NamedTuple):
    """N points in K clusters. ``points`` (N, 3) float64 [m, world], cluster by cluster, each a k-d tree: the middle of
    a range is its root, left of it what is lower on ``axis`` (N,), right of it what is higher. ``first`` (K + 1,):
    cluster k is the rows from first[k] to first[k + 1]. ``low, high`` (K, 3): its box. ``rows`` (N,): row in the cloud.
    ``neighbours`` and ``first_neighbour`` (K + 1,): the clusters with points that cluster k is searched in."""

    points: Array
    axis: Array
    first: Array
    low: Array
    high: Array
    rows: Array
    neighbours: Array
    first_neighbour: Array
    colour_cells: int
    latitudes: int
    longitudes: int


def build_clustered_tree(cloud: PointCloud, bins: ClusterBins) -> ClusteredKdTree:
    """The trees of a cloud."""
    positions = cloud.positions.astype(np.float64)
    normal = normal_cells(cloud.normals.astype(np.float64), bins.latitudes, bins.longitudes)
    cluster = normal * bins.colour_cells + colour_cells(cloud.colours, bins)
    order = np.argsort(cluster, kind="stable")
    counts = np.bincount(cluster, minlength=bins.normal_cells * bins.colour_cells)
    first = np.concatenate([[0], np.cumsum(counts)])
    axis = np.zeros(len(order), np.int8)
    low, high = np.empty((len(counts), 3)), np.empty((len(counts), 3))
    _split_clusters(positions, order, first, axis, low, high)
    neighbours, first_neighbour = _occupied(*_neighbours(bins), counts)
    return ClusteredKdTree(
        positions[order], axis, first, low, high, order, neighbours, first_neighbour,
        bins.colour_cells, bins.latitudes, bins.longitudes,
    )  # fmt: skip


def colour_cells(colours: Array, bins: ClusterBins) -> Array:
    """Cell (N,) int64 of each colour (N, 3) uint8 RGB: 0 for greys and what is too dark to have a hue."""
    if bins.saturations == 1 or not len(colours):
        return np.zeros(len(colours), np.int64)
    rgb = colours.astype(np.float64)
    brightest, chroma = rgb.max(axis=1), np.ptp(rgb, axis=1)
    saturation = np.where(brightest < DARK, 0.0, chroma / np.maximum(brightest, 1.0))
    ring = np.minimum((saturation * bins.saturations).astype(np.int64), bins.saturations - 1)
    red, green, blue = (rgb / np.maximum(chroma, 1.0)[:, None]).T
    leader = np.argmax(rgb, axis=1)
    hue = np.choose(leader, [(green - blue) % 6.0, 2.0 + blue - red, 4.0 + red - green]) / 6.0
    cell = (hue * bins.hues).astype(np.int64) % bins.hues
    return np.where(ring == 0, 0, 1 + (ring - 1) * bins.hues + cell)


@njit(nogil=True, cache=True, error_model="numpy")
def normal_cells(normals: Array, latitudes: int, longitudes: int) -> Array:
    """Cell (N,) int64 of each unit normal (N, 3): 0 is the pole below, the last the pole above (y up)."""
    cells = np.zeros(len(normals), np.int64)
    if latitudes == 1:
        return cells
    for n in range(len(normals)):
        latitude = np.arcsin(min(max(normals[n, 1], -1.0), 1.0)) / np.pi + 0.5
        band = min(int(latitude * latitudes), latitudes - 1)
        longitude = np.arctan2(normals[n, 2], normals[n, 0]) / (2.0 * np.pi) + 0.5
        sector = min(int(longitude * longitudes), longitudes - 1)
        if band == latitudes - 1:
            cells[n] = 1 + (latitudes - 2) * longitudes
        elif band > 0:
            cells[n] = 1 + (band - 1) * longitudes + sector
    return cells


@njit(nogil=True, cache=True, error_model="numpy")
def nearest(
    tree: ClusteredKdTree, cluster: int, p: Array, best: int, least: float, stack: Array, bounds: Array
) -> tuple[int, float]:
    """Row of ``tree.points`` nearest to ``p`` (3,) [m, world] among the neighbours of ``cluster``, and its squared
    distance [m²]. ``best, least``: a row known already and its squared distance, or -1 and how far to look (squared):
    they come back when nothing is nearer. ``stack`` (STACK, 2) int64 and ``bounds`` (STACK,) are working space."""
    for k in range(tree.first_neighbour[cluster], tree.first_neighbour[cluster + 1]):
        candidate = tree.neighbours[k]
        to_box = 0.0
        for i in range(3):
            outside = max(tree.low[candidate, i] - p[i], p[i] - tree.high[candidate, i], 0.0)
            to_box += outside * outside
        if to_box >= least:
            continue
        stack[0, 0], stack[0, 1], bounds[0] = tree.first[candidate], tree.first[candidate + 1], to_box
        size = 1
        while size:
            size -= 1
            begin, end = stack[size, 0], stack[size, 1]
            if bounds[size] >= least:
                continue
            while end - begin > LEAF:  # down to the leaf on p's side, the other sides wait
                middle = (begin + end) // 2
                squared = squared_distance(tree.points, middle, p)
                if squared < least:
                    best, least = middle, squared
                beyond = p[tree.axis[middle]] - tree.points[middle, tree.axis[middle]]
                bounds[size] = beyond * beyond
                if beyond < 0:
                    stack[size, 0], stack[size, 1], end = middle + 1, end, middle
                else:
                    stack[size, 0], stack[size, 1], begin = begin, middle, middle + 1
                size += 1
            for row in range(begin, end):
                squared = squared_distance(tree.points, row, p)
                if squared < least:
                    best, least = row, squared
    return best, least


@njit(nogil=True, cache=True, error_model="numpy")
def squared_distance(points: Array, row: int, p: Array) -> float:
    x, y, z = points[row, 0] - p[0], points[row, 1] - p[1], points[row, 2] - p[2]
    squared: float = x * x + y * y + z * z
    return squared


@njit(nogil=True, cache=True, error_model="numpy")
def _split_clusters(positions: Array, order: Array, first: Array, axis: Array, low: Array, high: Array) -> None:
    """Sorts each cluster's part of ``order`` into a k-d tree and writes its ``axis``; ``low, high``: its box."""
    stack = np.empty((STACK, 2), np.int64)
    for cluster in range(len(first) - 1):
        _bounding_box(positions, order, first[cluster], first[cluster + 1], low[cluster], high[cluster])
        stack[0, 0], stack[0, 1] = first[cluster], first[cluster + 1]
        size = 1
        low_here, high_here = np.empty(3), np.empty(3)
        while size:
            size -= 1
            begin, end = stack[size, 0], stack[size, 1]
            if end - begin <= LEAF:
                continue
            _bounding_box(positions, order, begin, end, low_here, high_here)
            widest = int(np.argmax(high_here - low_here))
            middle = (begin + end) // 2
            _select(positions, order, begin, end, middle, widest)
            axis[middle] = widest
            stack[size, 0], stack[size, 1] = begin, middle
            stack[size + 1, 0], stack[size + 1, 1] = middle + 1, end
            size += 2


@njit(nogil=True, cache=True, error_model="numpy")
def _bounding_box(positions: Array, order: Array, begin: int, end: int, low: Array, high: Array) -> None:
    low[:], high[:] = np.inf, -np.inf
    for k in range(begin, end):
        for i in range(3):
            low[i], high[i] = min(low[i], positions[order[k], i]), max(high[i], positions[order[k], i])


@njit(nogil=True, cache=True, error_model="numpy")
def _select(positions: Array, order: Array, begin: int, end: int, middle: int, axis: int) -> None:
    """Reorders ``order[begin:end]`` so that ``middle`` has its rank along ``axis`` (Hoare's quickselect)."""
    left, right = begin, end - 1
    while left < right:
        pivot = positions[order[(left + right) // 2], axis]
        i, j = left, right
        while i <= j:
            while positions[order[i], axis] < pivot:
                i += 1
            while positions[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            right = j
        elif middle >= i:
            left = i
        else:
            return


@cache
def _neighbours(bins: ClusterBins) -> tuple[Array, Array]:
    """Clusters that each cluster is searched in, itself first, and where each list starts (K + 1,)."""
    colours = _ring_neighbours(bins.saturations - 1, bins.hues)
    normals = _band_neighbours(bins.latitudes, bins.longitudes)
    lists = [[n * bins.colour_cells + c for n in around for c in beside] for around in normals for beside in colours]
    first = np.cumsum([0, *(len(found) for found in lists)])
    return np.concatenate([np.array(found, np.int64) for found in lists]), first


def _ring_neighbours(rings: int, cells: int) -> list[list[int]]:
    """Cell 0 (grey) borders on the whole first ring; each other cell on those beside it, also one ring in and out."""
    found = [[0, *(1 + cell for cell in range(cells if rings else 0))]]
    for ring in range(rings):
        for cell in range(cells):
            near = [(r, (cell + turn) % cells) for r in (ring - 1, ring, ring + 1) for turn in (-1, 0, 1)]
            inside = {1 + r * cells + c for r, c in near if 0 <= r < rings}
            found.append(sorted(inside | ({0} if ring == 0 else set())))
    return found


def _band_neighbours(latitudes: int, longitudes: int) -> list[list[int]]:
    """The rings of ``_ring_neighbours`` with a pole at both ends."""
    if latitudes == 1:
        return [[0]]
    bands = latitudes - 2
    found = _ring_neighbours(bands, longitudes)
    pole = 1 + bands * longitudes
    last_band = range(max(pole - longitudes, 1), pole)
    for cell in last_band:
        found[cell].append(pole)
    return [*found, [pole, *last_band]] if bands else [[0, 1], [0, 1]]


def _occupied(neighbours: Array, first: Array, counts: Array) -> tuple[Array, Array]:
    """The same lists without the clusters that hold no point."""
    kept = counts[neighbours] > 0
    return neighbours[kept], np.concatenate([[0], np.cumsum(kept)])[first]
