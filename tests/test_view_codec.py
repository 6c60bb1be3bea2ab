"""The view codec: calibration exact, colour without bleeding, and no bytes that hurt the receiver."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.view import View
from common.geometry.camera_model import Camera
from common.geometry.rigid_transform import look_at
from common.wire.depth_codec import encode_depth
from common.wire.header import WireError
from common.wire.view_codec import VIEW_MAX_PIXELS, decode_view, encode_view
from common.wire.view_quality import ViewQuality

GOLDEN = Path(__file__).parent / "golden" / "view.hex"

NAME_AT = 187
SIZES_AT, CALIBRATION_AT, DEPTH_BYTES_AT = 3, 15, 183


def camera(width: int = 640, height: int = 480, name: str = "cam1") -> Camera:
    T_world_camera = look_at(np.array([1.0, 1.2, 2.3]), np.array([0, 0.9, 0]))
    distortion = np.array([0.1, -0.2, 0.001, 0.002, 0.05])
    return Camera(name, width, height, 525.25, 524.75, 319.5, 240.125, T_world_camera, distortion)


def some_view(height: int = 96, width: int = 64, noise_mm: float = 0.0, background: int = 255) -> View:
    """A ball of about 2.5 m distance with a coloured pattern, on a background of one grey."""
    v, u = np.mgrid[:height, :width]
    x, y = (u - width / 2 + 0.5) / (width / 2), (v - height / 2 + 0.5) / (height / 2)
    person = x * x + y * y < 0.9
    depth = 2500 - 200 * np.sqrt(np.maximum(0.9 - x * x - y * y, 0))
    depth += np.random.default_rng(0).normal(0, noise_mm, depth.shape)
    colour = np.stack([150 + 60 * np.sin(u / 9), 100 + 50 * np.cos(v / 7), 80 + 40 * x], -1)
    colour[~person] = background
    depth_mm = np.where(person, np.rint(depth), 0).astype(np.uint16)
    return View(camera(), 200, 100, depth_mm, colour.astype(np.uint8))


SMALL = some_view(16, 24)
EXACT = ViewQuality(depth_error_mm=0)
COARSE = ViewQuality("webp", 40, 4)
SMALL_BYTES, SMALL_DEPTH = encode_view(SMALL), encode_depth(SMALL.depth_mm, 1)


def rebuilt(
    sizes: tuple[int, ...] | None = None, depth: bytes | None = None, colour: bytes | None = None, error_mm: int = 1
) -> bytes:
    """``SMALL_BYTES`` with some of its parts replaced."""
    depth_bytes = struct.unpack_from("<I", SMALL_BYTES, DEPTH_BYTES_AT)[0]
    depth_at = NAME_AT + 4
    depth = SMALL_BYTES[depth_at : depth_at + depth_bytes] if depth is None else depth
    colour = SMALL_BYTES[depth_at + depth_bytes :] if colour is None else colour
    packed = SMALL_BYTES[SIZES_AT:CALIBRATION_AT] if sizes is None else struct.pack("<6H", *sizes)
    start = SMALL_BYTES[:1] + bytes([error_mm]) + SMALL_BYTES[2:3] + packed + SMALL_BYTES[CALIBRATION_AT:DEPTH_BYTES_AT]
    return start + struct.pack("<I", len(depth)) + SMALL_BYTES[NAME_AT:depth_at] + depth + colour


def jpeg_of(height: int, width: int, *settings_: int, grey: bool = False) -> bytes:
    image = np.full((height, width) if grey else (height, width, 3), 99, np.uint8)
    return bytes(cv2.imencode(".jpg", image, list(settings_))[1].tobytes())


def webp_of(height: int, width: int, quality: int = 40) -> bytes:
    """More than 100 means without loss."""
    image = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    return bytes(cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes())


_ONE_SCAN = jpeg_of(16, 24)
_TABLE_AT = _ONE_SCAN.index(b"\xff\xc4") + 5
_SCAN_AT = _ONE_SCAN.index(b"\xff\xda")
SCAN_BOMB = _ONE_SCAN[:-2] + _ONE_SCAN[_SCAN_AT : _SCAN_AT + 14] * 10_000 + b"\xff\xd9"


def assert_refused_cheaply(data: bytes, reason: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(WireError, match=reason):
            decode_view(data)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_depth_crop_and_calibration_come_back_exactly() -> None:
    view = some_view(noise_mm=3)
    decoded = decode_view(encode_view(view, EXACT))
    np.testing.assert_array_equal(decoded.depth_mm, view.depth_mm)
    assert (decoded.u0, decoded.v0, decoded.depth_mm.dtype, decoded.colour.dtype) == (200, 100, np.uint16, np.uint8)
    for field in ("name", "width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(decoded.camera, field) == getattr(view.camera, field)
    np.testing.assert_array_equal(decoded.camera.T_world_camera, view.camera.T_world_camera)
    np.testing.assert_array_equal(decoded.camera.distortion, view.camera.distortion)


@pytest.mark.parametrize("quality", [EXACT, ViewQuality(), COARSE], ids=["exact", "fine", "coarse"])
def test_depth_is_off_by_at_most_what_was_asked_for(quality: ViewQuality) -> None:
    view = some_view(noise_mm=3)
    decoded = decode_view(encode_view(view, quality)).depth_mm
    np.testing.assert_array_equal(decoded > 0, view.depth_mm > 0)
    assert np.abs(decoded.astype(int) - view.depth_mm).max() == quality.depth_error_mm


def test_coarser_depth_and_colour_take_fewer_bytes() -> None:
    view = some_view(noise_mm=3)
    assert (
        len(encode_view(view, ViewQuality(depth_error_mm=4))) < len(encode_view(view)) < len(encode_view(view, EXACT))
    )
    assert len(encode_view(view, ViewQuality(colour_quality=60))) < len(encode_view(view))


def test_a_webp_is_a_likeness_in_fewer_bytes() -> None:
    view = some_view(350, 300)
    person = view.depth_mm > 0
    jpeg, webp = (ViewQuality(colour, 40) for colour in ("jpeg", "webp"))  # type: ignore[arg-type]
    assert len(encode_view(view, webp)) < len(encode_view(view, jpeg))
    assert np.abs(decode_view(encode_view(view, webp)).colour.astype(int) - view.colour)[person].mean() < 6


def test_colours_of_the_person_survive_up_to_the_silhouette() -> None:
    view = some_view()
    person = view.depth_mm > 0
    error = np.abs(decode_view(encode_view(view)).colour.astype(int) - view.colour).max(axis=2)[person]
    assert error.mean() < 4
    assert error.max() < 25


def test_colour_keeps_its_full_resolution() -> None:
    stripes = np.where(np.arange(24)[:, None] % 2, np.array([200, 60, 60]), np.array([60, 60, 200])).astype(np.uint8)
    view = replace(SMALL, depth_mm=np.full((16, 24), 2000, np.uint16), colour=np.tile(stripes, (16, 1, 1)))
    error = np.abs(decode_view(encode_view(view)).colour.astype(int) - view.colour)
    assert error.max() < 50  # halved chroma mixes the stripes: 70


def test_the_background_leaves_no_trace() -> None:
    assert encode_view(some_view(background=255)) == encode_view(some_view(background=0))


def test_a_view_without_a_person_survives() -> None:
    view = replace(SMALL, depth_mm=np.zeros_like(SMALL.depth_mm))
    assert not decode_view(encode_view(view)).depth_mm.any()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda: encode_view(SMALL, ViewQuality(colour_quality=0)), "colour quality"),
        (lambda: encode_view(SMALL, ViewQuality(colour_quality=101)), "colour quality"),
        (lambda: encode_view(SMALL, ViewQuality(depth_error_mm=-1)), "depth error"),
        (lambda: encode_view(SMALL, ViewQuality(depth_error_mm=17)), "depth error"),
        (lambda: encode_view(replace(SMALL, camera=camera(name="ü" * 33))), "camera name"),
        (lambda: encode_view(replace(SMALL, camera=replace(camera(), fx=1e9))), "camera fx"),
        (lambda: encode_view(View(camera(), 0, 0, np.zeros((0, 5), np.uint16), np.zeros((0, 5, 3), np.uint8))), "crop"),
    ],
)
def test_views_without_an_encoding_are_refused(change: Callable[[], bytes], reason: str) -> None:
    with pytest.raises(WireError, match=reason):
        change()


# Hostile bytes


def test_the_parts_of_a_view_are_where_these_tests_look() -> None:
    assert rebuilt() == SMALL_BYTES


@pytest.mark.parametrize(
    ("sizes", "reason"),
    [
        ((640, 480, 200, 100, 0, 16), "crop width"),
        ((640, 480, 200, 100, 24, 0), "crop height"),
        ((640, 480, 617, 100, 24, 16), "crop u0"),
        ((640, 480, 200, 465, 24, 16), "crop v0"),
        ((0, 480, 0, 0, 24, 16), "camera width"),
        ((9000, 480, 0, 0, 24, 16), "camera width"),
        ((8192, 8192, 0, 0, 8192, 8192), f"at most {VIEW_MAX_PIXELS}"),
        ((8192, 8192, 0, 0, 2048, 2048), "JPEG of"),
        ((640, 480, 200, 100, 16, 24), "JPEG of"),
        ((640, 480, 200, 100, 24, 15), "JPEG of"),
    ],
)
def test_false_sizes_are_refused_before_allocation(sizes: tuple[int, ...], reason: str) -> None:
    assert_refused_cheaply(rebuilt(sizes=sizes), reason)


def test_fewer_pixels_can_be_allowed() -> None:
    assert decode_view(SMALL_BYTES, max_pixels=16 * 24).depth_mm.shape == (16, 24)
    with pytest.raises(WireError, match="at most 383 are"):
        decode_view(SMALL_BYTES, max_pixels=383)


@pytest.mark.parametrize(
    "depth",
    [b"", SMALL_DEPTH[: len(SMALL_DEPTH) // 2], SMALL_DEPTH + b"\0"],
    ids=["nothing", "half of it", "a byte more"],
)
def test_depth_that_is_not_exactly_the_crop_is_refused(depth: bytes) -> None:
    assert_refused_cheaply(rebuilt(depth=depth), "its pixels take")


def test_depth_coarser_than_allowed_is_refused() -> None:
    assert_refused_cheaply(rebuilt(error_mm=17), "depth error")


@pytest.mark.parametrize(
    ("colour", "reason"),
    [
        (b"", "ends? before"),
        (b"\xff", "not a whole JPEG"),
        (b"\xff\xd8\xff\xd9", "segment 0xffd9"),
        (b"\xff\xd8\xff\xe0\x7f\xff" + bytes(9) + b"\xff\xd9", "segment 0x where"),
        (jpeg_of(16, 24).replace(b"\xff\xc0", b"\xff\xe0", 1), "without a size"),
        (jpeg_of(16, 24)[:-2] + jpeg_of(16, 24)[-40:], "more than one scan"),
        (SCAN_BOMB, "more than one scan"),
        (jpeg_of(17, 24), r"JPEG of \(17, 24\)"),
        (jpeg_of(2000, 2000), "JPEG of"),
        (jpeg_of(16, 24)[:-2], "not a whole JPEG"),
        (_ONE_SCAN[:_TABLE_AT] + b"\x99" * 16 + _ONE_SCAN[_TABLE_AT + 16 :], "corrupt JPEG"),
        (jpeg_of(16, 24) + b"\0", "not a whole JPEG"),
        (jpeg_of(16, 24, cv2.IMWRITE_JPEG_PROGRESSIVE, 1), "segment 0xffc2"),
        (jpeg_of(16, 24, grey=True), "1 components"),
        (jpeg_of(16, 24).replace(b"\xff\xe0", b"\xff\xe1", 1), "segment 0xffe1"),
        (bytes(cv2.imencode(".png", np.zeros((16, 24, 3), np.uint8))[1].tobytes()), "not a whole JPEG"),
    ],
    ids=["none", "a byte", "no segments", "segment past the end", "no frame header", "second end", "scan bomb",
         "a row more", "much larger", "no end", "bad tables", "extra byte", "progressive", "grey", "EXIF", "PNG"],
)  # fmt: skip
def test_a_colour_image_other_than_declared_is_refused(colour: bytes, reason: str) -> None:
    assert_refused_cheaply(rebuilt(colour=colour), reason)


@pytest.mark.parametrize(
    ("webp", "reason"),
    [
        (b"RIFF", "not a whole WebP"),
        (webp_of(17, 24), r"WebP of \(17, 24\)"),
        (webp_of(1000, 1000), "WebP of"),
        (webp_of(16, 24)[:-1], "not a whole WebP"),
        (webp_of(16, 24) + b"\0", "not a whole WebP"),
        (webp_of(16, 24)[:12] + b"VP8X" + webp_of(16, 24)[16:], "does not write"),
        (webp_of(16, 24)[:23] + b"abc" + webp_of(16, 24)[26:], "does not write"),
        (webp_of(16, 24)[:16] + b"\0\0\0\x7f" + webp_of(16, 24)[20:], "not a whole WebP"),
        (webp_of(16, 24, 101), "does not write"),
        (bytes(webp_of(16, 24)[:30]) + b"\xff" * (len(webp_of(16, 24)) - 30), "corrupt WebP"),
    ],
    ids=["start", "a row more", "much larger", "a byte less", "extra byte", "other chunk", "no key frame", "long chunk",
         "lossless", "bad data"],
)  # fmt: skip
def test_a_webp_other_than_ours_is_refused(webp: bytes, reason: str) -> None:
    assert_refused_cheaply(rebuilt(colour=webp), reason)


@pytest.mark.parametrize("index", range(21))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, -1e300, 2e5])
def test_impossible_calibrations_are_refused(index: int, value: float) -> None:
    data = bytearray(SMALL_BYTES)
    struct.pack_into("<d", data, CALIBRATION_AT + 8 * index, value)
    assert_refused_cheaply(bytes(data), "camera")


@pytest.mark.parametrize(("index", "value"), [(0, 0.0), (1, -525.0), (0, 1e-300), (4, 0.5), (14, -0.3)])
def test_intrinsics_and_rotations_that_are_none_are_refused(index: int, value: float) -> None:
    data = bytearray(SMALL_BYTES)
    struct.pack_into("<d", data, CALIBRATION_AT + 8 * index, value)
    assert_refused_cheaply(bytes(data), "camera")


def test_a_camera_name_that_is_not_text_is_refused() -> None:
    data = bytearray(SMALL_BYTES)
    data[NAME_AT : NAME_AT + 4] = b"\xff\xfe\xfd\xfc"
    assert_refused_cheaply(bytes(data), "utf-8")


def test_empty_and_foreign_messages_are_refused() -> None:
    with pytest.raises(WireError, match="empty"):
        decode_view(b"")
    with pytest.raises(WireError, match="version byte 0x41"):
        decode_view(b"\x41" + SMALL_BYTES[1:])


def test_every_truncated_view_is_refused() -> None:
    for length in range(len(SMALL_BYTES)):
        with pytest.raises(WireError):
            decode_view(SMALL_BYTES[:length])


def assert_refused_or_sound(data: bytes) -> None:
    try:
        view = decode_view(data)
    except WireError:
        return
    assert view.depth_mm.size <= VIEW_MAX_PIXELS
    assert np.isfinite(view.camera.T_world_camera).all()


@pytest.mark.parametrize("flip", [0x01, 0x80, 0xFF])
def test_every_flipped_byte_is_refused_or_another_sound_view(flip: int) -> None:
    for position in range(len(SMALL_BYTES)):
        broken = bytearray(SMALL_BYTES)
        broken[position] ^= flip
        assert_refused_or_sound(bytes(broken))


@settings(deadline=None)
@given(st.binary(max_size=500))
def test_arbitrary_bytes_are_refused(data: bytes) -> None:
    for candidate in (data, SMALL_BYTES[:1] + data):
        with pytest.raises(WireError):
            decode_view(candidate)


@settings(deadline=None, max_examples=200)
@given(st.binary(max_size=300))
def test_arbitrary_parts_in_a_right_frame_are_refused_or_sound(part: bytes) -> None:
    assert_refused_or_sound(rebuilt(depth=part))
    assert_refused_or_sound(rebuilt(colour=jpeg_of(16, 24)[:-60] + part + b"\xff\xd9"))
    assert_refused_or_sound(rebuilt(colour=(webp_of(16, 24)[:40] + part).ljust(400, b"\0")[: len(webp_of(16, 24))]))


def test_the_golden_view_decodes_to_known_values() -> None:
    view = decode_view(bytes.fromhex(GOLDEN.read_text()))
    assert (view.camera.name, view.camera.width, view.camera.height, view.u0, view.v0) == ("golden", 64, 48, 10, 20)
    assert (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) == (50.0, 51.0, 31.5, 23.5)
    np.testing.assert_array_equal(view.camera.T_world_camera[:3, 3], [1, 2, 3])
    expected = np.zeros((16, 16), np.uint16)
    expected[2:14, 3:13] = 2000 + 10 * np.arange(10)
    np.testing.assert_array_equal(view.depth_mm, expected)
    np.testing.assert_allclose(view.colour[2:14, 3:13], np.full((12, 10, 3), (200, 100, 50)), atol=3)
