"""Codecs the residual maps are measured beside, all fed the same views or points; what they decode to is sampled again.

Each frame by itself: "yang" (Yang et al. 2006: zlib depth, JPEG colour; here as good as it gets: depth as differences,
the background filled), "rvl" (RVL and zlib depth, JPEG), "views" (our candidate poses'), "draco" (a point cloud).
As video: "h264", "h265" with presets for real time, "h265-slow" offline, colour and depth, silhouettes without loss.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from common.body.view import View
from common.geometry.point_cloud import PointCloud
from common.wire.colour_codec import decode_colour, encode_colour
from common.wire.view_codec import decode_view, encode_view
from common.wire.view_quality import ViewQuality
from scripts.fidelity_frames import Rung, yang_views
from scripts.fidelity_video import H265_LIVE, VideoCoder, VideoRung, coded_video
from scripts.residual_sequences import PosedSequence
from scripts.rvl import decode_rvl, encode_rvl, in_steps


@dataclass(frozen=True, slots=True)
class CodedFrame:
    """``size_bytes`` of a frame, and how its points are had from them; ``encode_s``: what coding took."""

    size_bytes: float
    encode_s: float
    decoded: Callable[[], PointCloud]


Encode = Callable[[PosedSequence, int], CodedFrame]

YANG = {"low": Rung(3, 60, 8), "half": Rung(2, 75, 4), "full": Rung(1, 50, 2), "best": Rung(1, 85, 1)}
RVL = {"low": (30, 8), "mid": (50, 4), "high": (85, 1)}  # JPEG quality, depth step [mm]
VIEWS = {"low": ViewQuality("webp", 40, 4), "mid": ViewQuality("jpeg", 50, 2), "high": ViewQuality("jpeg", 85, 0)}
DRACO = {"low": (4, 9, 4), "half": (2, 10, 5), "full": (1, 10, 6), "best": (1, 11, 8)}  # of so many points one, bits
VIDEO_RATES_BPS = {"0.3M": 0.3e6, "0.6M": 0.6e6, "1.2M": 1.2e6, "2.5M": 2.5e6, "5M": 5e6}
VIDEO_CODERS = {
    "h264": VideoCoder("libx264", "h264", "veryfast"),
    "h265": H265_LIVE,
    "h265-slow": VideoCoder("libx265", "hevc", "slow", live=False),
}
_FINE_FROM_BPS = 4e6  # below, video is coded at half its resolution: better at such rates


def yang_frame(rung: Rung, sequence: PosedSequence, k: int) -> CodedFrame:
    """zlib and JPEG."""
    begun = time.perf_counter()
    size, views = yang_views(sequence.frame(k).views, rung)
    return CodedFrame(size, time.perf_counter() - begun, partial(sequence.points, views))


def rvl_frame(quality: tuple[int, int], sequence: PosedSequence, k: int) -> CodedFrame:
    """RVL, zlib and JPEG."""
    jpeg_quality, step_mm = quality
    views = sequence.frame(k).views
    begun = time.perf_counter()
    depth = [zlib.compress(encode_rvl(in_steps(view.depth_mm, step_mm)), 6) for view in views]
    colour = [encode_colour(view.colour, view.depth_mm, "jpeg", jpeg_quality) for view in views]
    took = time.perf_counter() - begun

    def decoded() -> PointCloud:
        back = []
        for view, packed, jpeg in zip(views, depth, colour, strict=True):
            height, width = view.depth_mm.shape
            steps = decode_rvl(zlib.decompress(packed), height, width)
            back.append(replace(view, depth_mm=steps * np.uint16(step_mm), colour=decode_colour(jpeg, height, width)))
        return sequence.points(back)

    return CodedFrame(sum(map(len, depth + colour)), took, decoded)


def views_frame(quality: ViewQuality, sequence: PosedSequence, k: int) -> CodedFrame:
    """As a candidate pose's views are coded."""
    begun = time.perf_counter()
    coded = [encode_view(view, quality) for view in sequence.frame(k).views]
    took = time.perf_counter() - begun

    def decoded() -> PointCloud:
        views = [decode_view(data) for data in coded]
        pairs = zip(views, sequence.frame(k).views, strict=True)
        return sequence.points([replace(view, camera=sent.camera) for view, sent in pairs])

    return CodedFrame(sum(map(len, coded)), took, decoded)


def draco_frame(settings: tuple[int, int, int], sequence: PosedSequence, k: int) -> CodedFrame:
    """A Draco point cloud, thinned and its colours rounded to save bytes."""
    import DracoPy

    every, bits, colour_bits = settings
    cloud, lost = sequence.cloud(k), 8 - colour_bits
    begun = time.perf_counter()
    coded = DracoPy.encode(
        cloud.positions[::every], quantization_bits=bits, compression_level=7,
        colors=np.ascontiguousarray(cloud.colours[::every] >> lost),
    )  # fmt: skip

    def decoded() -> PointCloud:
        got = DracoPy.decode(coded)
        colours = (np.asarray(got.colors).astype(np.int32) << lost) + ((1 << lost) >> 1)
        points = np.ascontiguousarray(got.points, np.float32)
        return PointCloud(points, np.zeros_like(points), np.clip(colours, 0, 255).astype(np.uint8))

    return CodedFrame(len(coded), time.perf_counter() - begun, decoded)


def filmed(name: str, rate_bps: float, sequence: PosedSequence) -> Encode:
    """All frames as video, ahead; a frame's bytes are the mean, as a rate is what a video keeps to. Coding and decoding
    come in one: ``encode_s`` is a frame's share of both."""
    rung = VideoRung(1 if rate_bps >= _FINE_FROM_BPS else 2, 1, 420)
    begun = time.perf_counter()
    video = coded_video(sequence, rate_bps, rung, VIDEO_CODERS[name])
    took = (time.perf_counter() - begun) / sequence.length
    mean = sum(video.sizes.values()) / len(video.sizes)

    def frame(sequence: PosedSequence, k: int) -> CodedFrame:
        return CodedFrame(
            mean, took, partial(sequence.points, _where_they_are(video.views[k], sequence.frame(k).views))
        )

    return frame


def _where_they_are(decoded: Sequence[View], sent: Sequence[View]) -> list[View]:
    """Decoded views with the cameras of their own frame: some move."""
    cameras = {view.camera.name: view.camera for view in sent}
    return [replace(view, camera=cameras.get(view.camera.name, view.camera)) for view in decoded]


def rivals() -> dict[str, Callable[[PosedSequence], Encode]]:
    """Every rival by ``method/level``."""
    found: dict[str, Callable[[PosedSequence], Encode]] = {}
    for level, rung in YANG.items():
        found[f"yang/{level}"] = lambda _, rung=rung: partial(yang_frame, rung)  # type: ignore[misc]
    for level, quality in RVL.items():
        found[f"rvl/{level}"] = lambda _, quality=quality: partial(rvl_frame, quality)  # type: ignore[misc]
    for level, view_quality in VIEWS.items():
        found[f"views/{level}"] = lambda _, quality=view_quality: partial(views_frame, quality)  # type: ignore[misc]
    for level, settings in DRACO.items():
        found[f"draco/{level}"] = lambda _, settings=settings: partial(draco_frame, settings)  # type: ignore[misc]
    for name in VIDEO_CODERS:
        for rate, rate_bps in VIDEO_RATES_BPS.items():
            found[f"{name}/{rate}"] = partial(filmed, name, rate_bps)
    return found
