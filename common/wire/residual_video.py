"""A few frames' maps as one short video (Lien §1, §5.2): one residual packet of kind "video" for a group of N frames.

Colours and radii are two H.264 videos, what is full comes without loss. In successive frames a link's map is the same
picture but for the sensors' noise, which a lossless code of radii spends its bytes on and a video leaves out. Small
pictures are coded better by H.264 than by H.265, and in a third of the time. A cell that is empty in a frame holds the
mean of those frames in which it is full, so that it does not change. Each group decodes by itself.

The delay: nothing of a group can be shown before its last frame is captured.

Layout of the sections. Occupancy: N u8, N × (time since the group's first frame u32 [ns], skeleton packets since its
u16), masks of N frames (``mask_codec``). Radius, colour: NAL units, each behind 0 0 1: one set of parameters, N
pictures of one slice. FFmpeg decodes them, which must not be led astray: other units are refused before, pictures that
are not of the layout's size before they are allocated.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.cylindrical_map import LinkMaps
from common.body.map_layout import CELLS_MAX, MapLayout
from common.wire.header import TIME_MAX_NS, U32_MAX, WireError, checked_int
from common.wire.map_codec import MapQuality, MapSections, fill_empty
from common.wire.mask_codec import decode_masks, encode_masks
from common.wire.residual_packet import ResidualHeader, packed, parsed

if TYPE_CHECKING:
    from types import ModuleType

FRAMES_MAX = 30

_FRAME = struct.Struct("<IH")
_START = b"\0\0\1"
_SLICE, _KEY_SLICE, _SPS, _PPS = 1, 5, 7, 8  # NAL unit types of H.264
_NO_PICTURE = {6, 9}  # what an encoder tells besides
_ALIGNED = 64  # cells by which FFmpeg enlarges pictures
_SETTINGS = "threads=1:keyint=infinite:scenecut=0"  # one slice a picture, only the first one a key
_FRAME_TIME = Fraction(1, 30)  # which an encoder wants to know, and no decoder
_DECODED = "yuv420p"
_GREY = 128


class VideoUnavailable(WireError):
    """PyAV is not installed; the text says how to."""


@dataclass(frozen=True, slots=True, eq=False)
class GroupFrame:
    """One frame's maps; ``capture_ns``, ``skeleton_sequence``: as in ``ResidualHeader``."""

    capture_ns: int
    skeleton_sequence: int
    maps: LinkMaps


def require_video() -> ModuleType:
    """PyAV, whose wheel brings FFmpeg and x264.

    Raises:
        VideoUnavailable: it is not there.
    """
    try:
        import av
    except ImportError as error:
        raise VideoUnavailable(
            f"residual maps as video need the video extra: pip install '.[video]' ({error})"
        ) from error
    return av


def encode_group(header: ResidualHeader, layout: MapLayout, frames: Sequence[GroupFrame]) -> bytes:
    """The packet of N ≥ 1 frames of one ``layout``, ``header.layout`` of their body. ``header``: of kind "video", time
    and skeleton those of the first; its frames are numbered from ``header.sequence`` on.

    Raises:
        WireError: frames that are too many or too far apart, or as ``encode_residual``.
        VideoUnavailable: PyAV is not installed.
    """
    assert header.kind == "video"
    _check_size(layout, len(frames))
    table = bytes([len(frames)])
    for frame in frames:
        since_ns = checked_int("time in the group", frame.capture_ns - header.capture_ns, 0, U32_MAX)
        since = checked_int("skeleton in the group", frame.skeleton_sequence - header.skeleton_sequence, 0, 0xFFFF)
        table += _FRAME.pack(since_ns, since)
    full = np.stack([frame.maps.full for frame in frames])
    colours = _still(full, np.stack([frame.maps.colour for frame in frames]))
    radii = _still(full, np.stack([frame.maps.radius[..., None] for frame in frames]))[..., 0]
    planes = [cv2.cvtColor(colour, cv2.COLOR_RGB2YUV_I420) for colour in colours]
    return packed(
        header,
        MapSections(
            table + encode_masks(layout.places, full, None),
            _encode_video(list(radii), "gray", layout, _radius_crf(header.quality)),
            _encode_video(planes, "yuv420p", layout, _colour_crf(header.quality)),
        ),
    )


def decode_group(data: bytes, layout: MapLayout) -> list[tuple[ResidualHeader, LinkMaps]]:
    """Every frame of a packet with a header of its own; ``layout`` as in ``encode_group``. Nothing larger than the
    layout is allocated, whatever the bytes declare.

    Raises:
        WireError: anything that is not exactly one group of this layout; PyAV is not installed.
    """
    header, sections = parsed(data)
    if header.kind != "video":
        raise WireError(f"residual video: a {header.kind} packet")
    count = checked_int("frames", sections.occupancy[0] if sections.occupancy else 0, 1, FRAMES_MAX)
    _check_size(layout, count)
    begin = 1 + count * _FRAME.size
    if len(sections.occupancy) < begin:
        raise WireError(f"residual video: its table of {count} frames is cut")
    full = decode_masks(layout.places, sections.occupancy[begin:], (count, layout.height, layout.width), None)
    radii = [planes[: layout.height] for planes in _decode_video("radius", sections.radius, layout, count)]
    colours = _decode_video("colour", sections.colour, layout, count)
    out = []
    for n, (since_ns, since) in enumerate(_FRAME.iter_unpack(sections.occupancy[1:begin])):
        own = replace(
            header,
            sequence=checked_int("sequence", header.sequence + n, 0, U32_MAX),
            capture_ns=checked_int("capture time", header.capture_ns + since_ns, 0, TIME_MAX_NS),
            skeleton_sequence=(header.skeleton_sequence + since) & U32_MAX,
        )
        colour = np.asarray(cv2.cvtColor(colours[n], cv2.COLOR_YUV2RGB_I420), np.uint8)
        out.append((own, LinkMaps(full[n], colour * full[n][..., None], radii[n] * full[n])))
    return out


def frame_count(data: bytes) -> int:
    """How many frames a residual packet of any kind, as an encoder here has made it, is of."""
    header, sections = parsed(data)
    return sections.occupancy[0] if header.kind == "video" else 1


def _check_size(layout: MapLayout, frames: int) -> None:
    cells = frames * layout.height * layout.width
    if frames > FRAMES_MAX or cells > CELLS_MAX:
        raise WireError(f"residual video: {frames} frames of {cells} cells in all, at most {FRAMES_MAX} of {CELLS_MAX}")


def _colour_crf(quality: MapQuality) -> float:
    """x264's rate factor that looks as a JPEG of this quality does: measured at 50 to 70."""
    return 40 - quality.jpeg / 5


def _radius_crf(quality: MapQuality) -> float:
    """x264's rate factor of radii: at 3 steps of 2 mm they are off by 3 mm rms, half of which is noise left out."""
    return 4.0 * quality.radius_steps


def _still(full: NDArray[np.bool_], values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``values`` (N, H, W, C) whose empty cells do not change: the mean of the frames in which they are ``full``
    (N, H, W), else that of the cells around them."""
    times = full.sum(axis=0, dtype=np.int32)
    total = (values * full[..., None]).sum(axis=0, dtype=np.int32)
    mean = (total // np.maximum(times, 1)[..., None]).astype(np.uint8)
    still = np.empty_like(mean)
    fill_empty(mean, times > 0, np.full(values.shape[3], _GREY, np.uint8), still)
    return np.where(full[..., None], values, still)


def _encode_video(pictures: Sequence[NDArray[np.uint8]], pixels: str, layout: MapLayout, crf: float) -> bytes:
    """The NAL units of pictures as PyAV has them for FFmpeg's format ``pixels``, without what only tells of them."""
    av = require_video()
    coder: Any = av.CodecContext.create("libx264", "w")
    coder.width, coder.height, coder.pix_fmt, coder.time_base = layout.width, layout.height, pixels, _FRAME_TIME
    coder.options = {"preset": "veryfast", "x264-params": f"crf={crf:g}:{_SETTINGS}"}
    packets = []
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, format=pixels)
        frame.pts = number
        packets += coder.encode(frame)
    packets += coder.encode(None)
    units = (unit for packet in packets for unit in re.split(b"\0*\0\0\1", bytes(packet)) if unit)
    return b"".join(_START + unit for unit in units if unit[0] & 31 not in _NO_PICTURE)


def _decode_video(name: str, data: bytes, layout: MapLayout, count: int) -> list[NDArray[np.uint8]]:
    """The ``count`` pictures (3/2 H, W) of ``_encode_video``'s bytes, luma first, of the layout's size; grey ones, too,
    get chroma here."""
    av = require_video()
    before, *units = data.split(_START)
    wanted = [_SPS, _PPS, _KEY_SLICE, *[_SLICE] * (count - 1)]
    if before or [unit[0] & 31 if unit else None for unit in units] != wanted:
        raise WireError(f"{name}: not the NAL units of {count} pictures")
    decoder: Any = av.CodecContext.create("h264", "r")
    decoder.thread_count = 1
    decoder.options = {"max_pixels": str((layout.width + _ALIGNED) * (layout.height + _ALIGNED))}
    pictures: list[Any] = []
    try:
        for units_of_one in [units[:3], *([unit] for unit in units[3:])]:
            pictures += decoder.decode(av.Packet(b"".join(_START + unit for unit in units_of_one)))
        pictures += decoder.decode(None)
    except av.error.FFmpegError as error:
        raise WireError(f"{name}: {error}") from error
    seen = {(picture.width, picture.height, picture.format.name) for picture in pictures}
    if len(pictures) != count or seen != {(layout.width, layout.height, _DECODED)}:
        raise WireError(
            f"{name}: {len(pictures)} pictures of {seen}, expected {count} of {layout.width}×{layout.height}"
        )
    return [np.asarray(picture.to_ndarray(), np.uint8) for picture in pictures]
