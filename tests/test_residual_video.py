"""Frames' maps as a short video: they come back near, a group needs no other, and hostile bytes are refused cheaply."""

from __future__ import annotations

import struct
import sys
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.cylindrical_map import LinkMaps, closed, project_points
from common.body.map_layout import MapLayout
from common.body.skeleton_pose import forward_kinematics
from common.wire.header import WireError
from common.wire.map_codec import MapQuality, MapSections
from common.wire.residual_packet import ResidualHeader, decode_residual, encode_residual, packed, parsed
from common.wire.residual_video import (
    FRAMES_MAX,
    GroupFrame,
    VideoUnavailable,
    decode_group,
    encode_group,
    frame_count,
    require_video,
)
from receiver.residual_decoder import ResidualDecoder
from sender.residual_encoder import LONGEST_GROUP_NS, ResidualEncoder, ResidualSettings
from tests.capsule_person import pose_at
from tests.posed_cloud import BODY, posed_cloud
from tests.test_map_codec import LAYOUT
from tests.test_residual_stream import BODIES, FRAME_NS, frame

pytest.importorskip("av")

START_NS = 5_000_000_123
HEADER = ResidualHeader(3, 70_000, 41, "video", 41, 1234, 7, START_NS, 2000, 50.0, MapQuality(60, 3))


def maps_of(k: int, noise_m: float = 0.003) -> LinkMaps:
    pose = pose_at(0.3 + k / 30)
    cloud, links = posed_cloud(pose, 3000, noise_m)
    return closed(LAYOUT, project_points(LAYOUT, forward_kinematics(BODY, pose), links, cloud.positions, cloud.colours))


FRAMES = [GroupFrame(START_NS + k * FRAME_NS, 1234 + k, maps_of(k)) for k in range(4)]
GROUP = encode_group(HEADER, LAYOUT, FRAMES)


def test_frames_come_back_each_with_its_own_header() -> None:
    got = decode_group(GROUP, LAYOUT)
    assert [(h.sequence, h.capture_ns, h.skeleton_sequence) for h, _ in got] == [
        (41 + k, START_NS + k * FRAME_NS, 1234 + k) for k in range(4)
    ]
    for (header, maps), sent in zip(got, FRAMES, strict=True):
        assert replace(header, sequence=41, capture_ns=START_NS, skeleton_sequence=1234) == HEADER
        np.testing.assert_array_equal(maps.full, sent.maps.full)
        off_mm = 2.0 * (maps.radius.astype(int) - sent.maps.radius)[maps.full]
        assert np.sqrt((off_mm**2).mean()) < 5
        assert np.abs(maps.colour.astype(int) - sent.maps.colour)[maps.full].mean() < 12
        assert not maps.radius[~maps.full].any()
        assert not maps.colour[~maps.full].any()
    assert frame_count(GROUP) == 4


def test_a_group_takes_half_of_what_its_frames_take_by_themselves_and_finer_quality_more() -> None:
    key = replace(HEADER, kind="key")
    alone = sum(len(encode_residual(key, LAYOUT, one.maps, None)) for one in FRAMES)
    assert len(GROUP) < alone / 2
    fine = replace(HEADER, quality=MapQuality(90, 1))
    assert len(encode_group(fine, LAYOUT, FRAMES)) > 1.5 * len(GROUP)
    near, nearer = (decode_group(data, LAYOUT)[3][1] for data in (GROUP, encode_group(fine, LAYOUT, FRAMES)))
    truth = FRAMES[3].maps
    for attribute in ("radius", "colour"):
        off = [np.abs(getattr(m, attribute).astype(int) - getattr(truth, attribute)).mean() for m in (near, nearer)]
        assert off[1] < off[0]


def test_a_group_of_one_frame_is_one() -> None:
    assert len(decode_group(encode_group(HEADER, LAYOUT, FRAMES[:1]), LAYOUT)) == 1


def sections(data: bytes = GROUP) -> MapSections:
    return parsed(data)[1]


def other(**parts: bytes) -> bytes:
    """The group with other sections, and a right checksum."""
    own = sections()
    names = ("occupancy", "radius", "colour")
    return packed(HEADER, MapSections(*(parts.get(name, getattr(own, name)) for name in names)))


def units(section: bytes) -> list[bytes]:
    return [b"\0\0\1" + unit for unit in section.split(b"\0\0\1")[1:]]


def of_size(width: int, height: int, count: int = 4) -> bytes:
    """A colour section of pictures of another size."""
    from common.wire.residual_video import _encode_video

    layout = MapLayout(height, width, LAYOUT.places, LAYOUT.cylinders, LAYOUT.sizes, 0.01)
    return _encode_video([np.zeros((height * 3 // 2, width), np.uint8)] * count, "yuv420p", layout, 40)


COLOUR = units(sections().colour)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (GROUP[:-9], "checksum"),
        (other(occupancy=b""), "frames: 0"),
        (other(occupancy=bytes([FRAMES_MAX + 1])), "frames: 31"),
        (other(occupancy=b"\x04abc"), "its table of 4 frames is cut"),
        (other(occupancy=b"\x03" + sections().occupancy[1:]), "occupancy"),
        (other(radius=b""), "radius: not the NAL units"),
        (other(colour=b"junk" + sections().colour), "colour: not the NAL units"),
        (other(colour=b"".join(COLOUR[:-1])), "colour: not the NAL units of 4"),
        (other(colour=b"".join([*COLOUR, COLOUR[-1]])), "colour: not the NAL units of 4"),
        (other(colour=b"".join([COLOUR[0], COLOUR[0], *COLOUR[1:-1]])), "colour: not the NAL units of 4"),
        (other(colour=b"".join([*COLOUR[:3], COLOUR[2], *COLOUR[4:]])), "colour: not the NAL units of 4"),
        (other(colour=b"".join([COLOUR[0][:5], *COLOUR[1:]])), "colour"),
        (other(colour=of_size(LAYOUT.width, LAYOUT.height + 8)), "4 pictures of .*expected 4 of"),
        (other(colour=of_size(2048, 2048)), "colour: .*Invalid data"),  # before there is room for it
        (encode_residual(replace(HEADER, kind="key"), LAYOUT, FRAMES[0].maps, None), "a key packet"),
    ],
)
def test_what_no_encoder_writes_is_refused_cheaply(data: bytes, reason: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(WireError, match=reason):
            decode_group(data, LAYOUT)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_a_group_is_not_decoded_as_one_frame_and_its_size_is_bounded() -> None:
    with pytest.raises(WireError, match="several frames"):
        decode_residual(GROUP, LAYOUT, None)
    with pytest.raises(WireError, match="at most 30 of"):
        encode_group(HEADER, LAYOUT, [FRAMES[0]] * 31)
    huge = replace(LAYOUT, height=2048, width=2048)
    with pytest.raises(WireError, match="frames of 16777216 cells"):
        decode_group(GROUP, huge)
    with pytest.raises(WireError, match="time in the group"):
        encode_group(HEADER, LAYOUT, [FRAMES[0], replace(FRAMES[1], capture_ns=START_NS + 5_000_000_000)])


@settings(deadline=None, max_examples=60)
@given(section=st.sampled_from(["occupancy", "radius", "colour"]), at=st.integers(0, 3000), junk=st.binary(max_size=20))
def test_junk_in_a_section_gives_frames_of_the_right_size_or_one_error(section: str, at: int, junk: bytes) -> None:
    whole = getattr(sections(), section)
    at %= len(whole)
    try:
        got = decode_group(other(**{section: whole[:at] + junk + whole[at + len(junk) :]}), LAYOUT)
    except WireError:
        return
    assert {maps.full.shape for _, maps in got} == {(LAYOUT.height, LAYOUT.width)}
    assert len(got) == 4


@settings(deadline=None, max_examples=40)
@given(at=st.integers(0, 47), value=st.integers(0, 255))
def test_a_changed_header_is_refused_or_decodes_to_its_layout(at: int, value: int) -> None:
    body = bytearray(GROUP[:-4])
    body[at] = value
    data = bytes(body) + struct.pack("<I", zlib.crc32(body))
    try:
        got = ResidualDecoder(3000).decode(data, {7: BODY})
    except WireError:
        return
    assert all(one.maps.full.shape == (one.layout.height, one.layout.width) for one in got)


def test_without_pyav_both_ends_say_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(VideoUnavailable, match=r"pip install '\.\[video\]'"):
        require_video()
    with pytest.raises(WireError, match="need the video extra"):
        decode_group(GROUP, LAYOUT)


def grouped(count: int, ks: range, level: float = 50.0, ours: ResidualEncoder | None = None) -> list[bytes | None]:
    ours = ours or ResidualEncoder(0, 9, ResidualSettings(points=3000, video_frames=count))
    return [ours.encode(frame(k), level) for k in ks]


def test_every_nth_frame_brings_a_group_that_needs_no_other() -> None:
    packets = grouped(4, range(12))
    assert [packet is not None for packet in packets] == [False, False, False, True] * 3
    groups = [packet for packet in packets if packet]
    for joined_late in groups:
        shown = ResidualDecoder().decode(joined_late, BODIES)
        assert len(shown) == 4
    theirs = ResidualDecoder()
    got = theirs.decode(groups[0], BODIES) + theirs.decode(groups[2], BODIES)  # the one between is lost
    assert [one.header.capture_ns for one in got] == [k * FRAME_NS for k in (0, 1, 2, 3, 8, 9, 10, 11)]
    assert [one.header.sequence for one in got] == [0, 1, 2, 3, 8, 9, 10, 11]
    assert theirs.decode(groups[1], BODIES) == []
    assert theirs.late == 1


def test_another_body_or_a_pause_ends_a_group() -> None:
    ours = ResidualEncoder(0, 9, ResidualSettings(points=3000, video_frames=4))
    assert ours.encode(frame(0), 50.0) is None
    assert ours.encode(frame(1), 50.0) is None
    ended = ours.encode(frame(2, revision=6), 50.0)
    assert ended is not None
    assert frame_count(ended) == 2
    later = replace(frame(3, revision=6), capture_ns=2 * FRAME_NS + LONGEST_GROUP_NS)
    alone = ours.encode(later, 50.0)
    assert alone is not None
    assert frame_count(alone) == 1


def test_frames_go_by_themselves_at_level_0_and_where_no_group_is_wanted() -> None:
    ours = ResidualEncoder(0, 9, ResidualSettings(points=3000, video_frames=4))
    model = ours.encode(frame(0), 0.0)
    assert model is not None
    assert parsed(model)[0].kind == "key"
    assert ours.encode(frame(1), 0.0) is None
    assert ours.encode(frame(2), 50.0) is None
    single = ours.encode(frame(3), 50.0, together=False)
    assert single is not None
    assert frame_count(single) == 1
    theirs = ResidualDecoder()
    assert [len(theirs.decode(packet, BODIES)) for packet in (model, single)] == [1, 1]
    assert grouped(4, range(4, 8), ours=ours)[-1] is not None
