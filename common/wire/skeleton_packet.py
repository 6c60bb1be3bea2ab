"""The skeleton packet: one frame of one person in 250 bytes, whole (Raghuraman & Prabhakaran 2015 send 250 bytes too).

Layout, little endian: header (24 bytes) | pose (155) | previous frame (67) | CRC32 of all before (4).
header: version u8, person u8, epoch u32, sequence u32, capture time i64 [ns], body revision u8, flags u8,
    fit confidence u8 [1/255], time from capture to sending u8 [0.5 ms], age of the previous frame u8 [1 ms], step of
    its rotations u8 [0.2 mrad].
pose, bits: root position 3 × 20 [0.1 mm], per rotation the index of its largest component 2, then per rotation the
    other three components 3 × 15, confidence 4 each [1/15].
previous frame, bits: root displacement 3 × 16 [0.1 mm], per rotation the rotation vector from the present rotation
    to the previous one 3 × 7, in steps of the header's size. The step is the smallest that fits the fastest joint,
    so slow frames repeat finely: off by at most √3/2 steps, step = 0.2 mrad · ⌈fastest component / 12.6 mrad⌉.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from common.body.skeleton import LINK_COUNT
from common.body.skeleton_pose import SkeletonPose
from common.geometry import quaternion
from common.wire.header import (
    SKELETON_VERSION,
    TIME_MAX_NS,
    U8_MAX,
    U32_MAX,
    WireError,
    check_start,
    checked_float,
    checked_int,
)
from common.wire.quantization import (
    POSITION_BITS,
    POSITION_STEP_M,
    ROTATION_BITS,
    BitReader,
    dequantize_positions,
    dequantize_rotations,
    quantize_positions,
    quantize_rotations,
    to_bits,
)

POSE_BYTES = (3 * POSITION_BITS + LINK_COUNT * (2 + 3 * ROTATION_BITS + 4) + 7) // 8
_PREVIOUS_BYTES = (3 * 16 + LINK_COUNT * 3 * 7 + 7) // 8
_HEADER = struct.Struct("<BBIIqBBBBBB")
_CRC = struct.Struct("<I")
SKELETON_PACKET_BYTES = _HEADER.size + POSE_BYTES + _PREVIOUS_BYTES + _CRC.size

CONFIDENCE_STEP = 1 / 15
FIT_CONFIDENCE_STEP = 1 / 255
AGE_STEP_NS = 1_000_000
SEND_STEP_NS = 500_000
ROTATION_STEP_UNIT_RAD = 2e-4

_HAS_PREVIOUS = 0x01
_DISPLACEMENT_LIMIT = (1 << 15) - 1  # in steps of 0.1 mm
_DELTA_LIMIT = 63
_ROTATION_STEP_MAX = int(np.ceil(np.pi / _DELTA_LIMIT / ROTATION_STEP_UNIT_RAD))


@dataclass(frozen=True, slots=True, eq=False)
class SkeletonPacket:
    """One frame of one person.

    ``epoch``: the sender's run; ``sequence``: frame number in it; ``capture_ns``: the sender's monotonic clock [ns];
    ``body_revision``: the body message whose sizes belong to the pose; ``fit_confidence`` in [0, 1].
    ``previous``: the frame ``previous_age_ns`` [ns] earlier, coarse, with this frame's confidences; None: not sent.
    ``send_delay_ns``: from capture to sending, at most 127.5 ms are told: the bulk window needs the time on the way
    without the time it took to fit the frame.
    """

    person: int
    epoch: int
    sequence: int
    capture_ns: int
    body_revision: int
    fit_confidence: float
    pose: SkeletonPose
    previous: SkeletonPose | None = None
    previous_age_ns: int = 0
    send_delay_ns: int = 0

    @property
    def send_ns(self) -> int:
        """When the packet was sent, by the sender's clock [ns]."""
        return self.capture_ns + self.send_delay_ns


def encode_pose(pose: SkeletonPose) -> bytes:
    """``POSE_BYTES`` of a pose; confidences are clipped to [0, 1].

    Raises:
        WireError: the root is outside ±52.4287 m.
    """
    largest, others = quantize_rotations(pose.rotations)
    bits = [
        to_bits(quantize_positions(pose.root_position), POSITION_BITS, signed=True),
        to_bits(largest, 2),
        to_bits(others, ROTATION_BITS, signed=True),
        to_bits(np.rint(pose.confidence.clip(0, 1) / CONFIDENCE_STEP), 4),
    ]
    return np.packbits(np.concatenate(bits)).tobytes()


def decode_pose(data: bytes) -> SkeletonPose:
    """The pose of ``encode_pose``'s bytes.

    Raises:
        WireError: another length, or bits that are no pose.
    """
    if len(data) != POSE_BYTES:
        raise WireError(f"pose: {len(data)} bytes, expected {POSE_BYTES}")
    reader = BitReader(data)
    root = dequantize_positions(reader.read(3, POSITION_BITS, signed=True))
    largest = reader.read(LINK_COUNT, 2)
    others = reader.read(3 * LINK_COUNT, ROTATION_BITS, signed=True).reshape(-1, 3)
    confidence = (reader.read(LINK_COUNT, 4) * CONFIDENCE_STEP).astype(np.float32)
    reader.check_padding()
    return SkeletonPose(root, dequantize_rotations(largest, others), confidence)


def quantized_pose(pose: SkeletonPose) -> SkeletonPose:
    """The pose the other end decodes; both ends build candidate poses and σ from it.

    Raises:
        WireError: the root is outside ±52.4287 m.
    """
    return decode_pose(encode_pose(pose))


def encode_skeleton(packet: SkeletonPacket) -> bytes:
    """``SKELETON_PACKET_BYTES`` of one frame.

    The previous frame is left out where it cannot be expressed: older than 255 ms or the root more than 3.2767 m
    away along an axis.

    Raises:
        WireError: a number outside its range, or the root outside ±52.4287 m.
    """
    pose_bytes = encode_pose(packet.pose)
    repeat = _encode_previous(packet, decode_pose(pose_bytes))
    age, step, previous_bytes = repeat if repeat is not None else (0, 0, bytes(_PREVIOUS_BYTES))
    header = _HEADER.pack(
        SKELETON_VERSION,
        checked_int("person", packet.person, 0, U8_MAX),
        checked_int("epoch", packet.epoch, 0, U32_MAX),
        checked_int("sequence", packet.sequence, 0, U32_MAX),
        checked_int("capture time", packet.capture_ns, 0, TIME_MAX_NS),
        checked_int("body revision", packet.body_revision, 0, U8_MAX),
        _HAS_PREVIOUS if repeat is not None else 0,
        round(checked_float("fit confidence", float(packet.fit_confidence), 0, 1) / FIT_CONFIDENCE_STEP),
        min(max(round(packet.send_delay_ns / SEND_STEP_NS), 0), U8_MAX),
        age,
        step,
    )
    body = header + pose_bytes + previous_bytes
    return body + _CRC.pack(zlib.crc32(body))


def decode_skeleton(data: bytes) -> SkeletonPacket:
    """The frame of ``encode_skeleton``'s bytes.

    Raises:
        WireError: wrong length, version or checksum, or content that no encoder writes.
    """
    check_start("skeleton packet", data, SKELETON_VERSION, SKELETON_PACKET_BYTES)
    if len(data) != SKELETON_PACKET_BYTES:
        raise WireError(f"skeleton packet: {len(data)} bytes, expected {SKELETON_PACKET_BYTES}")
    if zlib.crc32(data[: -_CRC.size]) != _CRC.unpack(data[-_CRC.size :])[0]:
        raise WireError("skeleton packet: checksum does not match")
    _, person, epoch, sequence, capture_ns, revision, flags, fit, sending, age, step = _HEADER.unpack_from(data)
    checked_int("capture time", capture_ns, 0, TIME_MAX_NS)
    if flags & ~_HAS_PREVIOUS:
        raise WireError(f"skeleton packet: unknown flags 0x{flags:02x}")
    end = _HEADER.size + POSE_BYTES
    pose = decode_pose(data[_HEADER.size : end])
    previous = _decode_previous(data[end : end + _PREVIOUS_BYTES], step, pose) if flags & _HAS_PREVIOUS else None
    fit_confidence, age_ns, send_delay_ns = fit * FIT_CONFIDENCE_STEP, age * AGE_STEP_NS, sending * SEND_STEP_NS
    return SkeletonPacket(
        person, epoch, sequence, capture_ns, revision, fit_confidence, pose, previous, age_ns, send_delay_ns
    )


def _encode_previous(packet: SkeletonPacket, present: SkeletonPose) -> tuple[int, int, bytes] | None:
    """(age, rotation step, bits) of the previous frame relative to the ``present`` pose as decoded, or None."""
    previous = packet.previous
    age = round(packet.previous_age_ns / AGE_STEP_NS)
    if previous is None or not 0 <= age <= U8_MAX:
        return None
    moved_m = previous.root_position.astype(np.float64) - present.root_position
    displacement = np.rint(moved_m / POSITION_STEP_M)
    if np.abs(displacement).max() > _DISPLACEMENT_LIMIT:
        return None
    before = quaternion.normalized(previous.rotations.astype(np.float64))
    now = present.rotations.astype(np.float64)
    delta = quaternion.to_rotation_vector(quaternion.multiply(before, quaternion.conjugate(now)))
    step = int(np.ceil(np.abs(delta).max() / (_DELTA_LIMIT * ROTATION_STEP_UNIT_RAD)))
    steps = np.rint(delta / (max(step, 1) * ROTATION_STEP_UNIT_RAD))
    bits = [to_bits(displacement, 16, signed=True), to_bits(steps, 7, signed=True)]
    return age, step, np.packbits(np.concatenate(bits)).tobytes()


def _decode_previous(data: bytes, step: int, present: SkeletonPose) -> SkeletonPose:
    """The previous frame from its bits and the present pose."""
    checked_int("rotation step", step, 0, _ROTATION_STEP_MAX)
    reader = BitReader(data)
    displacement = dequantize_positions(reader.read(3, 16, signed=True))
    steps = reader.read(3 * LINK_COUNT, 7, signed=True).reshape(-1, 3)
    reader.check_padding()
    delta = quaternion.from_rotation_vector(steps * (step * ROTATION_STEP_UNIT_RAD))
    rotations = quaternion.normalized(quaternion.multiply(delta, present.rotations.astype(np.float64)))
    return SkeletonPose(present.root_position + displacement, rotations.astype(np.float32), present.confidence)
