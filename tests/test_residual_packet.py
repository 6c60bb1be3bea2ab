"""The residual packet: every field comes back, the layout is not sent, and nothing corrupt gets through."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.cylindrical_map import LinkMaps
from common.wire.header import RESIDUAL_VERSION, WireError
from common.wire.map_codec import MapQuality, reference_of
from common.wire.residual_packet import (
    RESIDUAL_MAX_BYTES,
    ResidualHeader,
    decode_residual,
    decode_residual_header,
    encode_residual,
    needed_packets,
)
from tests.posed_cloud import BODY
from tests.test_map_codec import LAYOUT, MAPS

GOLDEN = Path(__file__).parent / "golden" / "residual_packet.hex"
KIND_AT, REFERENCE_AT, CAPTURE_AT, POINTS_AT, LEVEL_AT, JPEG_AT, RADIUS_AT, SIZES_AT = 1, 12, 20, 28, 32, 34, 35, 36
KEY = ResidualHeader(3, 70_000, 41, "key", 41, 1234, 7, 5_000_000_123, 2000, 50.0, MapQuality(70, 3))
KEY_BYTES = encode_residual(KEY, LAYOUT, MAPS, None)
RECEIVED = reference_of(decode_residual(KEY_BYTES, LAYOUT, None))


def checksummed(body: bytes) -> bytes:
    return body + struct.pack("<I", zlib.crc32(body))


def patched(at: int, layout: str, value: int) -> bytes:
    body = bytearray(KEY_BYTES[:-4])
    struct.pack_into(layout, body, at, value)
    return checksummed(bytes(body))


def small_maps() -> LinkMaps:
    """A few cells, set by rule."""
    full = np.zeros((LAYOUT.height, LAYOUT.width), np.bool_)
    full[2:6, 3:9] = True
    v, u = np.indices(full.shape)
    colour = np.stack([20 * u, 30 * v, 100 + 0 * u], -1).astype(np.uint8)
    return LinkMaps(
        full, np.where(full[..., None], colour, np.uint8(0)), np.where(full, 20 + v + u, 0).astype(np.uint8)
    )


@pytest.mark.parametrize(
    "header",
    [
        KEY,
        replace(KEY, kind="model", sequence=55, quality=MapQuality(1, 16, "png")),
        replace(KEY, kind="previous", sequence=42, level=50.0, person=255, body_revision=255),
    ],
)
def test_every_field_comes_back(header: ResidualHeader) -> None:
    reference = None if header.kind == "key" else RECEIVED
    data = encode_residual(header, LAYOUT, MAPS, reference)
    assert decode_residual_header(data) == header
    np.testing.assert_array_equal(decode_residual(data, header.layout(BODY), reference).full, MAPS.full)


def test_the_bytes_are_those_of_the_golden_packet() -> None:
    data = encode_residual(replace(KEY, quality=MapQuality(70, 2)), LAYOUT, small_maps(), None)
    golden = bytes.fromhex(GOLDEN.read_text())
    assert data[:48] == golden[:48]
    maps = decode_residual(golden, LAYOUT, None)
    np.testing.assert_array_equal(maps.full, small_maps().full)
    np.testing.assert_array_equal(maps.radius, decode_residual(data, LAYOUT, None).radius)


@settings(deadline=None, max_examples=60)
@given(st.floats(1.0, 100.0))
def test_a_level_of_hundredths_gives_both_ends_the_same_grids(level: float) -> None:
    ours = replace(KEY, level=round(level, 2))
    body = bytearray(KEY_BYTES[:-4])
    struct.pack_into("<H", body, LEVEL_AT, round(ours.level * 100))
    theirs = decode_residual_header(checksummed(bytes(body)))
    assert theirs.level == ours.level
    np.testing.assert_array_equal(theirs.layout(BODY).places, ours.layout(BODY).places)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty"),
        (b"\x11" + KEY_BYTES[1:], "version byte 0x11"),
        (bytes([0x61]) * (RESIDUAL_MAX_BYTES + 1), "at most"),
        (KEY_BYTES[:30], "fewer than its header"),
        (KEY_BYTES[:-1] + b"\x00", "checksum"),
        (checksummed(KEY_BYTES[:-8]), "its sections have"),
        (patched(KIND_AT, "B", 4), "kind"),
        (patched(KIND_AT, "B", 1), "model packet 41 refers to 41"),
        (patched(REFERENCE_AT, "<I", 40), "key packet 41 refers to 40"),
        (patched(CAPTURE_AT, "<q", -1), "capture time"),
        (patched(POINTS_AT, "<I", 2_000_000_000), "points"),
        (patched(LEVEL_AT, "<H", 50), "level"),
        (patched(LEVEL_AT, "<H", 10_001), "level"),
        (patched(JPEG_AT, "B", 0), "JPEG quality"),
        (patched(RADIUS_AT, "B", 0), "radius steps"),
        (patched(RADIUS_AT, "B", 17), "radius steps"),
        (patched(RADIUS_AT, "B", 2 << 5 | 1), "radius coding"),
        (patched(SIZES_AT, "<I", 0xFFFFFFFF), "its sections have"),
    ],
)
def test_what_no_encoder_writes_is_refused_with_the_reason(data: bytes, reason: str) -> None:
    with pytest.raises(WireError, match=reason):
        decode_residual_header(data)


def test_a_reference_must_be_there_exactly_where_it_belongs_and_fit() -> None:
    difference = encode_residual(replace(KEY, kind="model", sequence=42), LAYOUT, MAPS, RECEIVED)
    with pytest.raises(WireError, match="without a reference"):
        decode_residual(difference, LAYOUT, None)
    with pytest.raises(WireError, match="with a reference"):
        decode_residual(KEY_BYTES, LAYOUT, RECEIVED)
    other = LinkMaps(np.zeros((8, 8), np.bool_), np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8), np.uint8))
    with pytest.raises(WireError, match="another layout"):
        decode_residual(difference, LAYOUT, other)


@pytest.mark.parametrize(
    "wrong", [{"person": 256}, {"sequence": 1 << 32}, {"capture_ns": -1}, {"quality": MapQuality(101, 3)}]
)
def test_numbers_that_do_not_fit_are_not_sent(wrong: dict[str, object]) -> None:
    with pytest.raises(WireError):
        encode_residual(replace(KEY, **wrong), LAYOUT, MAPS, None)  # type: ignore[arg-type]


@settings(deadline=None, max_examples=120)
@given(at=st.integers(0, 47), value=st.integers(0, 255), cut=st.integers(0, 4000))
def test_a_changed_or_cut_packet_decodes_to_its_layout_or_is_refused(at: int, value: int, cut: int) -> None:
    body = bytearray(KEY_BYTES[:-4])
    body[at] = value
    data = checksummed(bytes(body[: max(1, len(body) - (cut if cut % 2 else 0))]))
    try:
        header = decode_residual_header(data)
        if header.points > 5000:
            return  # a receiver refuses that many by its own bound
        layout = header.layout(BODY)
        maps = decode_residual(data, layout, None)
    except WireError:
        return
    assert maps.full.shape == (layout.height, layout.width)


@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=200))
def test_noise_is_refused(data: bytes) -> None:
    for noise in (data, b"\x61" + data, checksummed(b"\x61" + data)):
        with pytest.raises(WireError):
            decode_residual(noise, LAYOUT, None)


def test_of_packets_that_wait_only_those_the_newest_needs_are_decoded() -> None:
    def packet(kind: int, number: int) -> bytes:
        return bytes([RESIDUAL_VERSION, kind, number])

    key, later_key = packet(0, 0), packet(0, 9)
    models = [packet(1, number) for number in range(4)]
    chain = [packet(2, number) for number in range(3)]
    assert needed_packets([key]) == [key]
    assert needed_packets(models) == models[-1:]
    assert needed_packets([models[0], key, *models[1:]]) == [key, models[-1]]
    assert needed_packets([key, *models, later_key]) == [later_key]
    assert needed_packets([models[0], key, *chain]) == [key, *chain]
    assert needed_packets(chain) == chain
    junk = [b"", b"junk", bytes([RESIDUAL_VERSION]), bytes([RESIDUAL_VERSION, 77])]
    assert needed_packets([key, *junk]) == [key, *junk]
