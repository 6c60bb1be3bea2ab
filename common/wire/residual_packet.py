"""The residual packet: one frame's link maps of one person, whole or against a reference (Lien §5.2).

Layout, little endian: header (48 bytes) | occupancy | radius | colour | CRC32 of all before (4).
header: version u8, kind u8, person u8, body revision u8, epoch u32, sequence u32, reference u32, skeleton sequence u32,
    capture time i64 [ns], points u32, level u16 [1/100 %], JPEG quality u8, radius u8 (differs × 128 + coding × 32 +
    steps), bytes of occupancy, radius and colour u32 each.
Where each link's grid lies follows from the body, ``points`` and ``level`` (``map_layout``) and is not sent.

Kinds. "key": by itself. "model": the difference from the last key, which is the model P_l of §5.2 as a map, moved by
the skeleton: a lost one harms no other. "previous": the difference from the packet before (§5.2, Fig. 5c): fewer bytes
while nothing is lost, nothing to see from a loss to the next key. "video": several frames from its capture time on, by
themselves (``residual_video``).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from common.body.cylindrical_map import LinkMaps
from common.body.map_layout import LEVEL_MAX, LEVEL_MIN, POINTS_MAX, POINTS_MIN, MapLayout, map_layout
from common.body.skeleton import Skeleton
from common.wire.header import (
    RESIDUAL_VERSION,
    TIME_MAX_NS,
    U8_MAX,
    U32_MAX,
    WireError,
    check_start,
    checked_float,
    checked_int,
)
from common.wire.map_codec import RADIUS_CODINGS, RADIUS_STEPS_MAX, MapQuality, MapSections, decode_maps, encode_maps

RESIDUAL_MAX_BYTES = 1 << 21
LEVEL_STEP = 0.01  # %

Kind = Literal["key", "model", "previous", "video"]
ALONE: tuple[Kind, ...] = ("key", "video")  # decode without another packet
_KINDS: tuple[Kind, ...] = ("key", "model", "previous", "video")
_HEADER = struct.Struct("<BBBBIIIIqIHBBIII")
_CRC = struct.Struct("<I")
_CODING_SHIFT, _STEPS_MASK, _RADIUS_DIFFERS = 5, 31, 128


@dataclass(frozen=True, slots=True)
class ResidualHeader:
    """What a packet says before its maps.

    ``sequence``: number of the frame in the sender's run ``epoch``; ``reference``: that of the packet it is the
    difference from, its own for one that is none. ``skeleton_sequence``: the skeleton packet of the same frame, by
    whose pose points were put into links; ``body_revision``: the body message whose sizes the grids go by.
    ``capture_ns``: the sender's monotonic clock [ns]. ``points``: N of the layout; ``level``: 1..100 % of the full
    grids, in hundredths.
    """

    person: int
    epoch: int
    sequence: int
    kind: Kind
    reference: int
    skeleton_sequence: int
    body_revision: int
    capture_ns: int
    points: int
    level: float
    quality: MapQuality

    def layout(self, skeleton: Skeleton) -> MapLayout:
        """The grids, for the body ``body_revision`` names, as the receiver decodes it.

        Raises:
            WireError: this body at this level has an atlas beyond the bounds.
        """
        try:
            return map_layout(skeleton, self.points, self.level)
        except ValueError as error:
            raise WireError(f"residual packet: {error}") from error


def encode_residual(header: ResidualHeader, layout: MapLayout, maps: LinkMaps, reference: LinkMaps | None) -> bytes:
    """Bytes of one packet. ``layout``: ``header.layout`` of the body; ``reference``: ``reference_of`` the maps, as
    decoded, of the packet the header refers to, in the same layout; None for a key.

    Raises:
        WireError: a number outside its range, or more than ``RESIDUAL_MAX_BYTES``.
    """
    assert header.kind != "video"
    assert (reference is None) == (header.kind == "key")
    return packed(header, encode_maps(layout, maps, header.quality, reference))


def packed(header: ResidualHeader, sections: MapSections) -> bytes:
    """Bytes of a packet of any kind.

    Raises:
        WireError: as ``encode_residual``.
    """
    quality = header.quality
    steps = checked_int("radius steps", quality.radius_steps, 1, RADIUS_STEPS_MAX)
    differs = _RADIUS_DIFFERS if sections.radius_differs else 0
    head = _HEADER.pack(
        RESIDUAL_VERSION,
        _KINDS.index(header.kind),
        checked_int("person", header.person, 0, U8_MAX),
        checked_int("body revision", header.body_revision, 0, U8_MAX),
        checked_int("epoch", header.epoch, 0, U32_MAX),
        checked_int("sequence", header.sequence, 0, U32_MAX),
        checked_int("reference", header.reference, 0, U32_MAX),
        checked_int("skeleton sequence", header.skeleton_sequence, 0, U32_MAX),
        checked_int("capture time", header.capture_ns, 0, TIME_MAX_NS),
        checked_int("points", header.points, POINTS_MIN, POINTS_MAX),
        round(checked_float("level", header.level, LEVEL_MIN, LEVEL_MAX) / LEVEL_STEP),
        checked_int("JPEG quality", quality.jpeg, 1, 100),
        RADIUS_CODINGS.index(quality.radius_coding) << _CODING_SHIFT | steps | differs,
        len(sections.occupancy),
        len(sections.radius),
        len(sections.colour),
    )
    body = head + sections.occupancy + sections.radius + sections.colour
    data = body + _CRC.pack(zlib.crc32(body))
    if len(data) > RESIDUAL_MAX_BYTES:
        raise WireError(f"residual packet: {len(data)} bytes, at most {RESIDUAL_MAX_BYTES} are allowed")
    return data


def is_residual(message: bytes) -> bool:
    """Whether a bulk message claims to be a residual packet."""
    return message[:1] == bytes([RESIDUAL_VERSION])


def needed_packets(waiting: Sequence[bytes]) -> list[bytes]:
    """Of packets in the order they came, those that have to be decoded to show the newest: it, and the last key or, of
    differences from the packet before, all since that key. What is no packet is kept: to be refused by its decoder."""
    keys = [number for number, packet in enumerate(waiting) if packet_kind(packet) in ALONE]
    since_key = list(waiting[keys[-1] :] if keys else waiting)
    if not all(packet_kind(packet) in (*ALONE, "model") for packet in since_key):
        return since_key
    return since_key if len(since_key) == 1 else [*(since_key[:1] if keys else []), since_key[-1]]


def packet_kind(packet: bytes) -> Kind | None:
    """What a message claims to be; None: no residual packet."""
    return _KINDS[packet[1]] if is_residual(packet) and len(packet) > 1 and packet[1] < len(_KINDS) else None


def decode_residual_header(data: bytes) -> ResidualHeader:
    """What the packet says of itself; the checksum is checked.

    Raises:
        WireError: wrong length, version or checksum, or a number outside its range.
    """
    return parsed(data)[0]


def decode_residual(data: bytes, layout: MapLayout, reference: LinkMaps | None) -> LinkMaps:
    """The maps of a packet; ``layout`` and ``reference`` as in ``encode_residual``. Nothing larger than the layout is
    allocated, whatever the bytes declare.

    Raises:
        WireError: anything that is not exactly one packet for this layout, or a reference where none belongs.
    """
    header, sections = parsed(data)
    if header.kind == "video":
        raise WireError("residual packet: a video packet holds several frames")
    if (reference is None) != (header.kind == "key"):
        raise WireError(f"residual packet: a {header.kind} packet with{'out' if reference is None else ''} a reference")
    if reference is not None and reference.full.shape != (layout.height, layout.width):
        raise WireError("residual packet: its reference has another layout")
    return decode_maps(layout, sections, header.quality, reference)


def parsed(data: bytes) -> tuple[ResidualHeader, MapSections]:
    """Header and sections of a packet of any kind.

    Raises:
        WireError: as ``decode_residual_header``.
    """
    check_start("residual packet", data, RESIDUAL_VERSION, RESIDUAL_MAX_BYTES)
    if len(data) < _HEADER.size + _CRC.size:
        raise WireError(f"residual packet: {len(data)} bytes are fewer than its header and checksum")
    if zlib.crc32(memoryview(data)[: -_CRC.size]) != _CRC.unpack(data[-_CRC.size :])[0]:
        raise WireError("residual packet: checksum does not match")
    fields = _HEADER.unpack_from(data)
    _, kind, person, revision, epoch, sequence, reference, skeleton, capture_ns, points, level, jpeg, coding = fields[
        :13
    ]
    sizes = fields[13:]
    if len(data) != _HEADER.size + sum(sizes) + _CRC.size:
        raise WireError(f"residual packet: {len(data)} bytes, its sections have {sum(sizes)}")
    name = _KINDS[checked_int("kind", kind, 0, len(_KINDS) - 1)]
    if (reference == sequence) != (name in ALONE):
        raise WireError(f"residual packet: {name} packet {sequence} refers to {reference}")
    index = checked_int("radius coding", (coding & ~_RADIUS_DIFFERS) >> _CODING_SHIFT, 0, len(RADIUS_CODINGS) - 1)
    quality = MapQuality(
        checked_int("JPEG quality", jpeg, 1, 100),
        checked_int("radius steps", coding & _STEPS_MASK, 1, RADIUS_STEPS_MAX),
        RADIUS_CODINGS[index],
    )
    header = ResidualHeader(
        person, epoch, sequence, name, reference, skeleton, revision,
        checked_int("capture time", capture_ns, 0, TIME_MAX_NS),
        checked_int("points", points, POINTS_MIN, POINTS_MAX),
        checked_float("level", round(level * LEVEL_STEP, 2), LEVEL_MIN, LEVEL_MAX),
        quality,
    )  # fmt: skip
    ends = [_HEADER.size + sum(sizes[:n]) for n in range(4)]
    occupancy, radius, colour = (data[start:end] for start, end in pairwise(ends))
    return header, MapSections(occupancy, radius, colour, bool(coding & _RADIUS_DIFFERS))
