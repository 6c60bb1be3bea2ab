"""The candidate pose: self-contained, the same at both ends, bounded, and only ``WireError`` for anything else."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.rigging import Rigging, Segmentation, Views
from common.body.skeleton import LINK_COUNT, human_skeleton
from common.body.skeleton_pose import SkeletonPose, rest_pose
from common.body.view import View
from common.geometry import quaternion
from common.geometry.camera_model import Camera
from common.geometry.rigid_transform import look_at
from common.wire import candidate_pose
from common.wire.body_message import quantized_skeleton
from common.wire.candidate_pose import (
    CANDIDATE_POSE_MAX_BYTES,
    MAX_VIEWS,
    CandidatePose,
    decode_candidate_pose,
    encode_candidate_pose,
)
from common.wire.header import WireError
from common.wire.skeleton_packet import SkeletonPacket, decode_skeleton, encode_skeleton
from common.wire.view_codec import encode_view
from common.wire.view_quality import ViewQuality

GOLDEN = Path(__file__).parent / "golden" / "candidate_pose.hex"
FIXED_BYTES = 20 + 322 + 155
RIGGING_AT, VIEW_COUNT_AT, SKELETON_AT, POSE_AT = 18, 19, 20, 20 + 322


def some_view(index: int = 0, height: int = 16, width: int = 24) -> View:
    eye = np.array([2.5 * np.sin(index), 1.2, 2.5 * np.cos(index)])
    camera = Camera(f"cam{index + 1}", 640, 480, 525, 525, 320, 240, look_at(eye, np.array([0, 0.9, 0])))
    depth = np.zeros((height, width), np.uint16)
    depth[2:-2, 3:-3] = 2400 + index + np.arange(width - 6)
    return View(camera, 100 + index, 200, depth, np.full((height, width, 3), 60 + 10 * index, np.uint8))


def some_candidate(views: int = 2) -> CandidatePose:
    rng = np.random.default_rng(3)
    rotations = quaternion.from_rotation_vector(rng.normal(0, 0.5, (LINK_COUNT, 3))).astype(np.float32)
    pose = SkeletonPose(np.array([0.1, 0.95, -0.2], np.float32), rotations, np.ones(LINK_COUNT, np.float32))
    captured = tuple(some_view(index) for index in range(views))
    return CandidatePose(4_000_000_000, 1, 77, 123_456_789_012, human_skeleton(1.783), pose, captured)


CANDIDATE = some_candidate()
DATA = encode_candidate_pose(CANDIDATE)


def with_views(*views: bytes) -> bytes:
    """The fixed part of ``DATA`` with other view bytes."""
    count = bytes([len(views)])
    parts = b"".join(struct.pack("<I", len(view)) + view for view in views)
    return DATA[:VIEW_COUNT_AT] + count + DATA[SKELETON_AT:FIXED_BYTES] + parts


def test_a_candidate_comes_back() -> None:
    decoded = decode_candidate_pose(DATA)
    for field in ("pose_id", "person", "epoch", "capture_ns"):
        assert getattr(decoded, field) == getattr(CANDIDATE, field)
    assert [view.camera.name for view in decoded.views] == ["cam1", "cam2"]
    for view, sent in zip(decoded.views, CANDIDATE.views, strict=True):
        assert np.abs(view.depth_mm.astype(int) - sent.depth_mm).max() <= 1
        np.testing.assert_array_equal(view.camera.T_world_camera, sent.camera.T_world_camera)
        assert np.abs(view.colour.astype(int) - sent.colour)[sent.depth_mm > 0].max() <= 3


def test_its_skeleton_and_pose_are_those_of_body_message_and_skeleton_packet() -> None:
    decoded = decode_candidate_pose(DATA)
    packet = decode_skeleton(encode_skeleton(SkeletonPacket(1, 77, 0, 0, 0, 1.0, CANDIDATE.pose)))
    for field in ("root_position", "rotations", "confidence"):
        np.testing.assert_array_equal(getattr(decoded.pose, field), getattr(packet.pose, field))
    body = quantized_skeleton(CANDIDATE.skeleton)
    for field in ("offsets", "tips", "radii"):
        np.testing.assert_array_equal(getattr(decoded.skeleton, field), getattr(body, field))


@pytest.mark.parametrize("segmentation", ["voronoi", "region-growing"])
@pytest.mark.parametrize("views", ["separate", "zippered"])
def test_how_it_is_rigged_comes_with_it(segmentation: Segmentation, views: Views) -> None:
    sent = replace(CANDIDATE, rigging=Rigging(segmentation, views))
    assert decode_candidate_pose(encode_candidate_pose(sent)).rigging == sent.rigging


def test_settings_reach_the_views() -> None:
    coarse = encode_candidate_pose(CANDIDATE, ViewQuality("webp", 40, 4))
    assert b"RIFF" in coarse
    wrong = np.abs(decode_candidate_pose(coarse).views[0].depth_mm.astype(int) - CANDIDATE.views[0].depth_mm)
    assert wrong.max() == 4


def test_the_most_views_fit_and_one_more_is_refused() -> None:
    assert len(decode_candidate_pose(encode_candidate_pose(some_candidate(MAX_VIEWS))).views) == MAX_VIEWS
    with pytest.raises(WireError, match="number of views"):
        encode_candidate_pose(some_candidate(MAX_VIEWS + 1))
    with pytest.raises(WireError, match="number of views"):
        encode_candidate_pose(replace(CANDIDATE, views=()))
    view = encode_view(CANDIDATE.views[0])
    for count in (0, MAX_VIEWS + 1):
        with pytest.raises(WireError, match="number of views"):
            decode_candidate_pose(with_views(*[view] * count))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("pose_id", 2**32),
        ("pose_id", -1),
        ("person", 256),
        ("epoch", 2**32),
        ("capture_ns", -1),
        ("capture_ns", 2**63),
        ("pose", rest_pose(np.array([100.0, 0, 0]))),
        ("skeleton", human_skeleton(30.0)),
    ],
)
def test_values_without_an_encoding_are_refused(field: str, value: object) -> None:
    with pytest.raises(WireError):
        encode_candidate_pose(replace(CANDIDATE, **{field: value}))  # type: ignore[arg-type]


def test_more_bytes_than_allowed_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert CANDIDATE_POSE_MAX_BYTES == 4 * 1024 * 1024
    with pytest.raises(WireError, match="at most 4194304"):
        decode_candidate_pose(DATA[:1] + bytes(CANDIDATE_POSE_MAX_BYTES))
    monkeypatch.setattr(candidate_pose, "CANDIDATE_POSE_MAX_BYTES", len(DATA) - 1)
    with pytest.raises(WireError, match="bytes, at most"):
        encode_candidate_pose(CANDIDATE)


def test_pixels_of_all_views_together_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    assert candidate_pose.MAX_PIXELS == 8 * 1024 * 1024
    monkeypatch.setattr(candidate_pose, "MAX_PIXELS", 2 * 16 * 24 - 1)
    with pytest.raises(WireError, match="more than 767 pixels"):
        encode_candidate_pose(CANDIDATE)
    with pytest.raises(WireError, match="at most 383 are"):
        decode_candidate_pose(DATA)


@pytest.mark.parametrize("length", [len(encode_view(CANDIDATE.views[0])) + 1, 2**31, 2**32 - 1])
def test_view_lengths_beyond_the_data_are_refused(length: int) -> None:
    data = bytearray(with_views(encode_view(CANDIDATE.views[0])))
    struct.pack_into("<I", data, FIXED_BYTES, length)
    with pytest.raises(WireError, match="longer than the data"):
        decode_candidate_pose(bytes(data))


def test_bytes_after_the_last_view_are_refused() -> None:
    with pytest.raises(WireError, match="1 bytes after"):
        decode_candidate_pose(DATA + b"\0")


@pytest.mark.parametrize(
    ("at", "content", "reason"),
    [
        (0, b"\x31", "version byte 0x31"),
        (10, struct.pack("<q", -5), "capture time"),
        *((RIGGING_AT, bytes([1 << bit]), "rigging") for bit in range(2, 8)),
        (SKELETON_AT + 12, b"\0\0", "radius"),
        (POSE_AT, b"\xff" * 155, "rotation|padding"),
        (FIXED_BYTES + 4, b"\x41", "version byte 0x41"),
    ],
)
def test_content_no_encoder_writes_is_refused_by_name(at: int, content: bytes, reason: str) -> None:
    data = bytearray(DATA)
    data[at : at + len(content)] = content
    with pytest.raises(WireError, match=reason):
        decode_candidate_pose(bytes(data))


def test_every_truncated_candidate_is_refused() -> None:
    for length in range(len(DATA)):
        with pytest.raises(WireError):
            decode_candidate_pose(DATA[:length])


def assert_refused_or_sound(data: bytes) -> None:
    try:
        decoded = decode_candidate_pose(data)
    except WireError:
        return
    assert 1 <= len(decoded.views) <= MAX_VIEWS
    np.testing.assert_allclose(np.linalg.norm(decoded.pose.rotations, axis=1), 1, atol=1e-6)
    assert (decoded.skeleton.radii > 0).all()


def test_every_flipped_byte_is_refused_or_another_sound_candidate() -> None:
    for position in range(len(DATA)):
        broken = bytearray(DATA)
        broken[position] ^= 0xFF
        assert_refused_or_sound(bytes(broken))


@settings(deadline=None)
@given(st.binary(max_size=800))
def test_arbitrary_bytes_are_refused(data: bytes) -> None:
    for candidate in (data, DATA[:1] + data, DATA[:FIXED_BYTES] + data):
        with pytest.raises(WireError):
            decode_candidate_pose(candidate)


@settings(deadline=None, max_examples=200)
@given(st.lists(st.tuples(st.integers(0, len(DATA) - 1), st.integers(0, 255)), min_size=1, max_size=8))
def test_several_changed_bytes_are_refused_or_another_sound_candidate(changes: list[tuple[int, int]]) -> None:
    broken = bytearray(DATA)
    for position, byte in changes:
        broken[position] = byte
    assert_refused_or_sound(bytes(broken))


def test_the_golden_candidate_decodes_to_known_values() -> None:
    decoded = decode_candidate_pose(bytes.fromhex(GOLDEN.read_text()))
    assert (decoded.pose_id, decoded.person, decoded.epoch, decoded.capture_ns) == (9, 1, 2, 3_000_000_000)
    assert decoded.rigging == Rigging("region-growing")
    np.testing.assert_allclose(decoded.skeleton.offsets[6], [0.1584, -0.0144, 0], atol=1e-6)  # left upper arm, 1.8 m
    np.testing.assert_allclose(decoded.pose.root_position, [0.5, 0.95, -0.25], atol=1e-7)
    np.testing.assert_array_equal(decoded.pose.rotations, np.tile([1, 0, 0, 0], (LINK_COUNT, 1)))
    assert [view.camera.name for view in decoded.views] == ["golden", "golden"]
    assert decoded.views[0].depth_mm[2, 3] == 2000
    np.testing.assert_allclose(decoded.views[1].colour[2:14, 3:13], np.full((12, 10, 3), (200, 100, 50)), atol=3)
