"""Which cells of maps are full, without loss: adaptive binary arithmetic coding by neighbours (as JBIG, ITU-T T.82).

Surface comes in patches with frayed edges: whether a cell is full mostly follows from those above and to the left of it
and, of the frame before, from the same cell and those below and to the right. Each pattern of these is a context, which
learns how often it was full. That is half of what zstd makes of the bits, a third where a frame before is known.

The coder keeps an interval of 32 bits, split at each cell by the probability of its context; the leading byte goes out
as soon as both ends share it. Nothing but the cells of links' grids is coded, so no other can come out full.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.wire.header import WireError

_CONTEXTS = 2048  # 10 cells of this frame, or 6 of it and 3 of the one before
_HALF, _LEAST = 1 << 15, 32  # of 2^16
_MEMORY = 60  # cells: what a context learns from
_RATES = np.array([2 * 65536 // (2 * seen + 3) for seen in range(_MEMORY + 1)])  # of learning, of 2^16


def encode_masks(places: NDArray[np.int32], full: NDArray[np.bool_], before: NDArray[np.bool_] | None) -> bytes:
    """Cells (N, H, W) of N frames, which are full; ``places`` (L, 4): of ``MapLayout``; ``before`` (H, W): the frame
    before them, where the other end has it."""
    out = np.empty(2 * full.size + 8, np.uint8)  # no cell takes two bytes
    size = _encode(places, _RATES, full, full[0] if before is None else before, before is not None, out)
    return out[:size].tobytes()


def decode_masks(
    places: NDArray[np.int32], data: bytes, shape: tuple[int, int, int], before: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """The cells of ``encode_masks``'s bytes, (N, H, W) = ``shape``.

    Raises:
        WireError: fewer or more bytes than these cells take.
    """
    full = np.zeros(shape, np.bool_)
    coded = np.frombuffer(data, np.uint8)
    size = _decode(places, _RATES, coded, full[0] if before is None else before, before is not None, full)
    if size != len(data):
        raise WireError(f"occupancy: {len(data)} bytes, its cells take {size}")
    return full


@njit(nogil=True, cache=True)
def _room(places):  # type: ignore[no-untyped-def]
    """An empty grid large enough for every link's, and two cells around it."""
    return np.zeros((places[:, 2].max() + 4, places[:, 3].max() + 4), np.int64)


@njit(nogil=True, cache=True)
def _round_off(grid, row, columns):  # type: ignore[no-untyped-def]
    """A row is complete: it goes on at its other side."""
    for n in range(2):
        grid[row, n] = grid[row, columns + n]
        grid[row, columns + 2 + n] = grid[row, 2 + n]


@njit(nogil=True, cache=True)
def _put(grid, full, top, left, rows, columns):  # type: ignore[no-untyped-def]
    """A link's cells in ``full`` (H, W) into ``grid``, with what is around them; beyond its ends a link has none."""
    for row in range(2, rows + 2):
        for column in range(2, columns + 2):
            grid[row, column] = full[top + row - 2, left + column - 2]
        _round_off(grid, row, columns)
    grid[rows + 2, : columns + 4] = 0


@njit(nogil=True, cache=True)
def _context(here, last, known, v, u):  # type: ignore[no-untyped-def]
    """The number of the pattern around a cell: of cells that come before it in ``here``, and of the frame before."""
    pattern = (
        here[v, u - 1]
        | here[v, u - 2] << 1
        | here[v - 1, u] << 2
        | here[v - 1, u - 1] << 3
        | here[v - 1, u + 1] << 4
        | here[v - 2, u] << 5
    )
    if known:
        return pattern | last[v, u] << 6 | last[v, u + 1] << 7 | last[v + 1, u] << 8 | 1024
    return (
        pattern | here[v - 1, u + 2] << 6 | here[v - 1, u - 2] << 7 | here[v - 2, u - 1] << 8 | here[v - 2, u + 1] << 9
    )


@njit(nogil=True, cache=True)
def _split(low, high, share):  # type: ignore[no-untyped-def]
    """The last place of the lower part of an interval, ``share`` / 2^16 of it."""
    width = high - low
    return low + (width >> 16) * share + (((width & 0xFFFF) * share) >> 16)


@njit(nogil=True, cache=True)
def _learn(share, seen, rates, context, bit):  # type: ignore[no-untyped-def]
    """A cell of this context was full (``bit``) or not."""
    changed = share[context] + (((bit << 16) - share[context]) * rates[seen[context]] >> 16)
    share[context] = min(max(changed, _LEAST), 65536 - _LEAST)
    seen[context] = min(seen[context] + 1, _MEMORY)


@njit(nogil=True, cache=True)
def _encode(places, rates, full, before, known, out):  # type: ignore[no-untyped-def]
    """The number of bytes written to ``out``."""
    share, seen = np.full(_CONTEXTS, _HALF, np.int64), np.zeros(_CONTEXTS, np.int64)
    here, last = _room(places), _room(places)
    low, high, size = np.int64(0), np.int64(0xFFFFFFFF), 0
    for n in range(len(full)):
        for link in range(len(places)):
            top, left, rows, columns = places[link]
            _put(last, before if n == 0 else full[n - 1], top, left, rows, columns)
            for v in range(2, rows + 2):
                here[v, : columns + 4] = 0
                for u in range(2, columns + 2):
                    bit = np.int64(full[n, top + v - 2, left + u - 2])
                    context = _context(here, last, known or n > 0, v, u)
                    middle = _split(low, high, share[context])
                    if bit:
                        high = middle
                    else:
                        low = middle + 1
                    here[v, u] = bit
                    _learn(share, seen, rates, context, bit)
                    while (low ^ high) >> 24 == 0:
                        out[size] = high >> 24
                        size += 1
                        low, high = (low << 8) & 0xFFFFFFFF, (high << 8) & 0xFFFFFFFF | 0xFF
                _round_off(here, v, columns)
    out[size] = high >> 24  # and nothing after it: lies between both ends
    return size + 1


@njit(nogil=True, cache=True)
def _decode(places, rates, coded, before, known, full):  # type: ignore[no-untyped-def]
    """Sets ``full``, which is empty; the number of bytes that ``_encode`` writes for it."""
    share, seen = np.full(_CONTEXTS, _HALF, np.int64), np.zeros(_CONTEXTS, np.int64)
    here, last = _room(places), _room(places)
    low, high, value, size = np.int64(0), np.int64(0xFFFFFFFF), np.int64(0), 0
    for n in range(4):
        value = value << 8 | (np.int64(coded[n]) if n < len(coded) else np.int64(0))
    for n in range(len(full)):
        for link in range(len(places)):
            top, left, rows, columns = places[link]
            _put(last, before if n == 0 else full[n - 1], top, left, rows, columns)
            for v in range(2, rows + 2):
                here[v, : columns + 4] = 0
                for u in range(2, columns + 2):
                    context = _context(here, last, known or n > 0, v, u)
                    middle = _split(low, high, share[context])
                    bit = np.int64(value <= middle)
                    if bit:
                        high = middle
                    else:
                        low = middle + 1
                    here[v, u] = bit
                    full[n, top + v - 2, left + u - 2] = bit
                    _learn(share, seen, rates, context, bit)
                    while (low ^ high) >> 24 == 0:
                        size += 1
                        low, high = (low << 8) & 0xFFFFFFFF, (high << 8) & 0xFFFFFFFF | 0xFF
                        following = np.int64(coded[size + 3]) if size + 3 < len(coded) else np.int64(0)
                        value = (value << 8) & 0xFFFFFFFF | following
                _round_off(here, v, columns)
    return size + 1
