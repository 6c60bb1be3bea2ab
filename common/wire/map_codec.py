"""One frame's link maps in three sections of bytes: which cells are full, their radii, their colours.

Occupancy: ``mask_codec``. Radius: rounded to a step, what its neighbours to the left and above let expect taken off
(the median of left, above and left + above - corner), full cells only, in deflate's Huffman code without its matches,
which in noise are none: zstd, which looks for them, takes a third more. Or a PNG of the rounded map. Colour: JPEG with
chroma at half resolution, without its header, which is the same for all pictures of one size and quality and is 600
bytes of a few thousand; empty cells hold the mean of the full ones in their 8 × 8 block, so nothing rings.

Radius decides: sensors' noise is white, so a transform saves nothing on it, and a silhouette shows every millimetre;
colours a third as good cost 0.1 dB. Against a reference colours are differences, coded in the same way; radii are too
where that is shorter, which it seldom is: the reference has noise of its own.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.cylindrical_map import LinkMaps
from common.body.map_layout import BLOCK, MapLayout
from common.wire.header import WireError
from common.wire.mask_codec import decode_masks, encode_masks

RADIUS_STEPS_MAX = 16  # of 2 mm
RADIUS_CODINGS = ("huffman", "png")

_START_OF_SCAN, _END = b"\xff\xda", b"\xff\xd9"
_MIDDLE = 128  # a colour difference of zero; beyond ±127 it is cut
_PNG_START, _PNG_CHUNKS = b"\x89PNG\r\n\x1a\n", {b"IHDR", b"IDAT", b"IEND"}


@dataclass(frozen=True, slots=True)
class MapQuality:
    """``jpeg`` 1..100 of the colours; ``radius_steps`` 1..16: radii are rounded to so many times 2 mm;
    ``radius_coding``: "huffman" or "png"."""

    jpeg: int
    radius_steps: int
    radius_coding: str = "huffman"


@dataclass(frozen=True, slots=True)
class MapSections:
    """The three parts of a frame in bytes. ``radius_differs``: radii are differences from the reference."""

    occupancy: bytes
    radius: bytes
    colour: bytes
    radius_differs: bool = False


def reference_of(maps: LinkMaps) -> LinkMaps:
    """Decoded maps as what others differ from: empty cells are like the full ones in their block, which is where a cell
    new in the next frame starts from."""
    colour, radius = np.empty_like(maps.colour), np.empty((*maps.radius.shape, 1), np.uint8)
    fill_empty(maps.colour, maps.full, np.full(3, _MIDDLE, np.uint8), colour)
    fill_empty(maps.radius[..., None], maps.full, np.zeros(1, np.uint8), radius)
    return LinkMaps(maps.full, colour, radius[..., 0])


def encode_maps(
    layout: MapLayout, maps: LinkMaps, quality: MapQuality, reference: LinkMaps | None = None
) -> MapSections:
    """The sections of ``maps``, or of how they differ from ``reference`` (``reference_of`` maps of the same layout)."""
    occupancy = encode_masks(layout.places, maps.full[None], None if reference is None else reference.full)
    radius = _encode_radius(layout, maps, quality, None)
    differing = radius if reference is None else _encode_radius(layout, maps, quality, reference)
    differs = len(differing) < len(radius)
    colour = maps.colour if reference is None else _difference(maps.colour, reference.colour)
    filled = np.empty_like(colour)
    fill_empty(colour, maps.full, np.full(3, _MIDDLE, np.uint8), filled)
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(filled, cv2.COLOR_RGB2BGR), _jpeg_settings(quality.jpeg))
    start = _jpeg_start(layout.height, layout.width, quality.jpeg)
    data = jpeg.tobytes()
    assert data.startswith(start)
    return MapSections(occupancy, differing if differs else radius, data[len(start) : -len(_END)], differs)


def decode_maps(
    layout: MapLayout, sections: MapSections, quality: MapQuality, reference: LinkMaps | None = None
) -> LinkMaps:
    """The maps of ``encode_maps``'s sections: of the layout's size, whatever the bytes declare.

    Raises:
        WireError: sections that no encoder writes for this layout.
    """
    shape = 1, layout.height, layout.width
    before = None if reference is None else reference.full
    full = decode_masks(layout.places, sections.occupancy, shape, before)[0]
    if sections.radius_differs and reference is None:
        raise WireError("radius: a difference without a reference")
    radius = _decode_radius(layout, sections.radius, full, quality, reference if sections.radius_differs else None)
    colour = _decode_colour(sections.colour, layout.height, layout.width, quality.jpeg)
    colour = _restored(colour, full, None if reference is None else reference.colour)
    return LinkMaps(full, colour, radius)


def _encode_radius(layout: MapLayout, maps: LinkMaps, quality: MapQuality, reference: LinkMaps | None) -> bytes:
    step = quality.radius_steps
    rounded = _rounded(maps.radius, step)
    if reference is not None:  # modulo 256, which is undone
        rounded = rounded - _rounded(reference.radius, step) + np.uint8(_MIDDLE)
    if quality.radius_coding == "png":
        rounded[~maps.full] = 0
        return bytes(cv2.imencode(".png", rounded)[1].tobytes())
    unexpected = np.empty(int(np.count_nonzero(maps.full)), np.uint8)
    _take_off(layout.places, maps.full, rounded, unexpected)
    coder = zlib.compressobj(wbits=-zlib.MAX_WBITS, strategy=zlib.Z_HUFFMAN_ONLY)
    return coder.compress(unexpected.tobytes()) + coder.flush()


def _decode_radius(
    layout: MapLayout, data: bytes, full: NDArray[np.bool_], quality: MapQuality, reference: LinkMaps | None
) -> NDArray[np.uint8]:
    step = quality.radius_steps
    if quality.radius_coding == "png":
        rounded = _decode_png(data, *full.shape)
    else:
        unexpected = np.frombuffer(_inflated(data, int(np.count_nonzero(full))), np.uint8)
        rounded = np.zeros(full.shape, np.uint8)
        _put_back(layout.places, full, unexpected, rounded)
    if reference is not None:
        rounded = rounded + _rounded(reference.radius, step) - np.uint8(_MIDDLE)
    return np.asarray(_radius_of(rounded, full, step))


def _rounded(radius: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    return radius.copy() if step == 1 else ((radius.astype(np.uint16) + step // 2) // step).astype(np.uint8)


def _inflated(data: bytes, size: int) -> bytes:
    """``size`` bytes of a raw deflate stream; no more than that is ever allocated."""
    decoder = zlib.decompressobj(wbits=-zlib.MAX_WBITS)
    try:
        out = decoder.decompress(data, size + 1)
    except zlib.error as error:
        raise WireError(f"radius: {error}") from error
    if len(out) != size or not decoder.eof or decoder.unused_data:
        raise WireError(f"radius: not exactly {size} bytes")
    return out


def _decode_png(data: bytes, height: int, width: int) -> NDArray[np.uint8]:
    """Map (height, width) of a PNG, whose size, in its first chunk, is checked before it is decoded."""
    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])  # 8 bits of grey, in order
    if data[:8] != _PNG_START or data[12:16] != b"IHDR" or data[16:29] != head:
        raise WireError(f"radius: not a grey PNG of {width}×{height}")
    position = len(_PNG_START)
    while position < len(data):
        if data[position + 4 : position + 8] not in _PNG_CHUNKS:
            raise WireError("radius: PNG chunk where our encoder writes none")
        position += 12 + int.from_bytes(data[position : position + 4], "big")
    try:
        radius = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise WireError(f"radius: {error}") from error
    if radius is None or radius.shape != (height, width) or radius.dtype != np.uint8:
        raise WireError("radius: corrupt PNG")
    return np.asarray(radius, np.uint8)


def _jpeg_settings(quality: int) -> list[int]:
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    return [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling]


@lru_cache(maxsize=64)
def _jpeg_start(height: int, width: int, quality: int) -> bytes:
    """All of a JPEG before its scan's data: the standard's tables, the size, the order of components."""
    _, jpeg = cv2.imencode(".jpg", np.zeros((height, width, 3), np.uint8), _jpeg_settings(quality))
    data, position = jpeg.tobytes(), 2
    while True:
        marker = data[position : position + 2]
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == _START_OF_SCAN:
            return bytes(data[:position])


def _decode_colour(scan: bytes, height: int, width: int, quality: int) -> NDArray[np.uint8]:
    if scan.count(b"\xff") != scan.count(b"\xff\x00"):  # in a scan, 0 follows every 255 that is no marker
        raise WireError("colour: a marker within the scan")
    data = _jpeg_start(height, width, quality) + scan + _END
    try:
        colour = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    except cv2.error as error:
        raise WireError(f"colour: {error}") from error
    if colour is None or colour.shape != (height, width, 3):
        raise WireError("colour: corrupt JPEG")
    return np.ascontiguousarray(colour, np.uint8)


@njit(nogil=True, cache=True)
def fill_empty(values, full, start, out):  # type: ignore[no-untyped-def]
    """Copies ``values`` (H, W, C), whole blocks, to ``out``; an empty cell gets the mean of its block's full ones, a
    block without any that of the block before it: no difference to it, which costs a JPEG one bit."""
    height, width, channels = values.shape
    mean = start.copy()
    for top in range(0, height, BLOCK):
        for left in range(0, width, BLOCK):
            kept = full[top : top + BLOCK, left : left + BLOCK]
            block, filled = values[top : top + BLOCK, left : left + BLOCK], out[top : top + BLOCK, left : left + BLOCK]
            count = kept.sum()
            if count:
                for c in range(channels):
                    sum_ = np.int64(0)
                    for v in range(BLOCK):
                        for u in range(BLOCK):
                            sum_ += block[v, u, c] * kept[v, u]
                    mean[c] = sum_ // count
            for v in range(BLOCK):
                for u in range(BLOCK):
                    for c in range(channels):
                        filled[v, u, c] = block[v, u, c] if kept[v, u] else mean[c]


@njit(nogil=True, cache=True)
def _difference(colour, known):  # type: ignore[no-untyped-def]
    """Colours (H, W, 3) as what they are beyond ``known`` ones, ``_MIDDLE`` where they are the same."""
    out = np.empty_like(colour)
    for v in range(colour.shape[0]):
        for u in range(colour.shape[1]):
            for c in range(3):
                out[v, u, c] = min(max(np.int32(colour[v, u, c]) - np.int32(known[v, u, c]) + _MIDDLE, 0), 255)
    return out


@njit(nogil=True, cache=True)
def _restored(colour, full, known):  # type: ignore[no-untyped-def]
    """``_difference`` undone, or ``colour`` itself where nothing is ``known``; zero in empty cells."""
    out = np.empty_like(colour)
    for v in range(colour.shape[0]):
        for u in range(colour.shape[1]):
            kept = np.int32(full[v, u])
            for c in range(3):
                value = np.int32(colour[v, u, c])
                if known is not None:
                    value = min(max(np.int32(known[v, u, c]) + value - np.int32(_MIDDLE), np.int32(0)), np.int32(255))
                out[v, u, c] = kept * value
    return out


@njit(nogil=True, cache=True)
def _radius_of(rounded, full, step):  # type: ignore[no-untyped-def]
    """``_rounded`` undone; zero in empty cells."""
    out = np.empty_like(rounded)
    for v in range(rounded.shape[0]):
        for u in range(rounded.shape[1]):
            out[v, u] = min(np.int32(rounded[v, u]) * np.int32(step), np.int32(255)) * np.int32(full[v, u])
    return out


@njit(nogil=True, cache=True)
def _expected(values, v, u, top, left):  # type: ignore[no-untyped-def]
    """A cell's value as those before it in its link's grid, ``values`` from (top, left), let expect."""
    if v == top:
        return np.int64(values[v, u - 1]) if u > left else np.int64(0)
    above = np.int64(values[v - 1, u])
    if u == left:
        return above
    before, corner = np.int64(values[v, u - 1]), np.int64(values[v - 1, u - 1])
    low, high = min(before, above), max(before, above)
    return min(max(before + above - corner, low), high)


@njit(nogil=True, cache=True)
def _take_off(places, full, values, unexpected):  # type: ignore[no-untyped-def]
    """What full cells' ``values`` are beyond what was to be expected, modulo 256; empty ones become as expected."""
    n = 0
    for link in range(len(places)):
        top, left, rows, columns = places[link]
        for v in range(top, top + rows):
            for u in range(left, left + columns):
                expected = _expected(values, v, u, top, left)
                if full[v, u]:
                    unexpected[n] = np.uint8((np.int64(values[v, u]) - expected) & 255)
                    n += 1
                else:
                    values[v, u] = np.uint8(expected)


@njit(nogil=True, cache=True)
def _put_back(places, full, unexpected, values):  # type: ignore[no-untyped-def]
    """``_take_off`` undone."""
    n = 0
    for link in range(len(places)):
        top, left, rows, columns = places[link]
        for v in range(top, top + rows):
            for u in range(left, left + columns):
                expected = _expected(values, v, u, top, left)
                if full[v, u]:
                    values[v, u] = np.uint8((expected + np.int64(unexpected[n])) & 255)
                    n += 1
                else:
                    values[v, u] = np.uint8(expected)
