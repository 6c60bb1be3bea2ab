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
    return np.zeros((places[:, 2].max() + 4, places[:, 3].max() + 4), np.uint8)


@njit(nogil=True, cache=True)
def _round_off(row, columns):  # type: ignore[no-untyped-def]
    """A row of a grid is complete: it goes on at its other side."""
    for n in range(2):
        row[n] = row[columns + n]
        row[columns + 2 + n] = row[2 + n]


@njit(nogil=True, cache=True)
def _put(grid, full, place):  # type: ignore[no-untyped-def]
    """A link's cells in ``full`` (H, W) into ``grid``, with what is around them; beyond its ends a link has none."""
    top, left, rows, columns = place
    for row in range(rows):
        out = grid[row + 2]
        for column in range(columns):
            out[column + 2] = full[top + row, left + column]
        _round_off(out, columns)
    grid[rows + 2, : columns + 4] = 0


@njit(nogil=True, cache=True, inline="always")
def _shifted(pattern, cell, cells):  # type: ignore[no-untyped-def]
    """The last so many ``cells`` of a row, one further."""
    return (pattern << 1 | np.int64(cell)) & ((1 << cells) - 1)


@njit(nogil=True, cache=True)
def _code(places, full, before, known, stream, decoding):  # type: ignore[no-untyped-def]
    """Writes the cells ``full`` (N, H, W) to ``stream``, or sets them, all empty before, as read from there; the number
    of bytes."""
    coder, contexts = open_coder(stream, decoding), open_contexts(_CONTEXTS)
    here, last = _room(places), _room(places)
    for n in range(len(full)):
        follows = known or n > 0
        for link in range(len(places)):
            top, left, rows, columns = places[link]
            if follows:
                _put(last, before if n == 0 else full[n - 1], places[link])
            for v in range(rows):
                if decoding and coder[3] > len(stream):
                    return coder[3]  # it ended long ago
                cells, around = full[n, top + v, left : left + columns], here[v : v + 3]
                if follows:
                    then = last[v + 2 : v + 4]
                    coder = _code_row_after(coder, stream, decoding, contexts, cells, around, then)
                else:
                    coder = _code_row(coder, stream, decoding, contexts, cells, around)
                _round_off(here[v + 2], columns)
    return close_coder(coder, stream, decoding)


@njit(nogil=True, cache=True, inline="always")
def _code_row(coder, stream, decoding, contexts, cells, here):  # type: ignore[no-untyped-def]
    """A row's ``cells`` (W,), by those around them ``here``: the two rows above and its own, which is set, two cells
    further left than ``cells``. Patterns are shifted along: to look every cell up anew takes four times as long."""
    higher, above, own = here[0], here[1], here[2]
    left, wide, far = np.int64(0), np.int64(0), np.int64(0)  # 2 cells to the left, 5 above, 3 above these
    for u in range(4):
        wide = _shifted(wide, above[u], 5)
    for u in range(1, 3):
        far = _shifted(far, higher[u], 3)
    for u in range(len(cells)):
        wide, far = _shifted(wide, above[u + 4], 5), _shifted(far, higher[u + 3], 3)
        context = left | wide << 2 | far << 7
        cell, coder = code_bit(coder, stream, decoding, contexts, context, np.int64(cells[u]))
        cells[u] = own[u + 2] = cell
        left = _shifted(left, cell, 2)
    return coder


@njit(nogil=True, cache=True, inline="always")
def _code_row_after(coder, stream, decoding, contexts, cells, here, last):  # type: ignore[no-untyped-def]
    """The same where ``last`` is known: this row and the one below it, of the frame before."""
    higher, above, own = here[0], here[1], here[2]
    same, below = last[0], last[1]
    left, near = np.int64(0), np.int64(above[1]) << 1 | np.int64(above[2])  # 2 cells to the left, 3 above
    then = np.int64(same[2])  # this cell and the next
    for u in range(len(cells)):
        near, then = _shifted(near, above[u + 3], 3), _shifted(then, same[u + 3], 2)
        context = left | near << 2 | then << 5 | np.int64(higher[u + 2]) << 7 | np.int64(below[u + 2]) << 8 | 1024
        cell, coder = code_bit(coder, stream, decoding, contexts, context, np.int64(cells[u]))
        cells[u] = own[u + 2] = cell
        left = _shifted(left, cell, 2)
    return coder
