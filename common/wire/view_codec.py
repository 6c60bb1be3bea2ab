"""One camera's view of the person in bytes: calibration, crop, depth and colour.

Layout, little endian: header | camera name (UTF-8) | depth (``depth_codec``) | colour (``colour_codec``).
header: version u8, depth error u8 [mm], name length u8, camera width, height u16, crop u0, v0, width, height u16,
    fx fy cx cy, rows of T_world_camera (3 × 4) and distortion (5) f64, depth bytes u32.
Depth is off by at most its error, and never becomes 0, which says "not the person".
"""

from __future__ import annotations

import struct

import numpy as np

from common.body.view import View
from common.geometry.camera_model import Camera
from common.wire.colour_codec import decode_colour, encode_colour
from common.wire.depth_codec import decode_depth, encode_depth
from common.wire.header import VIEW_VERSION, WireError, check_start, checked_float, checked_int
from common.wire.view_quality import DEPTH_ERROR_MAX_MM, FINE, ViewQuality

VIEW_MAX_BYTES = 1 << 22
VIEW_MAX_PIXELS = 1 << 22

_HEADER = struct.Struct("<BBBHHHHHH21dI")
_NAME_MAX_BYTES = 64
_SIDE_MAX = 8192
_FOCAL_RANGE = (1.0, 1e5)  # pixels
_INTRINSIC_LIMITS = (1e5, 1e5, *[1.001, 1.001, 1.001, 1e3] * 3, *[1e2] * 5)  # cx cy, rows of T [m], distortion


def encode_view(view: View, quality: ViewQuality = FINE) -> bytes:
    """Bytes of one view.

    Raises:
        WireError: an empty crop, a camera name over 64 bytes, or a number or a size outside its bounds.
    """
    checked_int("colour quality", quality.colour_quality, 1, 100)
    camera, (height, width) = view.camera, view.depth_mm.shape
    name = camera.name.encode()
    if len(name) > _NAME_MAX_BYTES:
        raise WireError(f"view: camera name of {len(name)} bytes, at most {_NAME_MAX_BYTES} are allowed")
    _check_sizes(camera.width, camera.height, view.u0, view.v0, width, height, VIEW_MAX_PIXELS)
    calibration = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.T_world_camera[:3].ravel(), *camera.distortion]
    _check_calibration([float(number) for number in calibration])
    depth = encode_depth(view.depth_mm, quality.depth_error_mm)
    sizes = (camera.width, camera.height, view.u0, view.v0, width, height)
    header = _HEADER.pack(VIEW_VERSION, quality.depth_error_mm, len(name), *sizes, *calibration, len(depth))
    colour = encode_colour(view.colour, view.depth_mm, quality.colour, quality.colour_quality)
    data = header + name + depth + colour
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
    _, error_mm, name_bytes, *numbers, depth_bytes = _HEADER.unpack_from(data)
    checked_int("depth error", error_mm, 0, DEPTH_ERROR_MAX_MM)
    checked_int("camera name bytes", name_bytes, 0, _NAME_MAX_BYTES)
    camera_width, camera_height, u0, v0, width, height = numbers[:6]
    _check_sizes(camera_width, camera_height, u0, v0, width, height, max_pixels)
    depth_start = _HEADER.size + name_bytes
    colour_start = depth_start + depth_bytes
    if colour_start >= len(data):
        raise WireError(f"view: {len(data)} bytes end before the colour image")
    camera = _camera(data[_HEADER.size : depth_start], camera_width, camera_height, numbers[6:])
    colour = decode_colour(data[colour_start:], height, width)
    return View(camera, u0, v0, decode_depth(data[depth_start:colour_start], height, width, error_mm), colour)


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
