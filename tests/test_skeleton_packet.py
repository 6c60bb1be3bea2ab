"""The skeleton packet: 250 bytes, stated errors, one lost frame repeated, and nothing corrupt gets through."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from common.body.skeleton import LINK_COUNT, human_skeleton
from common.body.skeleton_pose import SkeletonPose, joint_positions, rest_pose
from common.geometry import quaternion
from common.wire.header import WireError
from common.wire.quantization import POSITION_STEP_M, ROTATION_ERROR_RAD
from common.wire.skeleton_packet import (
    AGE_STEP_NS,
    CONFIDENCE_STEP,
    FIT_CONFIDENCE_STEP,
    ROTATION_STEP_UNIT_RAD,
    SKELETON_PACKET_BYTES,
    SkeletonPacket,
    decode_skeleton,
    encode_skeleton,
    quantized_pose,
)

GOLDEN = Path(__file__).parent / "golden" / "skeleton_packet.hex"
FLAGS_AT, STEP_AT, CAPTURE_AT = 19, 23, 10


def some_pose(seed: int = 0, turn_rad: float = 1.0) -> SkeletonPose:
    rng = np.random.default_rng(seed)
    turns = rng.normal(0, turn_rad, (LINK_COUNT, 3))
    rotations = quaternion.from_rotation_vector(turns).astype(np.float32)
    position = rng.uniform(-2, 2, 3).astype(np.float32)
    return SkeletonPose(position, rotations, rng.uniform(0, 1, LINK_COUNT).astype(np.float32))


def moved(pose: SkeletonPose, step_m: float, turn_rad: float, seed: int = 1) -> SkeletonPose:
    """The pose with its root moved along each axis and every joint turned about a random axis."""
    axes = np.random.default_rng(seed).normal(size=(LINK_COUNT, 3))
    turns = turn_rad * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    rotations = quaternion.multiply(quaternion.from_rotation_vector(turns), pose.rotations.astype(float))
    return SkeletonPose(
        pose.root_position + np.float32(step_m), rotations.astype(np.float32), np.ones(LINK_COUNT, np.float32)
    )


def some_packet(previous: SkeletonPose | None = None) -> SkeletonPacket:
    return SkeletonPacket(3, 0xDEADBEEF, 123456, 987_654_321_012_345, 7, 0.75, some_pose(), previous, 33_300_000)


def angles(a: SkeletonPose, b: SkeletonPose) -> np.ndarray:
    return quaternion.angle_between(a.rotations.astype(float), b.rotations.astype(float))


def with_checksum(packet: bytes) -> bytes:
    return packet[:-4] + struct.pack("<I", zlib.crc32(packet[:-4]))


def assert_same_pose(a: SkeletonPose, b: SkeletonPose) -> None:
    for field in ("root_position", "rotations", "confidence"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


def test_a_packet_has_250_bytes() -> None:
    assert SKELETON_PACKET_BYTES == 250
    assert len(encode_skeleton(some_packet())) == 250
    assert len(encode_skeleton(some_packet(some_pose(5)))) == 250


def test_numbers_come_back_exactly() -> None:
    decoded = decode_skeleton(encode_skeleton(some_packet()))
    assert (decoded.person, decoded.epoch, decoded.sequence) == (3, 0xDEADBEEF, 123456)
    assert (decoded.capture_ns, decoded.body_revision) == (987_654_321_012_345, 7)
    assert abs(decoded.fit_confidence - 0.75) <= FIT_CONFIDENCE_STEP / 2
    assert decoded.previous is None


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 3))
def test_a_pose_keeps_to_the_stated_errors(seed: int, turn_rad: float) -> None:
    pose = some_pose(seed, turn_rad)
    decoded = decode_skeleton(encode_skeleton(replace(some_packet(), pose=pose))).pose
    assert np.abs(decoded.root_position - pose.root_position).max() <= POSITION_STEP_M / 2 + 1e-6
    assert angles(decoded, pose).max() <= ROTATION_ERROR_RAD + 2e-6
    assert np.abs(decoded.confidence - pose.confidence).max() <= CONFIDENCE_STEP / 2 + 1e-6


def test_joints_move_less_than_half_a_millimetre() -> None:
    skeleton = human_skeleton(1.8)
    for seed in range(50):
        pose = some_pose(seed)
        shift = joint_positions(skeleton, quantized_pose(pose)) - joint_positions(skeleton, pose)
        assert np.linalg.norm(shift, axis=1).max() < 5e-4


def test_quantized_pose_is_what_the_other_end_decodes() -> None:
    for seed in range(20):
        pose = some_pose(seed)
        packet = replace(some_packet(some_pose(99)), pose=pose)
        assert_same_pose(quantized_pose(pose), decode_skeleton(encode_skeleton(packet)).pose)


@pytest.mark.parametrize("turn_rad", [0.0, 0.01, 0.1, 1.0, 3.1])
def test_the_previous_frame_keeps_to_its_stated_error(turn_rad: float) -> None:
    packet = some_packet()
    previous = moved(packet.pose, 0.1, turn_rad)
    decoded = decode_skeleton(encode_skeleton(replace(packet, previous=previous)))
    assert decoded.previous is not None
    step = ROTATION_STEP_UNIT_RAD * max(np.ceil((turn_rad + ROTATION_ERROR_RAD) / 63 / ROTATION_STEP_UNIT_RAD), 1)
    assert angles(decoded.previous, previous).max() <= np.sqrt(3) / 2 * step + 1e-5
    assert np.abs(decoded.previous.root_position - previous.root_position).max() <= POSITION_STEP_M
    np.testing.assert_array_equal(decoded.previous.confidence, decoded.pose.confidence)
    assert abs(decoded.previous_age_ns - 33_300_000) <= AGE_STEP_NS / 2


@pytest.mark.parametrize(("delay_ns", "told_ns"), [(0, 0), (9_300_000, 9_500_000), (10**9, 127_500_000), (-5, 0)])
def test_the_time_from_capture_to_sending_is_told_to_half_a_millisecond(delay_ns: int, told_ns: int) -> None:
    decoded = decode_skeleton(encode_skeleton(replace(some_packet(), send_delay_ns=delay_ns)))
    assert decoded.send_ns - decoded.capture_ns == told_ns


def test_a_fast_frame_repeats_within_three_tenths_of_a_degree() -> None:
    packet = some_packet()
    previous = moved(packet.pose, 0.0, 12 / 30)  # every joint at 12 rad/s, 30 frames/s
    decoded = decode_skeleton(encode_skeleton(replace(packet, previous=previous)))
    assert decoded.previous is not None
    assert angles(decoded.previous, previous).max() < np.deg2rad(0.35)


@pytest.mark.parametrize(
    ("step_m", "age_ns"), [(3.3, 33_000_000), (-3.3, 33_000_000), (0, 256_000_000), (0, -1_000_000)]
)
def test_a_previous_frame_too_far_away_is_left_out(step_m: float, age_ns: int) -> None:
    packet = some_packet()
    far = replace(packet, previous=moved(packet.pose, step_m, 0.1), previous_age_ns=age_ns)
    decoded = decode_skeleton(encode_skeleton(far))
    assert decoded.previous is None
    assert_same_pose(decoded.pose, quantized_pose(packet.pose))


def test_every_truncated_packet_is_refused() -> None:
    data = encode_skeleton(some_packet(some_pose(5)))
    for length in range(len(data)):
        with pytest.raises(WireError):
            decode_skeleton(data[:length])
    with pytest.raises(WireError, match="at most 250"):
        decode_skeleton(data + b"\0")


def test_every_flipped_bit_is_refused() -> None:
    data = encode_skeleton(some_packet(some_pose(5)))
    for bit in range(8 * len(data)):
        broken = bytearray(data)
        broken[bit // 8] ^= 1 << bit % 8
        with pytest.raises(WireError):
            decode_skeleton(bytes(broken))


@settings(deadline=None)
@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(WireError):
        decode_skeleton(data)


@settings(max_examples=300, deadline=None)
@given(st.binary(min_size=249, max_size=249))
def test_a_forged_packet_with_a_right_checksum_is_refused_or_a_sound_pose(body: bytes) -> None:
    try:
        packet = decode_skeleton(with_checksum(b"\x11" + body))
    except WireError:
        return
    for pose in (packet.pose, packet.previous):
        if pose is not None:
            assert_sound(pose)


@settings(max_examples=200, deadline=None)
@given(st.binary(min_size=67, max_size=67), st.integers(0, 255))
def test_a_forged_previous_frame_is_refused_or_a_sound_pose(bits: bytes, step: int) -> None:
    data = bytearray(encode_skeleton(some_packet(some_pose(5))))
    data[STEP_AT] = step
    data[-71:-4] = bits
    try:
        packet = decode_skeleton(with_checksum(bytes(data)))
    except WireError:
        return
    assert packet.previous is not None
    assert_sound(packet.previous)


def assert_sound(pose: SkeletonPose) -> None:
    assert np.isfinite(pose.root_position).all()
    assert np.abs(pose.root_position).max() < 60
    np.testing.assert_allclose(np.linalg.norm(pose.rotations, axis=1), 1, atol=1e-5)
    assert ((pose.confidence >= 0) & (pose.confidence <= 1)).all()


@pytest.mark.parametrize(
    ("at", "content", "reason"),
    [
        (0, b"\x12", "version byte 0x12"),
        (FLAGS_AT, b"\x02", "unknown flags"),
        (STEP_AT, b"\xff", "rotation step"),
        (CAPTURE_AT, struct.pack("<q", -1), "capture time"),
        (CAPTURE_AT, struct.pack("<q", 2**63 - 1), "capture time"),
        (-5, b"\xff", "padding"),
        (24, b"\xff" * 155, "rotation components|padding"),
    ],
)
def test_content_no_encoder_writes_is_refused_by_name(at: int, content: bytes, reason: str) -> None:
    data = bytearray(encode_skeleton(some_packet(some_pose(5))))
    at %= len(data)
    data[at : at + len(content)] = content
    with pytest.raises(WireError, match=reason):
        decode_skeleton(with_checksum(bytes(data)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("person", 256),
        ("epoch", 2**32),
        ("sequence", -1),
        ("capture_ns", -1),
        ("capture_ns", 2**63),
        ("body_revision", 256),
        ("fit_confidence", float("nan")),
        ("fit_confidence", 1.5),
        ("pose", rest_pose(np.array([0, 60.0, 0]))),
    ],
)
def test_values_without_an_encoding_are_refused(field: str, value: object) -> None:
    with pytest.raises(WireError):
        encode_skeleton(replace(some_packet(), **{field: value}))  # type: ignore[arg-type]


def test_a_previous_frame_outside_the_range_does_not_stop_the_stream() -> None:
    packet = replace(some_packet(), previous=rest_pose(np.array([0, 60.0, 0])))
    assert decode_skeleton(encode_skeleton(packet)).previous is None


@settings(deadline=None)
@given(arrays(np.float32, LINK_COUNT, elements=st.floats(-(2.0**100), 2.0**100, width=32)))
def test_confidences_outside_their_range_are_clipped(confidence: np.ndarray) -> None:
    pose = replace(rest_pose(), confidence=confidence)
    assert np.abs(quantized_pose(pose).confidence - confidence.clip(0, 1)).max() <= CONFIDENCE_STEP / 2 + 1e-6


def golden_packet() -> SkeletonPacket:
    """Values that are exact on the wire: no rounding of another machine can change them."""
    half = np.sqrt(0.5)
    rotations = np.tile(np.array([half, 0, half, 0], np.float32), (LINK_COUNT, 1))
    rotations[1] = (0, 0, 0, 1)
    confidence = (np.arange(LINK_COUNT) % 16 / 15).astype(np.float32)
    pose = SkeletonPose(np.array([0.5, 0.95, -0.25], np.float32), rotations, confidence)
    previous = replace(pose, root_position=np.array([0.49, 0.95, -0.26], np.float32))
    return SkeletonPacket(1, 2, 3, 4_000_000_005, 6, 0.8, pose, previous, 33_000_000, 12_500_000)


def test_the_golden_packet_decodes_to_known_values() -> None:
    decoded, expected = decode_skeleton(bytes.fromhex(GOLDEN.read_text())), golden_packet()
    assert (decoded.person, decoded.epoch, decoded.sequence, decoded.body_revision) == (1, 2, 3, 6)
    assert (decoded.capture_ns, decoded.previous_age_ns) == (4_000_000_005, 33_000_000)
    assert decoded.send_ns == 4_012_500_005
    assert decoded.fit_confidence == pytest.approx(0.8)
    np.testing.assert_allclose(decoded.pose.root_position, [0.5, 0.95, -0.25], atol=1e-7)
    np.testing.assert_allclose(decoded.pose.rotations, expected.pose.rotations, atol=5e-5)
    np.testing.assert_allclose(decoded.pose.confidence, expected.pose.confidence, atol=1e-7)
    assert decoded.previous is not None
    np.testing.assert_allclose(decoded.previous.root_position, [0.49, 0.95, -0.26], atol=1e-6)


def test_encoding_is_stable() -> None:
    assert encode_skeleton(golden_packet()).hex() == "".join(GOLDEN.read_text().split())
