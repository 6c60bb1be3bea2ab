"""The body message: the sizes of one person's link tree, sent when they are found and to every receiver that joins.

Sizes are steps of 0.1 mm in 16 bits, so both ends hold the same skeleton and no value can be NaN or huge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.body.skeleton import LINK_COUNT, Skeleton
from common.wire.header import (
    BODY_VERSION,
    U8_MAX,
    U32_MAX,
    WireError,
    checked_float,
    checked_int,
    pack_fields,
    unpack_fields,
)

BODY_MAX_BYTES = 16 * 1024
SIZE_STEP_M = 1e-4
SKELETON_BYTES = LINK_COUNT * 7 * 2
_FRAME_RATE_MAX_HZ = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class BodyMessage:
    """Who is being sent: ``person``; the sender's run ``epoch``; ``revision`` of the body, counted modulo 256, named by
    every skeleton packet; the link sizes; the rate [Hz] at which skeletons are captured."""

    person: int
    epoch: int
    revision: int
    skeleton: Skeleton
    frame_rate_hz: float


def encode_skeleton_sizes(skeleton: Skeleton) -> bytes:
    """``SKELETON_BYTES``: per link offset (3), tip (3) and radius as int16 little endian in steps of 0.1 mm.

    Raises:
        WireError: a size beyond ±3.2767 m, or a radius below half a step.
    """
    sizes = np.concatenate([skeleton.offsets, skeleton.tips, skeleton.radii[:, None]], axis=1).astype(np.float64)
    steps = np.rint(sizes / SIZE_STEP_M)
    if np.abs(steps).max() > 0x7FFF or steps[:, 6].min() < 1:
        raise WireError("skeleton: a size beyond ±3.2767 m or a radius of zero")
    return steps.astype("<i2").tobytes()


def decode_skeleton_sizes(data: bytes) -> Skeleton:
    """The skeleton of ``encode_skeleton_sizes``'s bytes.

    Raises:
        WireError: another length, or a radius that is not positive.
    """
    if len(data) != SKELETON_BYTES:
        raise WireError(f"skeleton: {len(data)} bytes, expected {SKELETON_BYTES}")
    steps = np.frombuffer(data, "<i2").reshape(LINK_COUNT, 7)
    if steps[:, 6].min() < 1:
        raise WireError("skeleton: a radius is not positive")
    sizes = (steps * SIZE_STEP_M).astype(np.float32)
    return Skeleton(sizes[:, :3], sizes[:, 3:6], sizes[:, 6])


def quantized_skeleton(skeleton: Skeleton) -> Skeleton:
    """The skeleton the other end decodes.

    Raises:
        WireError: a size beyond ±3.2767 m, or a radius below half a step.
    """
    return decode_skeleton_sizes(encode_skeleton_sizes(skeleton))


def encode_body(body: BodyMessage) -> bytes:
    """One msgpack array, about 350 bytes, at most ``BODY_MAX_BYTES``.

    Raises:
        WireError: a number outside its range.
    """
    fields = [*_checked(body.person, body.epoch, body.revision, body.frame_rate_hz)]
    return pack_fields("body", BODY_VERSION, [*fields, encode_skeleton_sizes(body.skeleton)], BODY_MAX_BYTES)


def decode_body(data: bytes) -> BodyMessage:
    """The message of ``encode_body``'s bytes.

    Raises:
        WireError: not a body message, or a field outside its range.
    """
    *fields, sizes = unpack_fields("body", data, BODY_VERSION, 5, BODY_MAX_BYTES)
    person, epoch, revision, frame_rate_hz = _checked(*fields)
    if not isinstance(sizes, bytes):
        raise WireError(f"skeleton: expected bytes, got {type(sizes).__name__}")
    return BodyMessage(person, epoch, revision, decode_skeleton_sizes(sizes), frame_rate_hz)


def _checked(person: object, epoch: object, revision: object, frame_rate_hz: object) -> tuple[int, int, int, float]:
    return (
        checked_int("person", person, 0, U8_MAX),
        checked_int("epoch", epoch, 0, U32_MAX),
        checked_int("body revision", revision, 0, U8_MAX),
        checked_float("frame rate", frame_rate_hz, 0.1, _FRAME_RATE_MAX_HZ),
    )
