"""The receiver report: what the sender's bulk window and mesh scheduler learn from a receiver, every 50 ms.

One msgpack array in the order of ``ReceiverReport``'s fields, missing chunks as distances below ``next_chunk``.
Each field's own range is checked here; whether an acknowledgement is plausible (not beyond what was sent) only the
bulk window can tell.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields

from common.wire.header import (
    REPORT_VERSION,
    TIME_MAX_NS,
    U8_MAX,
    U32_MAX,
    WireError,
    checked_int,
    pack_fields,
    unpack_fields,
)

REPORT_MAX_BYTES = 1024
MAX_MISSING_CHUNKS = 128
WANTS_RESIDUALS, WANTS_LIVE = 1, 2  # bits of ``wants``: residual maps as points are made of; a few, for a live surface
SPARES_POSES = 4  # another: it has a candidate pose, and no use for more at the moment
MISSING_SPAN = 0xFFFF  # a missing chunk lies at most this far below the next expected one
REPOSITORY_MAX_POSES = 0xFFFF

_U64_MAX = (1 << 64) - 1
_COUNT_MAX = 1 << 53


@dataclass(frozen=True, slots=True)
class ReceiverReport:
    """Times are ns of monotonic clocks, the sender's or the receiver's, which have no common zero.

    ``number``: of this report, rising by one. ``receiver_id``: u64; ``receiver_epoch``: the receiver's run.
    ``sender_epoch``: the sender's run that everything below is about; None: none heard yet.
    ``clock_ns``: receiver's clock at sending. ``skeleton_send_ns``: the sender's send time in the newest skeleton,
    None: none yet; ``skeleton_hold_ns``: how long the receiver has had it.
    ``skeleton_delay_ns``, ``bulk_delay_ns``: d_s and d_b, the least (receiver's arrival - sender's send time) of
    skeletons and of chunks since the last report, clock offset included, so of any sign; None: none came.
    ``bulk_bytes``: bytes of all chunks received in this sender epoch.
    ``next_chunk``: every chunk below is resolved or in ``missing_chunks`` (rising); with more missing than
    ``MAX_MISSING_CHUNKS`` it is the first one not listed.
    ``body_revision``: of the newest body message held, None: none. ``repository_poses``: candidate poses held.
    ``wants``: bits, what it has a use for beside candidate poses, or instead; bits unknown here mean nothing.
    ``skeleton_divisor``: of the skeletons it takes 1 in so many, since its path carries no more; 1: all.
    """

    number: int
    receiver_id: int
    receiver_epoch: int
    sender_epoch: int | None
    clock_ns: int
    skeleton_send_ns: int | None
    skeleton_hold_ns: int
    skeleton_delay_ns: int | None
    bulk_delay_ns: int | None
    bulk_bytes: int
    next_chunk: int
    missing_chunks: tuple[int, ...]
    body_revision: int | None
    repository_poses: int
    wants: int = 0
    skeleton_divisor: int = 1


_FIELD_NAMES = [field.name for field in fields(ReceiverReport)]
_RANGES = {
    "number": (0, U32_MAX),
    "receiver_id": (0, _U64_MAX),
    "receiver_epoch": (0, U32_MAX),
    "sender_epoch": (0, U32_MAX),
    "clock_ns": (0, TIME_MAX_NS),
    "skeleton_send_ns": (0, TIME_MAX_NS),
    "skeleton_hold_ns": (0, TIME_MAX_NS),
    "skeleton_delay_ns": (-TIME_MAX_NS, TIME_MAX_NS),
    "bulk_delay_ns": (-TIME_MAX_NS, TIME_MAX_NS),
    "bulk_bytes": (0, _COUNT_MAX),
    "next_chunk": (0, _COUNT_MAX),
    "body_revision": (0, U8_MAX),
    "repository_poses": (0, REPOSITORY_MAX_POSES),
    "wants": (0, U8_MAX),
    "skeleton_divisor": (1, U8_MAX),
}
_OPTIONAL = {"sender_epoch", "skeleton_send_ns", "skeleton_delay_ns", "bulk_delay_ns", "body_revision"}


def encode_report(report: ReceiverReport) -> bytes:
    """One msgpack array, about 90 bytes, at most ``REPORT_MAX_BYTES``.

    Raises:
        WireError: a field outside its range.
    """
    _check(report)
    values = dict(zip(_FIELD_NAMES, astuple(report), strict=True))
    values["missing_chunks"] = [report.next_chunk - chunk for chunk in report.missing_chunks]
    return pack_fields("report", REPORT_VERSION, list(values.values()), REPORT_MAX_BYTES)


def decode_report(data: bytes) -> ReceiverReport:
    """The report of ``encode_report``'s bytes.

    Raises:
        WireError: not a report, or a field of another type or outside its range.
    """
    received = unpack_fields("report", data, REPORT_VERSION, len(_FIELD_NAMES), REPORT_MAX_BYTES)
    values = dict(zip(_FIELD_NAMES, received, strict=True))
    next_chunk = checked_int("next_chunk", values["next_chunk"], *_RANGES["next_chunk"])
    distances = values["missing_chunks"]
    if not isinstance(distances, list):
        raise WireError(f"missing_chunks: expected an array, got {type(distances).__name__}")
    checked = [checked_int("missing chunk's distance", distance, 1, MISSING_SPAN) for distance in distances]
    values["missing_chunks"] = tuple(next_chunk - distance for distance in checked)
    report = ReceiverReport(**values)
    _check(report)
    return report


def _check(report: ReceiverReport) -> None:
    for name, (low, high) in _RANGES.items():
        value = getattr(report, name)
        if value is not None or name not in _OPTIONAL:
            checked_int(name, value, low, high)
    missing = report.missing_chunks
    if len(missing) > MAX_MISSING_CHUNKS:
        raise WireError(f"missing_chunks: {len(missing)} chunks, at most {MAX_MISSING_CHUNKS} are allowed")
    for before, chunk in zip((max(-1, report.next_chunk - MISSING_SPAN - 1), *missing), missing, strict=False):
        checked_int("missing chunk", chunk, before + 1, report.next_chunk - 1)
