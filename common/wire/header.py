"""What all wire formats share: one error, version bytes, bounds, and msgpack with limits.

Every encoded message begins with one version byte: the high nibble says which message it is, the low nibble its
version. Decoders check every length against a bound before they allocate, and raise only ``WireError``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgpack

SKELETON_VERSION = 0x11
BODY_VERSION = 0x21
VIEW_VERSION = 0x32
CANDIDATE_POSE_VERSION = 0x42
REPORT_VERSION = 0x53
RESIDUAL_VERSION = 0x73
REPOSITORY_LIST_VERSION = 0x81

U8_MAX = 0xFF
U32_MAX = 0xFFFF_FFFF
TIME_MAX_NS = 1 << 62  # 146 years; sums and differences of two times stay inside int64

_MAX_ARRAY_FIELDS = 256
_MAX_STRING_BYTES = 64
_MAX_BINARY_BYTES = 4096


class WireError(Exception):
    """A message that cannot be decoded, or a value that has no encoding; the text is the exact reason."""


def checked_int(name: str, value: object, low: int, high: int) -> int:
    """``value`` as int when it is a whole number in [low, high].

    Raises:
        WireError: another type (bool included) or outside the range.
    """
    if isinstance(value, bool) or not isinstance(value, int):
        raise WireError(f"{name}: expected an integer, got {type(value).__name__}")
    if not low <= value <= high:
        raise WireError(f"{name}: {value} is outside {low}..{high}")
    return value


def checked_float(name: str, value: object, low: float, high: float) -> float:
    """``value`` as float when it is a finite number in [low, high].

    Raises:
        WireError: another type (bool included), NaN, infinite or outside the range.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise WireError(f"{name}: expected a number, got {type(value).__name__}")
    if not (math.isfinite(value) and low <= value <= high):
        raise WireError(f"{name}: {value} is outside {low}..{high}")
    return float(value)


def check_start(message: str, data: bytes, version: int, max_bytes: int) -> None:
    """Refuses ``data`` that is empty, longer than ``max_bytes`` or does not begin with the byte ``version``.

    Raises:
        WireError: which of the three, for the message called ``message``.
    """
    if not data:
        raise WireError(f"{message}: empty")
    if len(data) > max_bytes:
        raise WireError(f"{message}: {len(data)} bytes, at most {max_bytes} are allowed")
    if data[0] != version:
        raise WireError(f"{message}: version byte 0x{data[0]:02x}, expected 0x{version:02x}")


def pack_fields(message: str, version: int, fields: Sequence[Any], max_bytes: int) -> bytes:
    """The version byte and the fields as one msgpack array.

    Raises:
        WireError: longer than ``max_bytes``.
    """
    data: bytes = bytes([version]) + msgpack.packb(list(fields), use_bin_type=True)
    if len(data) > max_bytes:
        raise WireError(f"{message}: {len(data)} bytes, at most {max_bytes} are allowed")
    return data


def unpack_fields(message: str, data: bytes, version: int, count: int, max_bytes: int) -> list[Any]:
    """The ``count`` fields packed by ``pack_fields``; their types and ranges are the caller's to check.

    Maps and extension types are refused, and declared lengths beyond the bounds are refused before allocation.

    Raises:
        WireError: wrong start, not msgpack, beyond a bound, or another number of fields.
    """
    check_start(message, data, version, max_bytes)
    try:
        fields = msgpack.unpackb(
            memoryview(data)[1:],
            raw=False,
            max_array_len=_MAX_ARRAY_FIELDS,
            max_str_len=_MAX_STRING_BYTES,
            max_bin_len=_MAX_BINARY_BYTES,
            max_map_len=0,
            max_ext_len=0,
        )
    except ValueError as error:  # what all of unpackb's errors derive from
        raise WireError(f"{message}: not valid msgpack: {error}") from error
    if not isinstance(fields, list) or len(fields) != count:
        raise WireError(f"{message}: expected an array of {count} fields")
    return fields
