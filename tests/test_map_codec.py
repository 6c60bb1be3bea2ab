"""Maps as bytes: what is exact, what is near, and that bytes from anywhere give maps of the right size or an error."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.cylindrical_map import LinkMaps, closed, project_points
from common.body.map_layout import map_layout
from common.body.skeleton_pose import forward_kinematics
from common.wire.header import WireError
from common.wire.map_codec import MapQuality, MapSections, decode_maps, encode_maps, reference_of
from tests.capsule_person import pose_at
from tests.posed_cloud import BODY, posed_cloud

LAYOUT = map_layout(BODY, 2000, 50.0)
FINE = MapQuality(90, 1)


def some_maps(seed: int = 0, noise_m: float = 0.0) -> LinkMaps:
    cloud, links = posed_cloud(pose_at(0.3), 3000, noise_m, seed)
    T_world_link = forward_kinematics(BODY, pose_at(0.3))
    return closed(LAYOUT, project_points(LAYOUT, T_world_link, links, cloud.positions, cloud.colours))


MAPS = some_maps()
SECTIONS = encode_maps(LAYOUT, MAPS, FINE)
REFERENCE = reference_of(decode_maps(LAYOUT, SECTIONS, FINE))


@pytest.mark.parametrize("coding", ["huffman", "png"])
@pytest.mark.parametrize("reference", [None, REFERENCE], ids=["whole", "difference"])
@pytest.mark.parametrize("steps", [1, 2, 3, 16])
def test_occupancy_is_exact_and_radii_are_off_by_half_a_step(
    coding: str, reference: LinkMaps | None, steps: int
) -> None:
    maps, quality = some_maps(1, 0.01), MapQuality(80, steps, coding)
    back = decode_maps(LAYOUT, encode_maps(LAYOUT, maps, quality, reference), quality, reference)
    np.testing.assert_array_equal(back.full, maps.full)
    off = np.abs(back.radius.astype(int) - maps.radius)
    assert off.max() <= steps / 2
    assert not back.radius[~back.full].any()
    assert not back.colour[~back.full].any()


def test_radii_beyond_the_largest_step_stay_the_largest() -> None:
    maps = LinkMaps(MAPS.full, MAPS.colour, np.where(MAPS.full, np.uint8(255), np.uint8(0)))
    quality = MapQuality(80, 4)
    assert decode_maps(LAYOUT, encode_maps(LAYOUT, maps, quality), quality).radius[MAPS.full].min() == 255


@pytest.mark.parametrize("reference", [None, REFERENCE], ids=["whole", "difference"])
def test_smooth_colours_are_near_up_to_the_edge_of_the_void(reference: LinkMaps | None) -> None:
    v, u = np.indices(MAPS.full.shape)
    smooth = np.stack([60 + v // 2, 180 - u // 2, 120 + 0 * u], -1).astype(np.uint8)
    if reference is not None:  # as far from it everywhere
        smooth = np.clip(reference.colour.astype(int) + smooth // 4 - 30, 0, 255).astype(np.uint8)
    maps = LinkMaps(MAPS.full, np.where(MAPS.full[..., None], smooth, np.uint8(0)), MAPS.radius)
    back = decode_maps(LAYOUT, encode_maps(LAYOUT, maps, FINE, reference), FINE, reference)
    off = np.abs(back.colour.astype(int) - maps.colour).mean(axis=2)
    edge = MAPS.full & (cv2.erode(MAPS.full.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    assert off[MAPS.full].mean() < 3
    assert off[edge].mean() < 3


def test_the_same_surface_again_costs_less_as_a_difference() -> None:
    again = encode_maps(LAYOUT, MAPS, FINE, REFERENCE)
    assert again.radius_differs
    assert len(again.colour) < len(SECTIONS.colour) / 2
    assert len(again.radius) < len(SECTIONS.radius) / 2


def test_noisy_radii_are_not_sent_as_differences_when_these_are_longer() -> None:
    smooth, rough = some_maps(0), some_maps(1, 0.02)
    reference = reference_of(rough)
    assert not encode_maps(LAYOUT, smooth, FINE, reference).radius_differs


def test_a_mask_of_its_own_is_shorter_than_holes_in_a_png() -> None:
    holes = len(cv2.imencode(".png", MAPS.full.astype(np.uint8))[1])
    assert len(SECTIONS.occupancy) < holes


def replaced(**parts: bytes) -> MapSections:
    names = ("occupancy", "radius", "colour")
    return MapSections(*(parts.get(name, getattr(SECTIONS, name)) for name in names))


def deflated(data: bytes) -> bytes:
    coder = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    return coder.compress(data) + coder.flush()


def png(width: int, height: int, extra: bytes = b"") -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    rows = zlib.compress(bytes((width + 1) * height))
    return b"\x89PNG\r\n\x1a\n" + head + extra + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("sections", "reason"),
    [
        (replaced(occupancy=b""), "occupancy: 0 bytes"),
        (replaced(occupancy=SECTIONS.occupancy[:-1]), "occupancy|radius"),
        (replaced(occupancy=SECTIONS.occupancy + b"more"), "occupancy"),
        (replaced(radius=deflated(bytes(1 << 26))), "not exactly"),
        (replaced(radius=SECTIONS.radius[:-3]), "radius"),
        (replaced(radius=SECTIONS.radius + b"more"), "radius"),
        (replaced(colour=SECTIONS.colour + b"\xff\xd9\xff\xd8"), "a marker within the scan"),
        (replaced(colour=SECTIONS.colour + b"\xff"), "a marker within the scan"),
        (MapSections(SECTIONS.occupancy, SECTIONS.radius, SECTIONS.colour, radius_differs=True), "without a reference"),
    ],
)
def test_what_no_encoder_writes_is_refused_cheaply(sections: MapSections, reason: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(WireError, match=reason):
            decode_maps(LAYOUT, sections, FINE)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("radius", "reason"),
    [
        (png(8192, 8192), "not a grey PNG"),
        (png(LAYOUT.width, LAYOUT.height, struct.pack(">I", 4) + b"zTXt" + b"abcdefgh"), "chunk where our encoder"),
        (png(LAYOUT.width, LAYOUT.height)[:40], "PNG"),
        (b"", "not a grey PNG"),
    ],
)
def test_only_a_plain_png_of_the_right_size_is_decoded(radius: bytes, reason: str) -> None:
    with pytest.raises(WireError, match=reason):
        decode_maps(LAYOUT, replaced(radius=radius), MapQuality(90, 1, "png"))


@settings(deadline=None, max_examples=150)
@given(
    section=st.sampled_from(["occupancy", "radius", "colour"]),
    at=st.integers(0, 10_000),
    garbage=st.binary(max_size=40),
    coding=st.sampled_from(["huffman", "png"]),
)
def test_garbage_in_a_section_gives_maps_of_the_right_size_or_one_error(
    section: str, at: int, garbage: bytes, coding: str
) -> None:
    quality = MapQuality(90, 1, coding)
    whole = encode_maps(LAYOUT, MAPS, quality)
    data = getattr(whole, section)
    cut = data[: at % (len(data) + 1)] + garbage
    parts = {"occupancy": whole.occupancy, "radius": whole.radius, "colour": whole.colour, section: cut}
    try:
        maps = decode_maps(LAYOUT, MapSections(**parts), quality)
    except WireError:
        return
    assert maps.full.shape == maps.radius.shape == (LAYOUT.height, LAYOUT.width)
    assert maps.colour.shape == (LAYOUT.height, LAYOUT.width, 3)
