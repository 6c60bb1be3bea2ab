"""Which cells of maps are full, without loss: adaptive binary arithmetic coding by neighbours (as JBIG, ITU-T T.82).

Surface comes in patches with frayed edges: whether a cell is full mostly follows from those above and to the left of it
and, of the frame before, from the same cell and those below and to the right. Each pattern of these is a context, which
learns how often it was full (``arithmetic_coder``). That is half of what zstd makes of the bits, a third where a frame
before is known. Nothing but the cells of links' grids is coded, so no other can come out full.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.wire.arithmetic_coder import close_coder, code_bit, open_coder, open_contexts
from common.wire.header import WireError

_CONTEXTS = 2048  # 10 cells of this frame, or 6 of it and 3 of the one before


def encode_masks(places: NDArray[np.int32], full: NDArray[np.bool_], before: NDArray[np.bool_] | None) -> bytes:
    """Cells (N, H, W) of N frames, which are full; ``places`` (L, 4): of ``MapLayout``; ``before`` (H, W): the frame
    before them, where the other end has it."""
    stream = np.empty(2 * full.size + 8, np.uint8)  # no cell takes two bytes
    cells = np.array(full, np.bool_, order="C")
    size = _code(places, cells, cells[0] if before is None else before, before is not None, stream, False)
    return stream[:size].tobytes()


def decode_masks(
    places: NDArray[np.int32], data: bytes, shape: tuple[int, int, int], before: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """The cells of ``encode_masks``'s bytes, (N, H, W) = ``shape``.

    Raises:
        WireError: fewer or more bytes than these cells take.
    """
    full = np.zeros(shape, np.bool_)
    stream = np.frombuffer(bytearray(data), np.uint8)
    size = _code(places, full, full[0] if before is None else before, before is not None, stream, True)
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
def _code(places, full, before, known, stream, decoding):  # type: ignore[no-untyped-def]
    """Writes the cells ``full`` (N, H, W) to ``stream``, or sets them, all empty before, as read from there; the number
    of bytes."""
    coder, contexts = open_coder(stream, decoding), open_contexts(_CONTEXTS)
    here, last = _room(places), _room(places)
    for n in range(len(full)):
        for link in range(len(places)):
            top, left, rows, columns = places[link]
            _put(last, before if n == 0 else full[n - 1], top, left, rows, columns)
            for v in range(2, rows + 2):
                if decoding and coder[3] > len(stream):
                    return coder[3]  # it ended long ago
                here[v, : columns + 4] = 0
                for u in range(2, columns + 2):
                    context = _context(here, last, known or n > 0, v, u)
                    cell = np.int64(full[n, top + v - 2, left + u - 2])
                    cell, coder = code_bit(coder, stream, decoding, contexts, context, cell)
                    here[v, u] = full[n, top + v - 2, left + u - 2] = cell
                _round_off(here, v, columns)
    return close_coder(coder, stream, decoding)
