"""RVL: run-length and variable-length coding of depth images (Wilson, "Fast Lossless Depth Image Compression", 2017).

The image is read in rows as pairs of runs: how many zeros, how many values. Each value is the zig-zag coded difference
to the value before it (before the first: 0). Every number is written in nibbles, low bits first: three bits of the
number and one that says whether more follow. Nibbles fill bytes from the high half.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.wire.header import WireError

_MAX_VALUE = 0xFFFF
_MAX_SHIFT = 27  # ten nibbles hold any run or difference that can occur

_OK, _TRUNCATED, _NUMBER_TOO_LONG, _RUN_TOO_LONG, _BAD_VALUE, _EXTRA_DATA = range(6)
_REASONS = {
    _TRUNCATED: "data ends inside the image",
    _NUMBER_TOO_LONG: "a number has too many nibbles",
    _RUN_TOO_LONG: "a run is longer than the rest of the image",
    _BAD_VALUE: "a value in a run of values is 0, negative or above 65535",
    _EXTRA_DATA: "data goes on after the image",
}


def rvl_max_bytes(pixels: int) -> int:
    """Upper bound [bytes] of the encoding of an image of ``pixels`` pixels: six nibbles a value, and the runs."""
    return 3 * pixels + 16 if pixels > 0 else 0


def encode_rvl(image: NDArray[np.uint16]) -> bytes:
    """RVL code of an image (h, w) uint16, any unit."""
    flat = np.ascontiguousarray(image, np.uint16).ravel()
    out = np.zeros(rvl_max_bytes(flat.size), np.uint8)
    nibbles = _encode(flat, out)
    return out[: (nibbles + 1) // 2].tobytes()


def decode_rvl(data: bytes, height: int, width: int) -> NDArray[np.uint16]:
    """The image (height, width) uint16 of ``encode_rvl``'s bytes. The caller bounds height and width.

    Raises:
        WireError: the data is not exactly one image of this size.
    """
    image = np.zeros(height * width, np.uint16)
    status = _decode(np.frombuffer(data, np.uint8), image)
    if status != _OK:
        raise WireError(f"RVL: {_REASONS[status]}")
    return image.reshape(height, width)


def in_steps(depth_mm: NDArray[np.uint16], step_mm: int) -> NDArray[np.uint16]:
    """Depth (h, w) [mm] in steps, rounded to the nearest, at least 1 where there is a reading."""
    steps = (depth_mm.astype(np.int64) + step_mm // 2) // step_mm
    return np.where(depth_mm > 0, np.maximum(steps, 1), 0).astype(np.uint16)


@njit(nogil=True, cache=True)
def _write(number: int, out: NDArray[np.uint8], nibble: int) -> int:
    """Writes ``number`` from nibble position ``nibble`` of ``out`` (zeroed); returns the position after it."""
    while True:
        bits = number & 7
        number >>= 3
        if number:
            bits |= 8
        out[nibble >> 1] |= np.uint8(bits if nibble & 1 else bits << 4)
        nibble += 1
        if not number:
            return nibble


@njit(nogil=True, cache=True)
def _encode(image: NDArray[np.uint16], out: NDArray[np.uint8]) -> int:
    """Encodes the flat image into ``out``; returns the number of nibbles."""
    n = image.size
    nibble = 0
    i = 0
    previous = 0
    while i < n:
        start = i
        while i < n and image[i] == 0:
            i += 1
        nibble = _write(i - start, out, nibble)
        start = i
        while i < n and image[i] != 0:
            i += 1
        nibble = _write(i - start, out, nibble)
        for k in range(start, i):
            value: Any = np.int64(image[k])
            delta = value - previous
            nibble = _write((delta << 1) ^ (delta >> 63), out, nibble)
            previous = value
    return nibble


@njit(nogil=True, cache=True)
def _read(data: NDArray[np.uint8], nibble: int) -> tuple[int, int]:
    """(number, position after it) from nibble position ``nibble``; on failure (-status, position)."""
    end = 2 * data.size
    number = 0
    shift = 0
    while True:
        if nibble >= end:
            return -_TRUNCATED, nibble
        if shift > _MAX_SHIFT:
            return -_NUMBER_TOO_LONG, nibble
        byte: Any = np.int64(data[nibble >> 1])
        bits = byte & 15 if nibble & 1 else byte >> 4
        number |= (bits & 7) << shift
        shift += 3
        nibble += 1
        if not bits & 8:
            return number, nibble


@njit(nogil=True, cache=True)
def _decode(data: NDArray[np.uint8], image: NDArray[np.uint16]) -> int:
    """Decodes into the zeroed flat ``image``; returns a status. Every index is checked before it is used."""
    n = image.size
    nibble = 0
    i = 0
    previous = 0
    while i < n:
        zeros, nibble = _read(data, nibble)
        if zeros < 0:
            return -zeros
        values, nibble = _read(data, nibble)
        if values < 0:
            return -values
        if zeros + values > n - i:
            return _RUN_TOO_LONG
        i += zeros
        for _ in range(values):
            code, nibble = _read(data, nibble)
            if code < 0:
                return -code
            previous += (code >> 1) ^ -(code & 1)
            if previous < 1 or previous > _MAX_VALUE:
                return _BAD_VALUE
            image[i] = previous
            i += 1
    if (nibble + 1) >> 1 != data.size or (nibble & 1 and data[nibble >> 1] & 15):
        return _EXTRA_DATA
    return _OK
