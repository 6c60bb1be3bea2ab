"""A person's depth in bytes, off by at most a stated error: near-lossless predictive coding as in JPEG-LS (T.87).

In reading order, each pixel says whether it is the person's, under the pattern of its neighbours; where all of these
are or none is, one bit speaks for as long as that goes on. A reading is predicted from those to the left and above as
the other end has them, so that errors do not add up; what it is off, in steps of twice the error and one, is coded
under how far its neighbours were off (``arithmetic_coder``).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.wire.arithmetic_coder import close_coder, code_bit, open_coder, open_contexts
from common.wire.header import WireError, checked_int
from common.wire.view_quality import DEPTH_ERROR_MAX_MM

_PATTERNS = 1024  # of ten neighbours
_ALL = _PATTERNS - 1
_MOST_MM = 0xFFFF
_UNARY = 10  # up to here a magnitude is counted bit by bit
_LEVELS = 8  # of how far the neighbours were off
_PER_LEVEL = _UNARY + 2  # none, each magnitude, sign
_LENGTHS = 18  # bits of a large magnitude
_PIXEL_MAX_BYTES = 80  # 47 bits at most are coded, into 12 bits each at most: 71

# What a reading follows from, of 16: left, above, left above, right above; by least squares over fused views of the
# virtual rig. Where readings are coarse, their rounding is noise that a mean takes away.
_FINE, _COARSE, _COARSE_MM = np.array((11, 8, -6, 3)), np.array((8, 5, -1, 4)), 3


def encode_depth(depth_mm: NDArray[np.uint16], error_mm: int) -> bytes:
    """Bytes of depth (h, w) uint16 [mm], 0 where the person is not; readings come back off by at most ``error_mm``.

    Raises:
        WireError: an error outside 0..16.
    """
    checked_int("depth error", error_mm, 0, DEPTH_ERROR_MAX_MM)
    stream = np.empty(_PIXEL_MAX_BYTES * depth_mm.size + 8, np.uint8)  # pages that are not written cost nothing
    size = _code(np.array(depth_mm, np.uint16, order="C"), error_mm, stream, False)
    return stream[:size].tobytes()


def decode_depth(data: bytes, height: int, width: int, error_mm: int) -> NDArray[np.uint16]:
    """Depth (height, width) uint16 [mm] of ``encode_depth``'s bytes. The caller bounds height and width.

    Raises:
        WireError: fewer or more bytes than these pixels take, or an error outside 0..16.
    """
    checked_int("depth error", error_mm, 0, DEPTH_ERROR_MAX_MM)
    depth_mm = np.zeros((height, width), np.uint16)
    size = _code(depth_mm, error_mm, np.frombuffer(bytearray(data), np.uint8), True)
    if size != len(data):
        raise WireError(f"depth: {len(data)} bytes, its pixels take {size}")
    return depth_mm


@njit(nogil=True, cache=True, inline="always")
def _predicted(left, above, corner, beyond, last, weights):  # type: ignore[no-untyped-def]
    """A reading from its neighbours', 0 where there is none; ``last``: the reading before it, wherever."""
    if left and above and corner and beyond:
        sum_ = weights[0] * left + weights[1] * above + weights[2] * corner + weights[3] * beyond
        return min(max((sum_ + 8) >> 4, 1), _MOST_MM)
    if left and above:
        return (left + above) >> 1
    if left or above:
        return left + above
    return last


@njit(nogil=True, cache=True)
def _end_of_stretch(above, second, u, person):  # type: ignore[no-untyped-def]
    """Where the stretch from ``u`` on ends around whose pixels, above them, all are ``person`` or none is."""
    while u < len(above) - 2 and (above[u + 2] > 0) == person and (second[u + 1] > 0) == person:
        u += 1
    return u


@njit(nogil=True, cache=True)
def _interrupted(depth_mm, v, start, end, person):  # type: ignore[no-untyped-def]
    """Whether a stretch of a row is not all ``person``, or not all nobody."""
    for u in range(start, end):  # noqa: SIM110
        if (depth_mm[v, u] > 0) != person:
            return True
    return False


@njit(nogil=True, cache=True)
def _code_large(coder, stream, decoding, contexts, start, number):  # type: ignore[no-untyped-def]
    """A number from 1 on (Elias gamma): how many bits it has, then these."""
    length = 0
    while length < _LENGTHS - 1:
        more, coder = code_bit(coder, stream, decoding, contexts, start + length, np.int64(number >> length > 1))
        if not more:
            break
        length += 1
    value = np.int64(1)
    for n in range(length - 1, -1, -1):
        bit, coder = code_bit(coder, stream, decoding, contexts, start + _LENGTHS, number >> n & 1)
        value = value << 1 | bit
    return value, coder


@njit(nogil=True, cache=True, error_model="numpy")
def _code(depth_mm, error_mm, stream, decoding):  # type: ignore[no-untyped-def]
    """Writes ``depth_mm`` (h, w), which becomes what the other end will have, to ``stream``, or reads it from there;
    the number of bytes."""
    height, width = depth_mm.shape
    coder, outline = open_coder(stream, decoding), open_contexts(_PATTERNS + 2)
    readings = open_contexts(_LEVELS * _PER_LEVEL + _LENGTHS + 1)
    step, last = np.int64(2 * error_mm + 1), np.int64(2000)
    per_step, weights = 1.0 / step, _FINE if error_mm < _COARSE_MM else _COARSE
    rows = np.zeros((3, width + 4), np.int64)  # this one and the two above it, with room at both ends
    offs = np.zeros((2, width + 4), np.int64)  # steps
    for v in range(height):
        here, above, second = rows[v % 3], rows[(v - 1) % 3], rows[(v - 2) % 3]
        off, off_above = offs[v % 2], offs[(v - 1) % 2]
        here[:], off[:] = 0, 0
        if decoding and coder[3] > len(stream):
            return coder[3]  # it ended long ago
        u = one_by_one_to = person_to = 2
        while u < width + 2:
            value = np.int64(depth_mm[v, u - 2])
            if u >= person_to:
                pattern = (
                    np.int64(here[u - 1] > 0)
                    | np.int64(here[u - 2] > 0) << 1
                    | np.int64(above[u] > 0) << 2
                    | np.int64(above[u - 1] > 0) << 3
                    | np.int64(above[u + 1] > 0) << 4
                    | np.int64(above[u - 2] > 0) << 5
                    | np.int64(above[u + 2] > 0) << 6
                    | np.int64(second[u] > 0) << 7
                    | np.int64(second[u - 1] > 0) << 8
                    | np.int64(second[u + 1] > 0) << 9
                )
                if u >= one_by_one_to and (pattern == 0 or pattern == _ALL):
                    person = pattern == _ALL
                    end = _end_of_stretch(above, second, u, person)
                    mixed = not decoding and _interrupted(depth_mm, v, u - 2, end - 2, person)
                    mixed, coder = code_bit(coder, stream, decoding, outline, _PATTERNS + person, np.int64(mixed))
                    if mixed:
                        one_by_one_to = end
                    elif person:
                        person_to = end
                    else:
                        u = end
                        continue
            if u >= person_to:
                somebody, coder = code_bit(coder, stream, decoding, outline, pattern, np.int64(value > 0))
                if not somebody:
                    u += 1
                    continue
            u += 1
            predicted = _predicted(here[u - 2], above[u - 1], above[u - 2], above[u], last, weights)
            wrong = value - predicted
            magnitude = np.int64((abs(wrong) + error_mm + 0.5) * per_step)
            near = off[u - 2] + off_above[u - 1] + ((off_above[u - 2] + off_above[u]) >> 1)
            level = min(near, 4) if near < 5 else min(5 + (near > 7) + (near > 14), _LEVELS - 1)
            start = level * _PER_LEVEL
            n = np.int64(0)
            while n < _UNARY:
                more, coder = code_bit(coder, stream, decoding, readings, start + n, np.int64(magnitude > n))
                if not more:
                    break
                n += 1
            if n == _UNARY:
                large, coder = _code_large(coder, stream, decoding, readings, _LEVELS * _PER_LEVEL, magnitude - n + 1)
                n += large - 1
            steps = n
            if n:
                negative, coder = code_bit(coder, stream, decoding, readings, start + _UNARY + 1, np.int64(wrong < 0))
                if negative:
                    steps = -n
            last = np.int64(min(max(predicted + steps * step, 1), _MOST_MM))
            here[u - 1], off[u - 1], depth_mm[v, u - 3] = last, n, last
    return close_coder(coder, stream, decoding)
