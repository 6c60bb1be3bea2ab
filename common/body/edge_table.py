"""A set of directed edges a → b as an open-addressed hash table, for kernels."""

from __future__ import annotations

import numpy as np
from numba import njit

_EMPTY = -1


@njit(nogil=True, cache=True, error_model="numpy")
def edge_table(edges):  # type: ignore[no-untyped-def]
    """An empty table (S, 2) int32 with room for so many edges that it stays thinly filled."""
    size = 64
    while size < 4 * edges:
        size *= 2
    return np.full((size, 2), _EMPTY, np.int32)


@njit(nogil=True, cache=True, error_model="numpy")
def remember(table, a, b):  # type: ignore[no-untyped-def]
    """Enter the edge a → b."""
    place = _place(table, a, b)
    table[place, 0], table[place, 1] = a, b


@njit(nogil=True, cache=True, error_model="numpy")
def known(table, a, b):  # type: ignore[no-untyped-def]
    """Whether the edge a → b is in the table."""
    return table[_place(table, a, b), 0] != _EMPTY


@njit(nogil=True, cache=True, error_model="numpy")
def _place(table, a, b):  # type: ignore[no-untyped-def]
    """Where the edge a → b is, or would be."""
    mask = len(table) - 1
    place = (np.int64(a) * 73856093 + np.int64(b) * 19349663) & mask
    while table[place, 0] != _EMPTY and not (table[place, 0] == a and table[place, 1] == b):
        place = (place + 1) & mask
    return place
