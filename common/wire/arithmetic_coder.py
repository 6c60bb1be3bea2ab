"""Adaptive binary arithmetic coding (as in JBIG, ITU-T T.82): one bit at a time, each under a context that learns.

The coder keeps an interval of 32 bits, split at each bit by how likely its context has found it to be 1; the leading
byte goes out as soon as both ends share it. One function codes both ways, so that both ends do the same to the bit.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_HALF, _LEAST = 1 << 15, 32  # of 2^16
_MEMORY = 60  # bits: what a context learns from
_RATES = np.array([2 * 65536 // (2 * seen + 3) for seen in range(_MEMORY + 1)])  # of learning, of 2^16


@njit(nogil=True, cache=True, inline="always")
def open_coder(stream, decoding):  # type: ignore[no-untyped-def]
    """The state of a coder that writes bytes into ``stream`` (uint8), or reads what another one has written there:
    the interval's ends, the number being read, bytes so far."""
    value = np.int64(0)
    if decoding:
        for n in range(4):
            value = value << 8 | (np.int64(stream[n]) if n < len(stream) else np.int64(0))
    return np.int64(0), np.int64(0xFFFFFFFF), value, np.int64(0)


@njit(nogil=True, cache=True)
def open_contexts(count):  # type: ignore[no-untyped-def]
    """``count`` contexts that have learnt nothing yet: (count, 2) int64, the share of ones of 2^16, and bits seen."""
    contexts = np.zeros((count, 2), np.int64)
    contexts[:, 0] = _HALF
    return contexts


@njit(nogil=True, cache=True, inline="always")
def code_bit(coder, stream, decoding, contexts, context, bit):  # type: ignore[no-untyped-def]
    """Writes ``bit`` under a context, or reads one and takes no notice of ``bit``: (the bit, the coder's new state)."""
    low, high, value, size = coder
    share, seen = contexts[context, 0], contexts[context, 1]
    width = high - low
    middle = low + (width >> 16) * share + (((width & 0xFFFF) * share) >> 16)
    if decoding:
        bit = np.int64(value <= middle)
    if bit:
        high = middle
    else:
        low = middle + 1
    share += ((bit << 16) - share) * _RATES[seen] >> 16
    contexts[context, 0] = min(max(share, _LEAST), 65536 - _LEAST)
    contexts[context, 1] = min(seen + 1, _MEMORY)
    while (low ^ high) >> 24 == 0:
        if decoding:
            following = np.int64(stream[size + 4]) if size + 4 < len(stream) else np.int64(0)
            value = (value << 8) & 0xFFFFFFFF | following
        else:
            stream[size] = high >> 24
        size += 1
        low, high = (low << 8) & 0xFFFFFFFF, (high << 8) & 0xFFFFFFFF | 0xFF
    return bit, (low, high, value, size)


@njit(nogil=True, cache=True, inline="always")
def close_coder(coder, stream, decoding):  # type: ignore[no-untyped-def]
    """How many bytes were written, or are written for what was read, the last one included."""
    _, high, _, size = coder
    if not decoding:
        stream[size] = high >> 24  # and nothing after it: lies between both ends
    return size + 1
