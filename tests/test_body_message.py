"""The body message: sizes survive to half a step, and bombs and nonsense are refused cheaply."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.skeleton import Skeleton, human_skeleton
from common.wire.body_message import (
    BODY_MAX_BYTES,
    SIZE_STEP_M,
    SKELETON_BYTES,
    BodyMessage,
    decode_body,
    decode_skeleton_sizes,
    encode_body,
    encode_skeleton_sizes,
    quantized_skeleton,
)
from common.wire.header import BODY_VERSION, WireError

GOLDEN = Path(__file__).parent / "golden" / "body_message.hex"
BODY = BodyMessage(2, 4_000_000_000, 17, human_skeleton(1.75), 30.0)


def message(*fields: object) -> bytes:
    return bytes([BODY_VERSION]) + msgpack.packb(list(fields))


def assert_same_skeleton(a: Skeleton, b: Skeleton) -> None:
    for field in ("offsets", "tips", "radii"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


@settings(deadline=None)
@given(st.floats(0.5, 2.5))
def test_sizes_keep_to_half_a_step(stature_m: float) -> None:
    skeleton = human_skeleton(stature_m)
    decoded = quantized_skeleton(skeleton)
    for field in ("offsets", "tips", "radii"):
        assert np.abs(getattr(decoded, field) - getattr(skeleton, field)).max() <= SIZE_STEP_M / 2 + 1e-7


def test_quantizing_twice_changes_nothing() -> None:
    once = quantized_skeleton(human_skeleton(1.813))
    assert_same_skeleton(quantized_skeleton(once), once)


def test_a_message_comes_back_with_the_quantized_skeleton() -> None:
    data = encode_body(BODY)
    decoded = decode_body(data)
    assert len(data) < 400
    assert (decoded.person, decoded.epoch, decoded.revision, decoded.frame_rate_hz) == (2, 4_000_000_000, 17, 30.0)
    assert_same_skeleton(decoded.skeleton, quantized_skeleton(BODY.skeleton))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("person", 256),
        ("person", True),
        ("epoch", -1),
        ("revision", 1.0),
        ("frame_rate_hz", float("nan")),
        ("frame_rate_hz", float("inf")),
        ("frame_rate_hz", 0.0),
        ("frame_rate_hz", 1e300),
        ("skeleton", human_skeleton(20.0)),
        ("skeleton", human_skeleton(0.001)),
    ],
)
def test_values_without_an_encoding_are_refused(field: str, value: object) -> None:
    with pytest.raises(WireError):
        encode_body(replace(BODY, **{field: value}))  # type: ignore[arg-type]


GOOD = (2, 5, 17, 30.0, encode_skeleton_sizes(BODY.skeleton))


@pytest.mark.parametrize(
    ("index", "value", "reason"),
    [
        (0, 256, "person"),
        (0, True, "person"),
        (1, -1, "epoch"),
        (2, "17", "body revision"),
        (3, float("nan"), "frame rate"),
        (3, 1e9, "frame rate"),
        (3, None, "frame rate"),
        (4, "text", "expected bytes"),
        (4, b"", "0 bytes"),
        (4, bytes(SKELETON_BYTES), "radius"),
        (4, b"\xff" * SKELETON_BYTES, "radius"),
    ],
)
def test_a_field_of_another_type_or_range_is_refused_by_name(index: int, value: object, reason: str) -> None:
    assert decode_body(message(*GOOD)).person == 2
    with pytest.raises(WireError, match=reason):
        decode_body(message(*GOOD[:index], value, *GOOD[index + 1 :]))


@pytest.mark.parametrize("fields", [(), GOOD[:4], (*GOOD, 1)])
def test_another_number_of_fields_is_refused(fields: tuple[object, ...]) -> None:
    with pytest.raises(WireError, match="array of 5 fields"):
        decode_body(message(*fields))


BOMBS = {
    "nesting": b"\x91" * 10_000,
    "nested wide arrays": b"\xdc\x01\x00" * 5_000,
    "huge array": b"\xdd\xff\xff\xff\xff",
    "array above the bound": b"\xdc\x01\x01" + b"\x00" * 257,
    "huge map": b"\xdf\xff\xff\xff\xff",
    "small map": b"\x81\x01\x01",
    "huge string": b"\x95\xdb\xff\xff\xff\xff",
    "huge bytes": b"\x95\xc6\xff\xff\xff\xff",
    "bytes above the bound": b"\x95\xc6\x00\x00\x20\x00" + b"\x00" * 0x2000,
    "string above the bound": b"\x95\xd9\x41" + b"a" * 0x41,
    "huge extension": b"\x95\xc9\xff\xff\xff\xff\x05",
    "timestamp": b"\xd6\xff\x00\x00\x00\x00",
    "extension": b"\x95\xd4\x05\x00\x01\x01\x01\x01",
    "empty extension": b"\x95\xc7\x00\x05\x01\x01\x01\x01",
    "empty timestamp": b"\x95\xc7\x00\xff\x01\x01\x01\x01",
    "no UTF-8": b"\x95\xa2\xff\xff\x01\x01\x01\x01",
    "unused code": b"\xc1",
    "integer instead of an array": b"\x05",
    "trailing bytes": msgpack.packb(list(GOOD)) + b"\x00",
}


@pytest.mark.parametrize("bomb", BOMBS.values(), ids=BOMBS.keys())
def test_msgpack_bombs_are_refused_without_allocation(bomb: bytes) -> None:
    data = bytes([BODY_VERSION]) + bomb
    tracemalloc.start()
    try:
        with pytest.raises(WireError):
            decode_body(data)
        assert tracemalloc.get_traced_memory()[1] < 4_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("bomb", "bound"),
    [("array above the bound", "max_array_len"), ("small map", "max_map_len"), ("extension", "max_ext_len"),
     ("bytes above the bound", "max_bin_len"), ("string above the bound", "max_str_len")],
)  # fmt: skip
def test_bombs_fail_at_our_bounds_and_not_only_for_want_of_data(bomb: str, bound: str) -> None:
    with pytest.raises(WireError, match=bound):
        decode_body(bytes([BODY_VERSION]) + BOMBS[bomb])


def test_empty_oversized_and_foreign_messages_are_refused() -> None:
    with pytest.raises(WireError, match="empty"):
        decode_body(b"")
    with pytest.raises(WireError, match="at most"):
        decode_body(bytes([BODY_VERSION]) + bytes(BODY_MAX_BYTES))
    with pytest.raises(WireError, match="version byte 0x51"):
        decode_body(b"\x51" + encode_body(BODY)[1:])


def test_every_truncated_message_is_refused() -> None:
    data = encode_body(BODY)
    for length in range(len(data)):
        with pytest.raises(WireError):
            decode_body(data[:length])


def test_every_flipped_byte_is_refused_or_another_sound_message() -> None:
    data = encode_body(BODY)
    for position in range(len(data)):
        broken = bytearray(data)
        broken[position] ^= 0xFF
        try:
            decoded = decode_body(bytes(broken))
        except WireError:
            continue
        assert (decoded.skeleton.radii > 0).all()
        assert np.abs(decoded.skeleton.offsets).max() < 3.3


@settings(deadline=None)
@given(st.binary(max_size=400))
def test_arbitrary_bytes_are_refused(data: bytes) -> None:
    for candidate in (data, bytes([BODY_VERSION]) + data):
        with pytest.raises(WireError):
            decode_body(candidate)


@settings(deadline=None)
@given(st.binary(min_size=SKELETON_BYTES, max_size=SKELETON_BYTES))
def test_arbitrary_sizes_are_refused_or_a_sound_skeleton(data: bytes) -> None:
    try:
        skeleton = decode_skeleton_sizes(data)
    except WireError:
        return
    assert encode_skeleton_sizes(skeleton) == data


def test_the_golden_message_decodes_to_known_values_and_is_what_we_encode() -> None:
    golden = bytes.fromhex(GOLDEN.read_text())
    decoded = decode_body(golden)
    assert (decoded.person, decoded.epoch, decoded.revision, decoded.frame_rate_hz) == (1, 2, 3, 30.0)
    np.testing.assert_allclose(decoded.skeleton.offsets[6], [0.1584, -0.0144, 0], atol=1e-6)  # left upper arm, 1.8 m
    assert encode_body(BodyMessage(1, 2, 3, human_skeleton(1.8), 30.0)) == golden
