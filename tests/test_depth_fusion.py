"""Depth averaged over frames of a moving body: less noise, the same surface."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.depth_mesher import SMOOTHING_RADIUS_PIXELS, SMOOTHING_RANGE_MM, smooth_depth
from common.body.mannequin import mannequin, mannequin_camera, mannequin_depth
from common.body.skeleton_pose import forward_kinematics
from common.body.view import View
from sender.reconstruction.depth_fusion import DepthFusion, PosedViews

NOISE_MM = 6.0
STEP_MM = 45


def clean_depth() -> NDArray[np.uint16]:
    return mannequin_depth(mannequin_camera())


def noisy_frame(seed: int, shift_m: float = 0.0, posed_shift_m: float | None = None) -> PosedViews:
    """A mannequin moved towards the camera by ``shift_m``, as its skeleton says or as ``posed_shift_m`` says; the
    higher the seed, the longer ago."""
    skeleton, pose = mannequin()
    camera = mannequin_camera()
    forward = camera.T_world_camera[:3, 2]
    depth = clean_depth()
    noise = np.random.default_rng(seed).normal(0, NOISE_MM, depth.shape)
    moved = np.where(depth > 0, np.rint(depth - 1e3 * shift_m + noise), 0).astype(np.uint16)
    said_m = shift_m if posed_shift_m is None else posed_shift_m
    root = (pose.root_position - said_m * forward).astype(np.float32)
    view = View(camera, 0, 0, moved, np.full((*depth.shape, 3), 128, np.uint8))
    return PosedViews(-seed, (view,), forward_kinematics(skeleton, replace(pose, root_position=root)))


def inside() -> NDArray[np.bool_]:
    """Pixels well inside the silhouette."""
    return np.asarray(cv2.erode((clean_depth() > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0)


def fused(frame: PosedViews, others: list[PosedViews], most: int = 4) -> NDArray[np.uint16]:
    fusion = DepthFusion(most)
    for other in [*others, frame]:
        fusion.remember(other)
    return fusion.fused(frame, mannequin()[0])[0].depth_mm


def noise_mm(one: NDArray[np.uint16], another: NDArray[np.uint16]) -> float:
    """Standard deviation inside between two pictures of one surface, as the mesher smooths them."""
    a, b = (smooth_depth(depth, SMOOTHING_RADIUS_PIXELS, SMOOTHING_RANGE_MM) for depth in (one, another))
    return float((a - b)[inside()].std() / np.sqrt(2))


def test_noise_falls_over_frames_of_a_body_that_comes_nearer():
    now = [noisy_frame(seed) for seed in (0, 10)]
    others = [[noisy_frame(first + step, 0.01 * step) for step in range(1, 5)] for first in (0, 10)]
    with_one, with_four = (
        noise_mm(*(fused(frame, before[:most], most) for frame, before in zip(now, others, strict=True)))
        for most in (1, 4)
    )
    assert with_four < 0.8 * with_one  # √(2/5) were every reading averaged


def test_skeletons_that_are_off_are_registered():
    """The surface was 1 cm nearer than its skeleton says: unregistered, the mean would come 8 mm nearer, too."""
    now = noisy_frame(0)
    others = [noisy_frame(seed, 0.01, posed_shift_m=0.0) for seed in range(1, 5)]
    error = fused(now, others).astype(np.float64) - clean_depth()
    assert abs(error[inside()].mean()) < 2.0


def test_a_hole_that_only_one_frame_has_is_filled():
    now = noisy_frame(0)
    depth = now.views[0].depth_mm.copy()
    row, column = np.argwhere(inside())[len(np.argwhere(inside())) // 2]
    depth[row, column] = 0
    holed = replace(now, views=(replace(now.views[0], depth_mm=depth),))
    filled = fused(holed, [noisy_frame(seed) for seed in range(1, 5)])
    assert abs(int(filled[row, column]) - int(clean_depth()[row, column])) < 4 * NOISE_MM


def test_what_all_frames_lack_stays_away():
    now = noisy_frame(0)
    seen, true = fused(now, [noisy_frame(seed) for seed in range(1, 5)]) > 0, clean_depth() > 0
    assert not np.any(true & ~seen)  # nothing is lost, and what is added is a pixel wide and rare
    assert not np.any(seen & (cv2.dilate(true.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0))
    assert np.count_nonzero(seen & ~true) < 0.01 * np.count_nonzero(true)


def test_a_step_in_depth_does_not_grow():
    """What spans a step counts as surface up to 6 cm: one of 4.5 cm must not become a bridge by being sharpened."""
    true = clean_depth()
    half = true.shape[1] // 2
    true[:, half:][true[:, half:] > 0] += STEP_MM
    view = noisy_frame(0).views[0]

    def stepped(seed: int) -> PosedViews:
        return replace(noisy_frame(seed), views=(replace(view, depth_mm=true),))

    depth = fused(stepped(0), [stepped(seed) for seed in range(1, 5)]).astype(int)
    about = slice(half - 5, half + 5)
    rows = inside()[:, about].all(axis=1)
    assert rows.sum() > 10
    grown_mm = np.ptp(depth[rows, about], axis=1) - np.ptp(true[rows, about].astype(int), axis=1)
    assert grown_mm.mean() < 0.2 * STEP_MM  # unlimited twicing: 0.33


def test_a_limb_keeps_its_roundness():
    """The mesher's means flatten it: of depth that was fused they make the true surface again."""
    camera = mannequin_camera()
    columns = np.arange(camera.width) - camera.width / 2
    radius_px = 12
    height = np.sqrt(np.maximum(radius_px**2 - columns**2, 0)) * 5000 / camera.fx
    row = np.where(np.abs(columns) < radius_px - 1, np.rint(5000 - height), 0)
    depth = np.tile(row, (camera.height, 1)).astype(np.uint16)
    now = noisy_frame(0)
    frames = [replace(noisy_frame(s), views=(replace(now.views[0], depth_mm=depth),)) for s in range(5)]
    within = np.abs(columns) < radius_px - 3
    errors = [
        np.abs(smooth_depth(d, SMOOTHING_RADIUS_PIXELS, SMOOTHING_RANGE_MM)[40:-40, within] - (5000 - height)[within])
        for d in (depth, fused(frames[0], frames[1:]))
    ]
    assert errors[1].mean() < 0.8 * errors[0].mean()


def test_frames_that_came_later_are_not_used():
    now, later = noisy_frame(4), [noisy_frame(seed) for seed in range(4)]
    assert np.array_equal(fused(now, later), now.views[0].depth_mm)
    before = [noisy_frame(seed) for seed in range(5, 9)]
    fusion = DepthFusion(8)
    for frame in [*later, *before]:
        fusion.remember(frame)
    assert np.array_equal(fusion.fused(now, mannequin()[0])[0].depth_mm, fused(now, before, most=8))


def test_a_frame_alone_is_unchanged():
    now = noisy_frame(0)
    assert np.array_equal(fused(now, []), now.views[0].depth_mm)
    assert np.array_equal(fused(now, [noisy_frame(1)], most=0), now.views[0].depth_mm)


def test_no_more_frames_than_asked_for_are_held():
    fusion = DepthFusion(2)
    for seed in range(10):
        fusion.remember(noisy_frame(seed))
    assert len(fusion._frames) == 3
