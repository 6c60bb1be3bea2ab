"""The receiver report: every field comes back, and forged ones are refused field by field."""

from __future__ import annotations

from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.wire.header import REPORT_VERSION, WireError
from common.wire.receiver_report import (
    MAX_MISSING_CHUNKS,
    MISSING_SPAN,
    REPORT_MAX_BYTES,
    WANTS_RESIDUALS,
    ReceiverReport,
    decode_report,
    encode_report,
)

GOLDEN = Path(__file__).parent / "golden" / "receiver_report.hex"
NAMES = [field.name for field in fields(ReceiverReport)]
REPORT = ReceiverReport(
    number=7,
    receiver_id=0xFEDC_BA98_7654_3210,
    receiver_epoch=0x89AB_CDEF,
    sender_epoch=5,
    clock_ns=123_456_789_012_345,
    skeleton_send_ns=98_765_432_109,
    skeleton_hold_ns=3_000_000,
    skeleton_delay_ns=-55_000_000_000,
    bulk_delay_ns=-54_990_000_000,
    bulk_bytes=10_000_000,
    next_chunk=500,
    missing_chunks=(3, 480, 499),
    body_revision=2,
    repository_poses=42,
    wants=WANTS_RESIDUALS,
    skeleton_divisor=4,
)
SILENT = replace(
    REPORT, sender_epoch=None, skeleton_send_ns=None, skeleton_delay_ns=None, bulk_delay_ns=None, body_revision=None
)
LONGEST = ReceiverReport(
    number=2**32 - 1,
    receiver_id=2**64 - 1,
    receiver_epoch=2**32 - 1,
    sender_epoch=2**32 - 1,
    clock_ns=2**62,
    skeleton_send_ns=2**62,
    skeleton_hold_ns=2**62,
    skeleton_delay_ns=-(2**62),
    bulk_delay_ns=-(2**62),
    bulk_bytes=2**53,
    next_chunk=2**53,
    missing_chunks=tuple(2**53 - MISSING_SPAN + i for i in range(MAX_MISSING_CHUNKS)),
    body_revision=255,
    repository_poses=0xFFFF,
    wants=255,
    skeleton_divisor=255,
)


def message(values: list[Any]) -> bytes:
    return bytes([REPORT_VERSION]) + msgpack.packb(values)


def on_the_wire(report: ReceiverReport = REPORT) -> list[Any]:
    return list(msgpack.unpackb(encode_report(report)[1:]))


@pytest.mark.parametrize("report", [REPORT, SILENT, LONGEST], ids=["usual", "nothing heard", "longest"])
def test_a_report_comes_back(report: ReceiverReport) -> None:
    data = encode_report(report)
    assert decode_report(data) == report
    assert len(data) <= REPORT_MAX_BYTES


def test_a_usual_report_is_small() -> None:
    assert len(encode_report(REPORT)) < 110


numbers = st.integers(0, 2**32 - 1)
times = st.integers(0, 2**62)


@st.composite
def reports(draw: st.DrawFn) -> ReceiverReport:
    next_chunk = draw(st.integers(0, 2**53))
    distances = draw(st.sets(st.integers(1, min(MISSING_SPAN, max(next_chunk, 1))), max_size=MAX_MISSING_CHUNKS))
    missing = tuple(next_chunk - d for d in sorted(distances, reverse=True)) if next_chunk else ()
    delays = st.none() | st.integers(-(2**62), 2**62)
    return ReceiverReport(
        draw(numbers), draw(st.integers(0, 2**64 - 1)), draw(numbers), draw(st.none() | numbers), draw(times),
        draw(st.none() | times), draw(times), draw(delays), draw(delays), draw(st.integers(0, 2**53)), next_chunk,
        missing, draw(st.none() | st.integers(0, 255)), draw(st.integers(0, 0xFFFF)),
    )  # fmt: skip


@settings(deadline=None)
@given(reports())
def test_any_report_within_the_ranges_comes_back(report: ReceiverReport) -> None:
    assert decode_report(encode_report(report)) == report


FORGED = [
    ("number", -1),
    ("number", 2**32),
    ("receiver_id", -1),
    ("receiver_id", None),
    ("receiver_id", "0123"),
    ("receiver_epoch", 2**32),
    ("sender_epoch", -1),
    ("clock_ns", -1),
    ("clock_ns", 2**63),
    ("clock_ns", None),
    ("clock_ns", 1.5),
    ("skeleton_send_ns", -1),
    ("skeleton_hold_ns", -1),
    ("skeleton_hold_ns", None),
    ("skeleton_delay_ns", -(2**63)),
    ("bulk_delay_ns", 2**63),
    ("bulk_bytes", -1),
    ("bulk_bytes", 2**63),
    ("next_chunk", -1),
    ("next_chunk", 2**64 - 1),
    ("next_chunk", True),
    ("body_revision", 256),
    ("repository_poses", 0x10000),
    ("repository_poses", -1),
]


@pytest.mark.parametrize(("field", "value"), FORGED)
def test_a_forged_field_is_refused_by_name(field: str, value: object) -> None:
    values = on_the_wire()
    values[NAMES.index(field)] = value
    with pytest.raises(WireError, match=field):
        decode_report(message(values))


@pytest.mark.parametrize(("field", "value"), FORGED)
def test_a_field_outside_its_range_is_not_encoded(field: str, value: object) -> None:
    with pytest.raises(WireError):
        encode_report(replace(REPORT, **{field: value}))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "distances",
    [
        [0],  # the next expected chunk itself
        [-1],  # a chunk of the future
        [501],  # a negative chunk
        [2, 2],  # twice
        [1, 2],  # falling
        [MISSING_SPAN + 1],
        [2**63],
        [1.0],
        [None],
        [[1]],
        5,
        None,
        "3",
    ],
)
def test_forged_missing_chunks_are_refused(distances: object) -> None:
    values = on_the_wire()
    values[NAMES.index("missing_chunks")] = distances
    with pytest.raises(WireError, match="missing"):
        decode_report(message(values))


def test_too_many_missing_chunks_are_refused() -> None:
    too_many = replace(LONGEST, missing_chunks=tuple(2**53 - 1000 + i for i in range(MAX_MISSING_CHUNKS + 1)))
    with pytest.raises(WireError, match="at most 128"):
        encode_report(too_many)
    values = on_the_wire()
    values[NAMES.index("next_chunk")] = 1000
    values[NAMES.index("missing_chunks")] = list(range(MAX_MISSING_CHUNKS + 1, 0, -1))
    with pytest.raises(WireError, match="at most 128"):
        decode_report(message(values))


@pytest.mark.parametrize("missing", [(500,), (-1,), (499, 3), (3, 3)])
def test_missing_chunks_out_of_order_or_range_are_not_encoded(missing: tuple[int, ...]) -> None:
    with pytest.raises(WireError, match="missing chunk"):
        encode_report(replace(REPORT, missing_chunks=missing))


def test_every_truncated_report_is_refused() -> None:
    data = encode_report(REPORT)
    for length in range(len(data)):
        with pytest.raises(WireError):
            decode_report(data[:length])


def test_every_flipped_bit_is_refused_or_another_sound_report() -> None:
    data = encode_report(REPORT)
    for bit in range(8 * len(data)):
        broken = bytearray(data)
        broken[bit // 8] ^= 1 << bit % 8
        try:
            decoded = decode_report(bytes(broken))
        except WireError:
            continue
        assert decode_report(encode_report(decoded)) == decoded


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_refused(data: bytes) -> None:
    for candidate in (data, bytes([REPORT_VERSION]) + data):
        with pytest.raises(WireError):
            decode_report(candidate)


@settings(deadline=None)
@given(st.lists(st.none() | st.integers(-(2**63), 2**64 - 1) | st.lists(st.integers(0, 9)), min_size=14, max_size=14))
def test_arbitrary_fields_are_refused_or_a_sound_report(values: list[Any]) -> None:
    try:
        decoded = decode_report(message(values))
    except WireError:
        return
    assert decode_report(encode_report(decoded)) == decoded


@pytest.mark.parametrize(
    "bomb",
    [
        b"\x91" * 1000,
        b"\xdd\xff\xff\xff\xff",
        b"\x9e\xc6\x7f\xff\xff\xff",
        b"\xd6\xff\x00\x00\x00\x00",
        b"\x9e\xc9\x00\x00\x00\x01\x05\x00",
    ],
    ids=["nesting", "huge array", "huge bytes", "timestamp", "extension"],
)
def test_msgpack_bombs_are_refused(bomb: bytes) -> None:
    with pytest.raises(WireError):
        decode_report(bytes([REPORT_VERSION]) + bomb)


def test_empty_oversized_and_foreign_reports_are_refused() -> None:
    with pytest.raises(WireError, match="empty"):
        decode_report(b"")
    with pytest.raises(WireError, match="at most"):
        decode_report(bytes([REPORT_VERSION]) + bytes(REPORT_MAX_BYTES))
    with pytest.raises(WireError, match="version byte"):
        decode_report(b"\x21" + encode_report(REPORT)[1:])


def test_the_golden_report_decodes_to_known_values_and_is_what_we_encode() -> None:
    golden = bytes.fromhex(GOLDEN.read_text())
    expected = (
        1,
        2,
        3,
        4,
        5_000_000_000,
        6_000_000_000,
        7_000_000,
        -8_000_000,
        None,
        9_000,
        100,
        (97, 99),
        1,
        12,
        1,
        8,
    )
    assert astuple(decode_report(golden)) == expected
    assert encode_report(ReceiverReport(*expected)) == golden
