"""What the fidelity bench's rivals show is what they were given, coded, late, and within the link's bytes."""

from __future__ import annotations

import importlib.util
from functools import cache

import numpy as np
import pytest

from scripts.bench_fidelity import measured
from scripts.fidelity import compare, measuring_cameras
from scripts.fidelity_capture import FRAME_RATE_HZ, Capture, capture
from scripts.fidelity_frames import DRACO_LADDER, YANG_LADDER, Codec, Rung, draco, yang
from scripts.fidelity_live import DisposeLive
from scripts.fidelity_methods import LastMesh
from scripts.fidelity_rivals import open_method
from scripts.fidelity_surface import pictures_of, reduced, surface_of

needs_av = pytest.mark.skipif(importlib.util.find_spec("av") is None, reason="PyAV (extra bench) is not installed")
needs_draco = pytest.mark.skipif(
    importlib.util.find_spec("DracoPy") is None, reason="DracoPy (extra bench) is not installed"
)


@cache
def recorded() -> Capture:
    """The first 34 frames of the built-in performer: it starts in its A-pose."""
    return capture("builtin", None, None, 4, 34 / FRAME_RATE_HZ + 0.001)


def fidelity_of(codec: Codec, rung: Rung) -> tuple[int, float, float]:
    """Bytes, PSNR and overlap of silhouettes of one coded frame."""
    frame = recorded().frame(20)
    size, decoded = codec(frame.views, rung)
    cameras = measuring_cameras(recorded().performer.surface(frame.time_s))
    result = compare(recorded().truth(20), pictures_of(decoded(), cameras))
    return size, result.psnr_db, result.iou


def test_yang_finest_rung_is_as_good_as_the_views_and_coarser_ones_smaller() -> None:
    frame = recorded().frame(20)
    cameras = measuring_cameras(recorded().performer.surface(frame.time_s))
    uncoded = compare(recorded().truth(20), pictures_of(surface_of(frame.views, 2), cameras))
    figures = [fidelity_of(yang, rung) for rung in YANG_LADDER]
    assert figures[0][1] > uncoded.psnr_db - 0.3
    assert figures[-1][2] > 0.85  # a coarse person is still where the person is
    assert [size for size, _, _ in figures] == sorted((size for size, _, _ in figures), reverse=True)


@needs_draco
def test_draco_mesh_comes_back_where_it_was() -> None:
    size, psnr_db, iou = fidelity_of(draco, DRACO_LADDER[0])
    assert psnr_db > 20
    assert iou > 0.93
    assert fidelity_of(draco, DRACO_LADDER[-1])[0] < size / 8


def test_reduced_view_sees_the_same_surface() -> None:
    view = recorded().frame(20).views[0]
    full, small = (surface_of([v], 1, np.inf).vertices for v in (view, reduced(view, 3)))
    nearest = [np.linalg.norm(full - point, axis=1).min() for point in small[::50]]
    assert np.median(nearest) < 0.006


def test_per_frame_is_late_by_its_bytes_and_the_seen_picture_pays_for_it() -> None:
    slow, fast = (open_method("per-frame-yang", recorded(), rate_bps, False) for rate_bps in (0.4e6, 40e6))
    shown = []
    for k in range(FRAME_RATE_HZ):
        for method in (slow, fast):
            method.frame(k, recorded().frame(k))
        shown.append((slow.screen and slow.screen.shown_k, fast.screen and fast.screen.shown_k))
    assert shown[-1][1] == FRAME_RATE_HZ - 1
    late = shown[-1][0]
    assert late is not None
    assert late < FRAME_RATE_HZ - 2
    assert slow.link.sent_bytes <= 0.4e6 / 8 * (1 + 1 / FRAME_RATE_HZ)


@needs_av
def test_video_decodes_to_the_person_and_keeps_its_rate() -> None:
    few = Capture(recorded().performer, [recorded().frame(k) for k in range(8)])
    video, warped = (open_method(name, few, 4e6, False) for name in ("h265", "h265-warp"))
    for k in range(8):
        video.frame(k, few.frame(k))
        warped.frame(k, few.frame(k))
    assert video.screen is not None
    assert warped.screen is not None
    assert warped.screen.shown_k == 7  # never late: the skeleton is not
    assert video.screen.shown_k <= 7
    assert video.link.sent_bytes <= 4e6 / 8 * 9 / FRAME_RATE_HZ
    cameras = measuring_cameras(few.performer.surface(few.frame(video.screen.shown_k).time_s))
    result = compare(few.truth(video.screen.shown_k), video.screen.picture(cameras))
    assert result.psnr_db > 20
    assert result.iou > 0.9


def test_seen_picture_of_a_method_that_is_never_late_is_the_shown_one() -> None:
    figures = measured(LastMesh(40e6, False), recorded(), 1.1)
    assert figures["psnr_seen_db"] == figures["psnr_db"]
    assert figures["first_body_s"][0] == 0


def test_live_surface_shares_the_link_with_candidate_poses() -> None:
    live, frames = DisposeLive(3e6, own=False), 20
    for k in range(frames):
        live.frame(k, recorded().frame(k))
    assert live.screen is not None
    assert 0 < live.link.sent_bytes <= 3e6 / 8 * (frames + 2) / FRAME_RATE_HZ
    cameras = measuring_cameras(recorded().performer.surface(recorded().frame(frames - 1).time_s))
    seen = compare(recorded().truth(frames - 1), live.screen.picture(cameras))
    assert seen.psnr_db > 19
    assert seen.iou > 0.9


def test_a_thin_link_is_left_to_the_candidate_poses() -> None:
    thin, poses = DisposeLive(0.2e6, own=False), open_method("dispose", recorded(), 0.2e6, own=False)
    for k in range(8):
        thin.frame(k, recorded().frame(k))
        poses.frame(k, recorded().frame(k))
    assert thin.link.sent_bytes == poses.link.sent_bytes
