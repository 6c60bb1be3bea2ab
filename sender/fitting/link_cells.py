"""The surface of one link as running averages in small cells, so that it is bounded and gets better with every frame.

One bad frame is soon outvoted, what was seen once is noise, and a shell as thick as the noise is thinned to one sheet.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

MAX_POINTS_PER_LINK = 4_000
CELL_M = 0.012  # one model point per cell and facing
THICK_M = 0.010  # standard deviation of a surface's height, by noise or by bending, from which it is thinned
THICKNESS_SAMPLES = 64
ALONG, ASIDE = 3, 2  # cells up and down, and to the sides, that count as around a cell
MEMORY_FRAMES = 90.0  # a cell forgets what is older than about this many observations
RARE = 0.3  # of the median count of a link's cells: fewer observations are noise
CONFIRMED, FADING = 2.0, 0.97  # observations that make a late side surface; what is left of the others each time

_POSITION, _NORMAL, _COLOUR, COUNT, COLUMNS = slice(0, 3), slice(3, 6), slice(6, 9), 9, 10


class LinkCells:
    """Running sums of one link's points, keyed by cell and main direction of the normal; rows are sorted by key."""

    def __init__(self) -> None:
        self.keys = np.empty(0, np.int64)
        self.sums = np.empty((0, COLUMNS))

    def add(self, points: Array, normals: Array, colours: Array) -> None:
        rows = np.concatenate([points, normals, colours, np.ones((len(points), 1))], axis=1)
        keys = _cell_keys(points, normals)
        hit = np.unique(keys)
        fresh = hit[~np.isin(hit, self.keys, assume_unique=True)]
        at = np.searchsorted(self.keys, fresh)
        self.keys, self.sums = np.insert(self.keys, at, fresh), np.insert(self.sums, at, 0.0, axis=0)
        _add_rows(np.searchsorted(self.keys, keys), rows, self.sums)
        self.sums /= np.maximum(self.sums[:, COUNT:COLUMNS] / MEMORY_FRAMES, 1.0)
        if len(self.keys) > MAX_POINTS_PER_LINK:  # keep what was seen most often
            kept = np.sort(np.argsort(-self.sums[:, COUNT], kind="stable")[:MAX_POINTS_PER_LINK])
            self.keys, self.sums = self.keys[kept], self.sums[kept]

    def restore(self, sums: Array) -> None:
        points = sums[:, _POSITION] / sums[:, COUNT:]
        keys = _cell_keys(points, sums[:, _NORMAL])
        self.keys, first = np.unique(keys, return_index=True)
        self.sums = sums[first]

    def _often(self) -> Array:
        """Which cells were seen often enough (M,) bool."""
        if not len(self.sums):
            return np.zeros(0, bool)
        often: Array = self.sums[:, COUNT] >= RARE * np.median(self.sums[:, COUNT])
        return often

    def confirm(self) -> bool:
        """Cells seen ``CONFIRMED`` times lately count as often seen; the rest of the rare ones fade. Whether any did
        the former."""
        rare = ~self._often()
        seen = rare & (self.sums[:, COUNT] >= CONFIRMED)
        usual = RARE * np.median(self.sums[:, COUNT]) + 1.0
        self.sums[seen] *= (usual / self.sums[seen, COUNT])[:, None]
        self.sums[rare & ~seen] *= FADING
        return bool(seen.any())

    def shift(self, by: Array) -> None:
        """Moves all points ``by`` (3,) [m]; what falls into one cell is one point from then on."""
        sums = self.sums.copy()
        sums[:, _POSITION] += sums[:, COUNT:] * by
        keys = _cell_keys(sums[:, _POSITION] / sums[:, COUNT:], sums[:, _NORMAL])
        self.keys, rows = np.unique(keys, return_inverse=True)
        self.sums = np.zeros((len(self.keys), COLUMNS))
        _add_rows(rows, sums, self.sums)

    def surface(self) -> tuple[Array, Array, Array]:
        """Points (M, 3) [m, link frame], unit normals (M, 3) and colours (M, 3) of the cells that were seen often
        enough: noise leaves cells that were hit once or twice around the true surface. A thick shell, as noise of a
        centimetre leaves it, is thinned to one sheet in its middle."""
        often = self._often()
        sums = self.sums[often]
        if _thickness(self.keys, self.sums, often) > THICK_M:
            sums = sheet(self.keys, self.sums, often)
        count = sums[:, COUNT:]
        normals = sums[:, _NORMAL] / np.maximum(np.linalg.norm(sums[:, _NORMAL], axis=1, keepdims=True), 1e-9)
        return sums[:, _POSITION] / count, normals, sums[:, _COLOUR] / count


@njit(nogil=True, cache=True)
def _add_rows(targets: Array, rows: Array, sums: Array) -> None:
    for n in range(len(targets)):
        for column in range(rows.shape[1]):
            sums[targets[n], column] += rows[n, column]


@njit(nogil=True, cache=True, error_model="numpy")
def _height(keys: Array, sums: Array, n: int) -> tuple[float, float]:
    """Mean and standard deviation [m] of the height, along its facing, of all that was seen around cell n."""
    axis = (keys[n] >> 54) // 2
    steps = np.array([1 << 36, 1 << 18, 1])
    seen, height, square = 0.0, 0.0, 0.0
    for u in range(-ASIDE, ASIDE + 1):
        for v in range(-ASIDE, ASIDE + 1):
            base = keys[n] + u * steps[(axis + 1) % 3] + v * steps[(axis + 2) % 3]
            for w in range(-ALONG, ALONG + 1):
                k = np.searchsorted(keys, base + w * steps[axis])
                if k < len(keys) and keys[k] == base + w * steps[axis]:
                    seen += sums[k, COUNT]
                    height += sums[k, axis]
                    square += sums[k, axis] ** 2 / sums[k, COUNT]
    height /= seen
    return height, np.sqrt(max(square / seen - height * height, 0.0))


@njit(nogil=True, cache=True, error_model="numpy")
def _thickness(keys: Array, sums: Array, often: Array) -> float:
    """Mean standard deviation [m] of a surface's height around some of its cells (N,), ``often`` (N,) bool."""
    total, count = 0.0, 0
    for n in range(0, len(keys), max(len(keys) // THICKNESS_SAMPLES, 1)):
        if often[n]:
            total += _height(keys, sums, n)[1]
            count += 1
    return total / max(count, 1)


@njit(nogil=True, cache=True, error_model="numpy")
def sheet(keys: Array, sums: Array, often: Array) -> Array:
    """Sums (M, columns) of the cells that were seen most often of those above and below each other, at the mean height
    of what is around them; ``keys`` (N,) sorted, ``often`` (N,) bool."""
    out = np.empty_like(sums)
    count = 0
    steps = np.array([1 << 36, 1 << 18, 1])
    for n in range(len(keys)):
        axis = (keys[n] >> 54) // 2
        most = often[n]
        for w in range(-ALONG, ALONG + 1):
            key = keys[n] + w * steps[axis]
            k = np.searchsorted(keys, key)
            if most and k < len(keys) and keys[k] == key:
                less = sums[n, COUNT] - sums[k, COUNT]
                most = less > 0.0 or (less == 0.0 and k >= n)
        if most:
            out[count] = sums[n]
            out[count, axis] = _height(keys, sums, n)[0] * sums[n, COUNT]
            count += 1
    return out[:count]


def _cell_keys(points: Array, normals: Array) -> Array:
    cell = np.clip(np.floor(points / CELL_M), -(1 << 17), (1 << 17) - 1).astype(np.int64) + (1 << 17)
    axis = np.argmax(np.abs(normals), axis=1)
    facing = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0)
    return (((facing << 18 | cell[:, 0]) << 18 | cell[:, 1]) << 18) | cell[:, 2]
