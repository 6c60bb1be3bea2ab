"""The strong rival's coder: all cameras' colour and depth as two videos of a fixed bit rate, and silhouettes.

Each camera's window, the part of its image where the person ever is, is a tile of one picture. Beyond the silhouette
colour and depth (10 bits) go on as the mean of what is near, so that no edge costs bits; the silhouette itself is sent
by zlib without loss, as a depth that is cut by a lossy one loses two decibels. No B-frames and no look-ahead, one key
frame at the start. The motion is coded once; a session that repeats it repeats the pictures, too, which spares the
video the cut. Other coders than real-time H.265 are for the residuals bench.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.view import View
from common.geometry.camera_model import Camera
from scripts.fidelity_capture import FRAME_RATE_HZ

DEPTH_SHARE = 0.5  # of the bits
BUFFER_S = 0.2  # a picture may be so much larger than its share
_MAX_10_BIT = 1023
EDGE_MM = 100  # of depth within a pixel or two: two surfaces
_MARGIN_MM = 50  # of the depths that can be coded around those looked at


@dataclass(frozen=True, slots=True)
class VideoCoder:
    """FFmpeg's names of ``encoder``, its ``preset`` and the ``decoder``. ``live``: no picture waits for a later one,
    and none is much larger than its share; else the encoder looks ahead, and only the whole keeps to the rate."""

    encoder: str
    decoder: str
    preset: str
    live: bool = True


H265_LIVE = VideoCoder("libx265", "hevc", "superfast")


@dataclass(frozen=True, slots=True)
class VideoRung:
    """``step``: pixels per sample each way; ``every``: one of so many frames is coded; ``chroma``: 444, 420."""

    step: int
    every: int
    chroma: int


# Up to so many bit/s. A video that is shown as it comes is late by its frame rate; one that is warped is not, and gains
# more from better frames than from more (14_06 at 1 Mbit/s: 2 a second 23.6 dB, 5 a second 22.9 dB).
Ladder = tuple[tuple[float, VideoRung], ...]
SHOWN_LADDER: Ladder = (
    (150e3, VideoRung(3, 6, 420)),
    (500e3, VideoRung(3, 3, 420)),
    (3e6, VideoRung(2, 2, 420)),
    (float("inf"), VideoRung(1, 1, 420)),
)
WARPED_LADDER: Ladder = (
    (60e3, VideoRung(3, 30, 420)),
    (500e3, VideoRung(2, 20, 420)),
    (3e6, VideoRung(1, 15, 420)),
    (float("inf"), VideoRung(1, 4, 444)),
)


def rung_for(ladder: Ladder, rate_bps: float) -> VideoRung:
    """The rung of a bandwidth."""
    return next(rung for limit, rung in ladder if rate_bps <= limit)


@dataclass(frozen=True, slots=True)
class _Window:
    """Where a camera's tile lies: its corner in the image, its size there, and where it begins in the picture."""

    camera: Camera
    u0: int
    v0: int
    width: int
    height: int
    left: int


@dataclass(frozen=True, slots=True, eq=False)
class CodedVideo:
    """``sizes``: bytes of each coded frame, by its index in the capture; ``views``: what it decodes to."""

    sizes: dict[int, int]
    views: dict[int, tuple[View, ...]]


class Filmed(Protocol):
    """What a video is made of: frames from 0 to ``length``, as a ``Capture`` has them."""

    @property
    def length(self) -> int: ...
    def frame(self, k: int, /) -> Seen: ...


class Seen(Protocol):
    """One frame, of which only the views count."""

    @property
    def views(self) -> tuple[View, ...]: ...


@lru_cache(maxsize=2)
def coded_video(recorded: Filmed, rate_bps: float, rung: VideoRung, coder: VideoCoder = H265_LIVE) -> CodedVideo:
    """The whole motion at a bit rate, coded and decoded."""
    windows = _windows(recorded, rung.step)
    indices = [k for k in range(recorded.length) if k % rung.every == 0 and recorded.frame(k).views]
    samples = [view.depth_mm for k in indices[::30] for view in recorded.frame(k).views]
    near = min(int(depth[depth > 0].min()) for depth in samples) - _MARGIN_MM
    step_mm = max((max(int(depth.max()) for depth in samples) + _MARGIN_MM - near) / _MAX_10_BIT, 1.0)
    size = (sum(window.width for window in windows), max(window.height for window in windows))
    fps = FRAME_RATE_HZ / rung.every
    silhouettes = [_silhouette(_packed(recorded.frame(k).views, windows, size)[1] > 0, rung.step) for k in indices]
    silhouette_bps = sum(map(len, silhouettes)) / len(silhouettes) * 8 * fps
    video_bps = max(rate_bps - silhouette_bps, rate_bps / 4)
    colours = _Stream(size, rung.step, f"yuv{rung.chroma}p", fps, video_bps * (1 - DEPTH_SHARE), coder)
    depths = _Stream(size, rung.step, "gray10le", fps, video_bps * DEPTH_SHARE, coder)
    for k in indices:
        colour, depth_mm = _packed(recorded.frame(k).views, windows, size)
        colours.code(_colour_planes(colour, depth_mm > 0))
        depths.code([_carried_on((depth_mm[..., None] - near) / step_mm, depth_mm > 0)[..., 0]])
    bytes_each = zip(colours.sizes(), depths.sizes(), map(len, silhouettes), strict=True)
    views = {}
    for k, (y, cb, cr), (luma, *_), coded in zip(
        indices, colours.decoded(), depths.decoded(), silhouettes, strict=True
    ):
        rgb = np.asarray(cv2.cvtColor(cv2.merge([y, cr, cb]), cv2.COLOR_YCrCb2RGB), np.uint8)
        seen = _seen(coded, size, rung.step)
        luma = _sharpened(luma, EDGE_MM / step_mm, rung.step)
        depth_mm = np.where(seen, near + luma * np.float32(step_mm) + 0.5, 0).astype(np.uint16)
        views[k] = _views(rgb, depth_mm, windows)
    return CodedVideo(dict(zip(indices, map(sum, bytes_each), strict=True)), views)


def _sharpened(luma: NDArray[np.uint16], edge: float, step: int) -> NDArray[np.uint16]:
    """Decoded depth (h, w) whose smeared edges are steps again: values between two surfaces more than ``edge`` apart
    go to the nearer of them. Without this a curtain hangs between a hand and the hip behind it."""
    around = np.ones((2 * step + 1, 2 * step + 1), np.uint8)
    low, high = np.asarray(cv2.erode(luma, around), np.uint16), np.asarray(cv2.dilate(luma, around), np.uint16)
    return np.where(high - low > edge, np.where(luma - low < high - luma, low, high), luma)


def _silhouette(seen: NDArray[np.bool_], step: int) -> bytes:
    """A mask (h, w) at 1/``step`` of its size, row after row as the difference to the one above."""
    small = (seen.shape[1] // step, seen.shape[0] // step)
    bits = cv2.resize(seen.astype(np.float32), small, interpolation=cv2.INTER_AREA) >= 0.5
    return zlib.compress(np.packbits(np.diff(bits, axis=0, prepend=False)).tobytes(), 9)


def _seen(coded: bytes, size: tuple[int, int], step: int) -> NDArray[np.bool_]:
    """The mask (h, w) of ``_silhouette``'s bytes; ``size`` (w, h)."""
    width, height = size[0] // step, size[1] // step
    changes = np.unpackbits(np.frombuffer(zlib.decompress(coded), np.uint8), count=width * height)
    bits = np.logical_xor.accumulate(changes.reshape(height, width).astype(bool), axis=0)
    return np.asarray(cv2.resize(bits.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) >= 0.5)


def _windows(recorded: Filmed, step: int) -> list[_Window]:
    """Every camera's window, a multiple of 16 samples large, side by side."""
    boxes: dict[str, tuple[Camera, list[int]]] = {}
    for k in range(recorded.length):
        for view in recorded.frame(k).views:
            h, w = view.depth_mm.shape
            _, box = boxes.setdefault(view.camera.name, (view.camera, [view.u0, view.v0, 0, 0]))
            box[:] = min(box[0], view.u0), min(box[1], view.v0), max(box[2], view.u0 + w), max(box[3], view.v0 + h)
    grain = 16 * step
    windows, left = [], 0
    for camera, (u0, v0, u1, v1) in boxes.values():
        windows.append(_Window(camera, u0, v0, -(-(u1 - u0) // grain) * grain, -(-(v1 - v0) // grain) * grain, left))
        left += windows[-1].width
    return windows


def _packed(
    views: Sequence[View], windows: Sequence[_Window], size: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """One picture of colour (h, w, 3) and one of depth (h, w) [mm], 0 = not the person."""
    colour, depth_mm = np.zeros((size[1], size[0], 3), np.uint8), np.zeros((size[1], size[0]), np.uint16)
    by_name = {window.camera.name: window for window in windows}
    for view in views:
        window, (h, w) = by_name[view.camera.name], view.depth_mm.shape
        v, u = view.v0 - window.v0, view.u0 - window.u0 + window.left
        colour[v : v + h, u : u + w], depth_mm[v : v + h, u : u + w] = view.colour, view.depth_mm
    return colour, depth_mm


def _views(colour: NDArray[np.uint8], depth_mm: NDArray[np.uint16], windows: Sequence[_Window]) -> tuple[View, ...]:
    """The tiles as views, cropped to the person and to the camera's image."""
    views = []
    for window in windows:
        c = window.camera
        h, w = min(window.height, c.height - window.v0), min(window.width, c.width - window.u0)
        tile = depth_mm[:h, window.left : window.left + w]
        rows, columns = np.flatnonzero(tile.any(axis=1)), np.flatnonzero(tile.any(axis=0))
        if len(rows):
            v, u = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            seen = np.ascontiguousarray(colour[:h, window.left : window.left + w][v, u])
            crop = np.ascontiguousarray(tile[v, u])
            views.append(View(c, window.u0 + int(columns[0]), window.v0 + int(rows[0]), crop, seen))
    return tuple(views)


def _carried_on(values: NDArray[Any], seen: NDArray[np.bool_]) -> NDArray[np.float32]:
    """``values`` (h, w, n) where ``seen``; elsewhere the mean of those near, far away of all: smooth, cheap to code."""
    weight = seen.astype(np.float32)
    masked = values.astype(np.float32) * weight[..., None]
    out = np.broadcast_to(masked.sum(axis=(0, 1)) / max(weight.sum(), 1), values.shape).astype(np.float32)
    h, w = seen.shape
    for scale in (32, 8, 4):  # finer ones over coarser ones
        small = (max(w // scale, 1), max(h // scale, 1))
        share = cv2.blur(cv2.resize(weight, small, interpolation=cv2.INTER_AREA), (3, 3))
        total = cv2.blur(cv2.resize(masked, small, interpolation=cv2.INTER_AREA), (3, 3)).reshape(*share.shape, -1)
        coarse = cv2.resize(out, small, interpolation=cv2.INTER_AREA).reshape(*share.shape, -1)
        confidence = np.minimum(share * 8, 1)[..., None]
        level = confidence * total / np.maximum(share, 1e-6)[..., None] + (1 - confidence) * coarse
        out = np.asarray(cv2.resize(level, (w, h), interpolation=cv2.INTER_LINEAR), np.float32).reshape(values.shape)
    return np.where(seen[..., None], values, out).astype(np.float32)


def _colour_planes(colour: NDArray[np.uint8], seen: NDArray[np.bool_]) -> list[NDArray[np.float32]]:
    filled = np.clip(_carried_on(colour, seen) + 0.5, 0, 255).astype(np.uint8)
    y, cr, cb = cv2.split(cv2.cvtColor(filled, cv2.COLOR_RGB2YCrCb))
    return [plane.astype(np.float32) for plane in (y, cb, cr)]


class _Stream:
    """One video of pictures ``size`` (w, h), coded at 1/``step`` of it; packets are kept."""

    def __init__(
        self, size: tuple[int, int], step: int, pixels: str, fps: float, rate_bps: float, kind: VideoCoder
    ) -> None:
        import av

        kbps = max(int(rate_bps / 1000), 1)
        coder: Any = av.CodecContext.create(kind.encoder, "w")
        coder.width, coder.height = size[0] // step, size[1] // step
        coder.pix_fmt = pixels
        coder.framerate = Fraction(fps).limit_denominator(1000)
        coder.time_base = 1 / coder.framerate
        rate = f"bitrate={kbps}"
        if kind.live:
            rate += f":vbv-maxrate={kbps}:vbv-bufsize={max(int(kbps * max(BUFFER_S, 1 / fps)), 1)}:scenecut=0"
        single = "log-level=none:pools=none:frame-threads=1:keyint=-1"
        if kind.encoder == "libx264":
            single = "threads=1:keyint=infinite"
        coder.options = {"preset": kind.preset, f"{kind.encoder.removeprefix('lib')}-params": f"{rate}:{single}"}
        if kind.live:
            coder.options |= {"tune": "zerolatency"}
        self._coder, self._size, self._pixels, self._count = coder, size, pixels, 0
        self._decoder_name = kind.decoder
        self._packets: list[Any] = []

    def code(self, planes: Sequence[NDArray[np.float32]]) -> None:
        """The next frame: its planes (h, w) of samples' values."""
        import av

        frame: Any = av.VideoFrame(self._coder.width, self._coder.height, self._pixels)
        kind: Any = np.uint16 if "10" in self._pixels else np.uint8
        for plane, values in zip(frame.planes, planes, strict=True):
            small = cv2.resize(values, (plane.width, plane.height), interpolation=cv2.INTER_AREA)
            rows = np.zeros((plane.height, plane.line_size // np.dtype(kind).itemsize), kind)
            rows[:, : plane.width] = np.clip(small + np.float32(0.5), 0, _MAX_10_BIT if kind is np.uint16 else 255)
            plane.update(rows)
        frame.pts = self._count
        self._count += 1
        self._packets += self._coder.encode(frame)

    def sizes(self) -> list[int]:
        """Bytes of every frame; no more can be coded."""
        self._packets += self._coder.encode(None)
        assert len(self._packets) == self._count, f"{len(self._packets)} packets of {self._count} frames"
        return [packet.size for packet in self._packets]

    def decoded(self) -> Iterator[list[NDArray[Any]]]:
        """The planes of every frame as the other end has them, at full size."""
        import av

        decoder: Any = av.CodecContext.create(self._decoder_name, "r")
        decoder.thread_count = 1
        kind: Any = np.uint16 if "10" in self._pixels else np.uint8
        for packet in [*self._packets, None]:
            for frame in decoder.decode(packet):
                planes: Any = (np.frombuffer(p, kind).reshape(p.height, -1)[:, : p.width] for p in frame.planes)
                yield [cv2.resize(plane, self._size, interpolation=cv2.INTER_LINEAR) for plane in planes]
