"""A candidate pose in bytes: what one frame's rigged mesh is built from (DISPOSE §5–6), self-contained.

Both ends build the mesh from the *decoded* candidate, so the sender too decodes what it encoded:
``decode_candidate_pose(encode_candidate_pose(c))`` is the one candidate there is.
Layout, little endian: header | skeleton sizes | pose | per view: length u32, view.
header: version u8, person u8, epoch u32, pose id u32, capture time i64 [ns], rigging u8, number of views u8.
rigging: bit 0 region growing instead of Voronoi cells, bit 1 views zippered; the other bits are 0.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from common.body.rigging import DEFAULT_RIGGING, Rigging, Segmentation
from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.body.view import View
from common.wire.body_message import SKELETON_BYTES, decode_skeleton_sizes, encode_skeleton_sizes
from common.wire.header import CANDIDATE_POSE_VERSION, TIME_MAX_NS, U8_MAX, U32_MAX, WireError, check_start, checked_int
from common.wire.skeleton_packet import POSE_BYTES, decode_pose, encode_pose
from common.wire.view_codec import VIEW_MAX_PIXELS, decode_view, encode_view
from common.wire.view_quality import FINE, ViewQuality

CANDIDATE_POSE_MAX_BYTES = 1 << 22
MAX_VIEWS = 16
MAX_PIXELS = 2 * VIEW_MAX_PIXELS  # of all views together: bounds what a candidate can make a receiver allocate

_HEADER = struct.Struct("<BBIIqBB")
_LENGTH = struct.Struct("<I")
_REGION_GROWING, _ZIPPERED = 1, 2
_FIXED_BYTES = _HEADER.size + SKELETON_BYTES + POSE_BYTES


@dataclass(frozen=True, slots=True, eq=False)
class CandidatePose:
    """One captured frame: ``pose_id`` numbers the candidates of an ``epoch``; ``capture_ns`` is the sender's monotonic
    clock [ns]; ``skeleton`` and ``pose`` are those fitted at that instant; ``views`` at least one, at most 16;
    ``rigging``: how the mesh is built of them."""

    pose_id: int
    person: int
    epoch: int
    capture_ns: int
    skeleton: Skeleton
    pose: SkeletonPose
    views: tuple[View, ...]
    rigging: Rigging = DEFAULT_RIGGING


def encode_candidate_pose(candidate: CandidatePose, quality: ViewQuality = FINE) -> bytes:
    """Bytes of a candidate pose, at most ``CANDIDATE_POSE_MAX_BYTES``.

    Raises:
        WireError: a number outside its range, no view or too many, or more bytes or pixels than allowed.
    """
    if sum(view.depth_mm.size for view in candidate.views) > MAX_PIXELS:
        raise WireError(f"candidate pose: more than {MAX_PIXELS} pixels")
    parts = [
        _HEADER.pack(
            CANDIDATE_POSE_VERSION,
            checked_int("person", candidate.person, 0, U8_MAX),
            checked_int("epoch", candidate.epoch, 0, U32_MAX),
            checked_int("pose id", candidate.pose_id, 0, U32_MAX),
            checked_int("capture time", candidate.capture_ns, 0, TIME_MAX_NS),
            _encode_rigging(candidate.rigging),
            checked_int("number of views", len(candidate.views), 1, MAX_VIEWS),
        ),
        encode_skeleton_sizes(candidate.skeleton),
        encode_pose(candidate.pose),
    ]
    for view in candidate.views:
        encoded = encode_view(view, quality)
        parts += [_LENGTH.pack(len(encoded)), encoded]
    data = b"".join(parts)
    if len(data) > CANDIDATE_POSE_MAX_BYTES:
        raise WireError(f"candidate pose: {len(data)} bytes, at most {CANDIDATE_POSE_MAX_BYTES} are allowed")
    return data


def decode_candidate_pose(data: bytes) -> CandidatePose:
    """The candidate pose of ``encode_candidate_pose``'s bytes.

    Raises:
        WireError: anything that is not exactly one candidate pose within the bounds.
    """
    check_start("candidate pose", data, CANDIDATE_POSE_VERSION, CANDIDATE_POSE_MAX_BYTES)
    if len(data) < _FIXED_BYTES:
        raise WireError(f"candidate pose: {len(data)} bytes are fewer than its fixed part")
    _, person, epoch, pose_id, capture_ns, flags, view_count = _HEADER.unpack_from(data)
    checked_int("capture time", capture_ns, 0, TIME_MAX_NS)
    checked_int("number of views", view_count, 1, MAX_VIEWS)
    rigging = _decode_rigging(flags)
    skeleton = decode_skeleton_sizes(data[_HEADER.size : _HEADER.size + SKELETON_BYTES])
    pose = decode_pose(data[_HEADER.size + SKELETON_BYTES : _FIXED_BYTES])
    views = _decode_views(data, view_count)
    return CandidatePose(pose_id, person, epoch, capture_ns, skeleton, pose, views, rigging)


def _encode_rigging(rigging: Rigging) -> int:
    grown, zippered = rigging.segmentation == "region-growing", rigging.views == "zippered"
    return (_REGION_GROWING if grown else 0) | (_ZIPPERED if zippered else 0)


def _decode_rigging(flags: int) -> Rigging:
    if flags & ~(_REGION_GROWING | _ZIPPERED):  # a mesh built otherwise than the sender's would be judged wrongly
        raise WireError(f"candidate pose: rigging 0x{flags:02x} asks for what is not known here")
    segmentation: Segmentation = "region-growing" if flags & _REGION_GROWING else "voronoi"
    return Rigging(segmentation, "zippered" if flags & _ZIPPERED else "separate")


def _decode_views(data: bytes, count: int) -> tuple[View, ...]:
    views: list[View] = []
    position = _FIXED_BYTES
    pixels_left = MAX_PIXELS
    for _ in range(count):
        start = position + _LENGTH.size
        if start > len(data):
            raise WireError(f"candidate pose: ends before view {len(views) + 1} of {count}")
        position = start + _LENGTH.unpack_from(data, start - _LENGTH.size)[0]
        if position > len(data):
            raise WireError(f"candidate pose: view {len(views) + 1} of {count} is longer than the data")
        views.append(decode_view(data[start:position], min(pixels_left, VIEW_MAX_PIXELS)))
        pixels_left -= views[-1].depth_mm.size
    if position != len(data):
        raise WireError(f"candidate pose: {len(data) - position} bytes after the last view")
    return tuple(views)
