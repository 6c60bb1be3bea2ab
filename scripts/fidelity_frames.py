"""Rivals that compress every frame by itself and send it whole: zlib depth and JPEG colour (Yang et al. 2006), and a
Draco mesh with a JPEG texture.

Rate control: a ladder of qualities and resolutions. The finest rung is sent of which the link carries as many frames a
second as are aimed at; how many, goes by the bandwidth (``FRAMES_PER_S``: what gave the best ``psnr_seen_db``). Each
frame is the newest when the link becomes free: nothing waits in a queue.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.rigged_mesh import DRAWN_EDGE_M, MESH_STRIDE
from common.body.view import View
from common.geometry.camera_model import Camera
from common.geometry.triangle_mesh import TriangleMesh
from scripts.capture_files import CapturedFrame
from scripts.fidelity import Picture
from scripts.fidelity_capture import FRAME_RATE_HZ, Capture
from scripts.fidelity_link import ByteLink
from scripts.fidelity_methods import Screen
from scripts.fidelity_surface import pictures_of, reduced, surface_of

PROBED_EVERY = 5 * FRAME_RATE_HZ  # frames: the rung is chosen anew
# Aimed at up to so many bit/s. 14_06 by zlib: at 1 Mbit/s 4, 8, 15 a second give 18.8, 21.4, 21.0 dB; at 0.1 Mbit/s
# 1 gives 14.9 dB and 2, which is all that the coarsest rung allows, 15.8 dB.
FRAMES_PER_S = ((150e3, 2.0), (500e3, 3.0), (3e6, 8.0), (float("inf"), 15.0))


@dataclass(frozen=True, slots=True)
class Rung:
    """``step``: pixels per sample each way; ``quality``: JPEG; ``depth``: mm per step (Yang) or bits (Draco)."""

    step: int
    quality: int
    depth: int


YANG_LADDER = tuple(
    Rung(*rung)
    for rung in ((1, 85, 2), (1, 75, 4), (2, 85, 4), (2, 75, 6), (3, 80, 6), (4, 75, 8), (6, 70, 12), (8, 60, 16))
)
DRACO_LADDER = tuple(
    Rung(*rung) for rung in ((2, 85, 12), (3, 75, 11), (4, 75, 11), (6, 75, 10), (8, 70, 10), (12, 60, 9), (16, 50, 9))
)


def yang(views: Sequence[View], rung: Rung) -> tuple[int, Callable[[], TriangleMesh]]:
    """Bytes of the views, and the surface on the other end."""
    size, decoded = yang_views(views, rung)
    stride = MESH_STRIDE if rung.step == 1 else 1
    return size, lambda: surface_of(decoded, stride, DRAWN_EDGE_M * max(1, rung.step / 3))


def yang_views(views: Sequence[View], rung: Rung) -> tuple[int, list[View]]:
    """Bytes of the views, and the views on the other end. Depth: differences along the rows by zlib."""
    size = 0
    decoded = []
    for view in (reduced(view, rung.step) for view in views):
        steps = (view.depth_mm + rung.depth // 2) // rung.depth
        size += len(zlib.compress(np.diff(steps.astype(np.int16), axis=1, prepend=np.int16(0)).tobytes(), 6))
        jpeg, colour = _jpeg(_filled(view.colour, steps > 0), rung.quality)
        size += jpeg
        decoded.append(replace(view, depth_mm=np.asarray(steps * rung.depth, np.uint16), colour=colour))
    return size, decoded


def draco(views: Sequence[View], rung: Rung) -> tuple[int, Callable[[], TriangleMesh]]:
    """Bytes of a Draco mesh, a vertex every ``step`` pixels, and of its texture; and the surface on the other end."""
    import DracoPy

    mesh = surface_of(views, rung.step, DRAWN_EDGE_M * max(1, rung.step / 6))
    scale = max(1, rung.step // 3)
    small = cv2.resize(mesh.texture, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
    jpeg, texture = _jpeg(np.asarray(small), rung.quality)
    coded = DracoPy.encode(
        mesh.vertices, mesh.faces, quantization_bits=rung.depth, compression_level=7,
        tex_coord=mesh.uv.astype(np.float64), tex_coord_quantization_bits=rung.depth,
    )  # fmt: skip

    def decoded() -> TriangleMesh:
        got = DracoPy.decode(coded)
        points, uv = (np.ascontiguousarray(array, np.float32) for array in (got.points, got.tex_coord))
        return TriangleMesh(points, np.ascontiguousarray(got.faces, np.int32), uv, texture)

    return len(coded) + jpeg, decoded


def _filled(colour: NDArray[np.uint8], seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The person's mean colour of the surroundings where the person is not: cheap to code, and nothing bleeds in."""
    small = (max(1, colour.shape[1] // 8), max(1, colour.shape[0] // 8))
    weight = cv2.blur(cv2.resize(seen.astype(np.float32), small, interpolation=cv2.INTER_AREA), (3, 3))
    masked = colour.astype(np.float32) * seen[..., None]
    total = cv2.blur(cv2.resize(masked, small, interpolation=cv2.INTER_AREA), (3, 3))
    mean = masked.sum(axis=(0, 1)) / max(int(seen.sum()), 1)
    around = np.where(weight[..., None] > 1e-3, total / np.maximum(weight, 1e-3)[..., None], mean)
    wide = cv2.resize(around.astype(np.float32), colour.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(seen[..., None], colour, np.clip(wide, 0, 255).astype(np.uint8))


def _jpeg(colour: NDArray[np.uint8], quality: int) -> tuple[int, NDArray[np.uint8]]:
    """Its bytes and what it decodes to; chroma at full resolution, as in our own candidates."""
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality]
    settings += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, coded = cv2.imencode(".jpg", cv2.cvtColor(colour, cv2.COLOR_RGB2BGR), settings)
    return len(coded), np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR_RGB), np.uint8)


Codec = Callable[[Sequence[View], Rung], tuple[int, Callable[[], TriangleMesh]]]


class FrameSizes:
    """How many bytes a captured frame takes on each rung, each coded once for all bandwidths."""

    def __init__(self, recorded: Capture, codec: Codec) -> None:
        self._recorded, self._codec = recorded, codec
        self._sizes: dict[tuple[int, Rung], int] = {}

    def __call__(self, k: int, rung: Rung) -> int:
        """Bytes of frame k."""
        key = self._recorded.index(k), rung
        if key not in self._sizes:
            self._sizes[key] = self._codec(self._recorded.frame(k).views, rung)[0]
        return self._sizes[key]


class PerFrame:
    """Sends one frame after the other; shows the newest that is there whole. It needs no skeleton."""

    def __init__(self, rate_bps: float, codec: Codec, ladder: Sequence[Rung], sizes: FrameSizes,
                 frames_per_s: float | None = None) -> None:  # fmt: skip
        self.link = ByteLink(rate_bps, FRAME_RATE_HZ, skeletons=False)
        self.screen: Screen | None = None
        self.switches = 0
        self._codec, self._ladder, self._sizes = codec, ladder, sizes
        aimed = next(fps for limit, fps in FRAMES_PER_S if rate_bps <= limit)
        self._frame_bytes = rate_bps / 8 / (frames_per_s or aimed)
        self._probed_k = -PROBED_EVERY
        self._rung = ladder[-1]
        self._sent_k = -1

    def frame(self, k: int, captured: CapturedFrame) -> None:
        """The newest frame goes out when the link is free."""
        self.link.start_frame()
        while True:
            if self.link.idle:
                if self._sent_k == k or not captured.views:
                    return
                self._choose(k)
                self._sent_k = k
                self.link.send((k, captured, self._rung), self._sizes(k, self._rung))
            message = self.link.arrived()
            if message is None:
                return
            assert isinstance(message, tuple)
            self.screen = Screen(message[0], partial(self._picture, *message[1:]))
            self.switches += 1

    def _choose(self, k: int) -> None:
        if k - self._probed_k >= PROBED_EVERY:
            self._probed_k = k
            fitting = (rung for rung in self._ladder if self._sizes(k, rung) <= self._frame_bytes)
            self._rung = next(fitting, self._ladder[-1])

    def _picture(self, captured: CapturedFrame, rung: Rung, cameras: list[Camera]) -> list[Picture]:
        return pictures_of(self._codec(captured.views, rung)[1](), cameras)
