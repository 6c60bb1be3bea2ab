"""One camera's view of the person in bytes: calibration, crop, depth (RVL, then zstd) and colour (JPEG).

Layout, little endian: header | camera name (UTF-8) | zstd frame of RVL depth | JPEG.
header: version u8, depth step u8 [mm], name length u8, camera width, height u16, crop u0, v0, width, height u16,
    fx fy cx cy, rows of T_world_camera (3 × 4) and distortion (5) f64, depth bytes u32.
Depth is exact at a step of 1 mm, else off by at most half a step (and never becomes 0, which says "not the person").
Colour outside the person is replaced by the mean of the person's colours in the same 8×8 JPEG block, so it costs
next to nothing and no background bleeds over the silhouette; chroma is kept at full resolution (4:4:4), because
halving it saves a fifth of the JPEG and loses 3 dB, more than a quality that saves as much (75 instead of 85).
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import zstandard
from numba import njit
from numpy.typing import NDArray

from common.body.view import View
from common.geometry.camera_model import Camera
from common.wire.header import VIEW_VERSION, WireError, check_start, checked_float, checked_int
from common.wire.rvl import decode_rvl, encode_rvl, rvl_max_bytes

VIEW_MAX_BYTES = 1 << 22
VIEW_MAX_PIXELS = 1 << 22
DEPTH_STEP_MAX_MM = 16
JPEG_QUALITY = 85

_HEADER = struct.Struct("<BBBHHHHHH21dI")
_NAME_MAX_BYTES = 64
_SIDE_MAX = 8192
_ZSTD_LEVEL = 1  # higher levels gain nothing on RVL data
_BLOCK = 8  # JPEG block, pixels
_START_OF_FRAME, _START_OF_SCAN = b"\xff\xc0", b"\xff\xda"
_JPEG_SEGMENTS = {_START_OF_FRAME, _START_OF_SCAN, b"\xff\xe0", b"\xff\xdb", b"\xff\xc4"}  # JFIF, tables
_FOCAL_RANGE = (1.0, 1e5)  # pixels
_INTRINSIC_LIMITS = (1e5, 1e5, *[1.001, 1.001, 1.001, 1e3] * 3, *[1e2] * 5)  # cx cy, rows of T [m], distortion


def encode_view(view: View, jpeg_quality: int = JPEG_QUALITY, depth_step_mm: int = 1) -> bytes:
    """Bytes of one view. ``jpeg_quality`` 1..100; ``depth_step_mm`` 1..16: coarser depth, fewer bytes.

    Raises:
        WireError: an empty crop, a camera name over 64 bytes, or a number or a size outside its bounds.
    """
    checked_int("JPEG quality", jpeg_quality, 1, 100)
    checked_int("depth step", depth_step_mm, 1, DEPTH_STEP_MAX_MM)
    camera, (height, width) = view.camera, view.depth_mm.shape
    name = camera.name.encode()
    if len(name) > _NAME_MAX_BYTES:
        raise WireError(f"view: camera name of {len(name)} bytes, at most {_NAME_MAX_BYTES} are allowed")
    _check_sizes(camera.width, camera.height, view.u0, view.v0, width, height, VIEW_MAX_PIXELS)
    calibration = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.T_world_camera[:3].ravel(), *camera.distortion]
    _check_calibration([float(number) for number in calibration])
    depth = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(encode_rvl(_depth_steps(view.depth_mm, depth_step_mm)))
    sizes = (camera.width, camera.height, view.u0, view.v0, width, height)
    header = _HEADER.pack(VIEW_VERSION, depth_step_mm, len(name), *sizes, *calibration, len(depth))
    data = header + name + depth + _encode_colour(view, jpeg_quality)
    if len(data) > VIEW_MAX_BYTES:
        raise WireError(f"view: {len(data)} bytes, at most {VIEW_MAX_BYTES} are allowed")
    return data


def decode_view(data: bytes, max_pixels: int = VIEW_MAX_PIXELS) -> View:
    """The view of ``encode_view``'s bytes; a crop of more than ``max_pixels`` is refused before it is allocated.

    Raises:
        WireError: anything that is not exactly one view within the bounds.
    """
    check_start("view", data, VIEW_VERSION, VIEW_MAX_BYTES)
    if len(data) < _HEADER.size:
        raise WireError(f"view: {len(data)} bytes are fewer than its header")
    _, step, name_bytes, *numbers, depth_bytes = _HEADER.unpack_from(data)
    checked_int("depth step", step, 1, DEPTH_STEP_MAX_MM)
    checked_int("camera name bytes", name_bytes, 0, _NAME_MAX_BYTES)
    camera_width, camera_height, u0, v0, width, height = numbers[:6]
    _check_sizes(camera_width, camera_height, u0, v0, width, height, max_pixels)
    depth_start = _HEADER.size + name_bytes
    colour_start = depth_start + depth_bytes
    if colour_start >= len(data):
        raise WireError(f"view: {len(data)} bytes end before the colour image")
    camera = _camera(data[_HEADER.size : depth_start], camera_width, camera_height, numbers[6:])
    colour = _decode_colour(data[colour_start:], height, width)
    return View(camera, u0, v0, _decode_depth(data[depth_start:colour_start], height, width, step), colour)


def _check_sizes(
    camera_width: int, camera_height: int, u0: int, v0: int, width: int, height: int, max_pixels: int
) -> None:
    checked_int("camera width", camera_width, 1, _SIDE_MAX)
    checked_int("camera height", camera_height, 1, _SIDE_MAX)
    checked_int("crop width", width, 1, camera_width)
    checked_int("crop height", height, 1, camera_height)
    checked_int("crop u0", u0, 0, camera_width - width)
    checked_int("crop v0", v0, 0, camera_height - height)
    if width * height > max_pixels:
        raise WireError(f"view: crop of {width}×{height} pixels, at most {max_pixels} are allowed")


def _check_calibration(numbers: list[float]) -> None:
    for name, number in zip(("fx", "fy"), numbers, strict=False):
        checked_float(f"camera {name}", number, *_FOCAL_RANGE)
    for limit, number in zip(_INTRINSIC_LIMITS, numbers[2:], strict=True):
        checked_float("camera calibration", number, -limit, limit)


def _camera(name: bytes, width: int, height: int, calibration: list[float]) -> Camera:
    _check_calibration(calibration)
    fx, fy, cx, cy, *rest = calibration
    T_world_camera = np.eye(4)
    T_world_camera[:3] = np.array(rest[:12]).reshape(3, 4)
    try:
        return Camera(name.decode(), width, height, fx, fy, cx, cy, T_world_camera, np.array(rest[12:]))
    except ValueError as error:  # not UTF-8, or not a rotation
        raise WireError(f"view: {error}") from error


def _depth_steps(depth_mm: NDArray[np.uint16], step_mm: int) -> NDArray[np.uint16]:
    """Depth in steps, rounded to the nearest, at least 1 where there is a reading."""
    if step_mm == 1:
        return depth_mm
    return _rounded_steps(depth_mm, step_mm)


def _decode_depth(data: bytes, height: int, width: int, step_mm: int) -> NDArray[np.uint16]:
    """Depth (height, width) uint16 [mm]; the declared size is checked before anything is allocated."""
    try:
        declared = zstandard.get_frame_parameters(data).content_size
        if declared > rvl_max_bytes(height * width):
            raise WireError(f"depth: declares {declared} bytes, more than {height * width} pixels can have")
        rvl = zstandard.ZstdDecompressor().decompress(data, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise WireError(f"depth: {error}") from error
    depth = decode_rvl(rvl, height, width)
    if step_mm == 1:
        return depth
    if int(depth.max()) * step_mm > 0xFFFF:
        raise WireError(f"depth: {int(depth.max())} steps of {step_mm} mm are beyond 65535 mm")
    return depth * np.uint16(step_mm)


def _encode_colour(view: View, quality: int) -> bytes:
    filled = np.empty_like(view.colour)
    _fill_background(np.ascontiguousarray(view.colour), view.depth_mm, filled)
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality]
    settings += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(filled, cv2.COLOR_RGB2BGR), settings)
    return jpeg.tobytes()


def _decode_colour(data: bytes, height: int, width: int) -> NDArray[np.uint8]:
    """Colour (height, width, 3) uint8 RGB; the size in the JPEG header is checked before it is decoded."""
    size = _jpeg_size(data)
    if size != (height, width):
        raise WireError(f"colour: JPEG of {size} pixels, expected {(height, width)}")
    try:
        colour = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise WireError(f"colour: {error}") from error
    if colour is None or colour.shape != (height, width, 3):
        raise WireError("colour: corrupt JPEG")
    return np.ascontiguousarray(colour, np.uint8)


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
def _rounded_steps(depth_mm: NDArray[np.uint16], step_mm: int) -> NDArray[np.uint16]:
    height, width = depth_mm.shape
    out = np.zeros((height, width), np.uint16)
    most = 0xFFFF // step_mm
    for v in range(height):
        for u in range(width):
            if depth_mm[v, u]:
                steps: Any = (np.int64(depth_mm[v, u]) + step_mm // 2) // step_mm
                out[v, u] = min(max(steps, 1), most)
    return out


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
                    for c in range(3):
                        out[v, u, c] = colour[v, u, c] if depth[v, u] else mean[c]
