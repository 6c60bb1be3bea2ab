"""A view's colours in bytes: a JPEG where they are to be fine, a WebP, half as large, where every byte counts.

Colour outside the person is replaced by the mean of the person's colours in the same 8×8 block, so it costs next to
nothing and no background bleeds over the silhouette. The JPEG's chroma has full resolution (4:4:4), because halving it
saves a fifth of the bytes and loses 3 dB, more than a quality that saves as much (75 instead of 85). A WebP (VP8) has
half of it and takes ten times as long to encode; at the size of a coarse JPEG it shows no blocks.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.wire.header import WireError
from common.wire.view_quality import ColourFormat

_BLOCK = 8  # JPEG block, pixels
_START_OF_FRAME, _START_OF_SCAN = b"\xff\xc0", b"\xff\xda"
_JPEG_SEGMENTS = {_START_OF_FRAME, _START_OF_SCAN, b"\xff\xe0", b"\xff\xdb", b"\xff\xc4"}  # JFIF, tables
_RIFF = struct.Struct("<4sI4s4sI3s3sHH")  # a lossy WebP's start: container, its one chunk, VP8 frame header
_KEY_FRAME = b"\x9d\x01\x2a"


def encode_colour(
    colour: NDArray[np.uint8], depth_mm: NDArray[np.uint16], format_: ColourFormat, quality: int
) -> bytes:
    """Bytes of the person's colours (h, w, 3) uint8 RGB, where ``depth_mm`` (h, w) is not 0; ``quality`` 1..100."""
    filled = np.empty_like(colour)
    _fill_background(np.ascontiguousarray(colour), depth_mm, filled)
    if format_ == "webp":
        name, settings = ".webp", [cv2.IMWRITE_WEBP_QUALITY, quality]
    else:
        name, settings = ".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality]
        settings += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, data = cv2.imencode(name, cv2.cvtColor(filled, cv2.COLOR_RGB2BGR), settings)
    return data.tobytes()


def decode_colour(data: bytes, height: int, width: int) -> NDArray[np.uint8]:
    """Colour (height, width, 3) uint8 RGB; the size in the image's header is checked before it is decoded.

    Raises:
        WireError: not an image of this size as our encoder writes them.
    """
    format_, size = ("WebP", _webp_size(data)) if data[:4] == b"RIFF" else ("JPEG", _jpeg_size(data))
    if size != (height, width):
        raise WireError(f"colour: {format_} of {size} pixels, expected {(height, width)}")
    try:
        colour = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise WireError(f"colour: {error}") from error
    if colour is None or colour.shape != (height, width, 3):
        raise WireError(f"colour: corrupt {format_}")
    return np.ascontiguousarray(colour, np.uint8)


def _webp_size(data: bytes) -> tuple[int, int]:
    """(height, width) of a WebP of one lossy key frame and nothing else, as our encoder writes them."""
    if len(data) < _RIFF.size:
        raise WireError("colour: not a whole WebP")
    _, file_bytes, webp, chunk, chunk_bytes, _, start, width, height = _RIFF.unpack_from(data)
    if (webp, chunk, start) != (b"WEBP", b"VP8 ", _KEY_FRAME):
        raise WireError("colour: a WebP that our encoder does not write")
    if file_bytes != len(data) - 8 or not file_bytes - 13 <= chunk_bytes <= file_bytes - 12:  # even, by a byte of 0
        raise WireError("colour: not a whole WebP")
    return height, width  # with two bits for scaling each, which are 0 in ours


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """(height, width) of a baseline JPEG of three 8-bit components in one scan, as our encoder writes them.

    All else is refused: an image of many scans, a few bytes each, could ask for minutes of decoding.
    """
    if data[:2] != b"\xff\xd8" or data[-2:] != b"\xff\xd9":
        raise WireError("colour: not a whole JPEG")
    size: tuple[int, int] | None = None
    position, marker = 2, b""
    while marker != _START_OF_SCAN:
        marker = data[position : position + 2]
        if marker not in _JPEG_SEGMENTS or position + 10 > len(data):
            raise WireError(f"colour: JPEG segment 0x{marker.hex()} where our encoder writes none")
        if marker == _START_OF_FRAME:
            precision, height, width, components = struct.unpack_from(">BHHB", data, position + 4)
            if (precision, components) != (8, 3):
                raise WireError(f"colour: JPEG of {components} components of {precision} bits")
            size = height, width
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    if size is None:
        raise WireError("colour: JPEG without a size")
    scan = data[position:-2]
    if scan.count(b"\xff") != scan.count(b"\xff\x00"):  # in a scan, 0 follows every 255 that is no marker
        raise WireError("colour: JPEG of more than one scan")
    return size


@njit(nogil=True, cache=True)
def _fill_background(colour: NDArray[np.uint8], depth: NDArray[np.uint16], out: NDArray[np.uint8]) -> None:
    """Copies ``colour`` (h, w, 3) to ``out``; where ``depth`` is 0 writes the mean colour of the block's person pixels.

    A block without person pixels takes the block's before it: a difference of zero, one bit in JPEG.
    """
    height, width = depth.shape
    mean = np.full(3, 128, np.uint8)
    for top in range(0, height, _BLOCK):
        for left in range(0, width, _BLOCK):
            bottom, right = min(top + _BLOCK, height), min(left + _BLOCK, width)
            red = green = blue = count = 0
            for v in range(top, bottom):
                for u in range(left, right):
                    if depth[v, u]:
                        count += 1
                        red += int(colour[v, u, 0])
                        green += int(colour[v, u, 1])
                        blue += int(colour[v, u, 2])
            if count:
                mean[0], mean[1], mean[2] = red // count, green // count, blue // count
            for v in range(top, bottom):
                for u in range(left, right):
                    if depth[v, u]:
                        out[v, u, 0], out[v, u, 1], out[v, u, 2] = colour[v, u, 0], colour[v, u, 1], colour[v, u, 2]
                    else:
                        out[v, u, 0], out[v, u, 1], out[v, u, 2] = mean[0], mean[1], mean[2]
