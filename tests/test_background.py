"""The background model: who is cut out, what is left alone, and what it learns."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from sender.capture.frame_set import DepthFrame
from sender.reconstruction.background import UPDATE_STRIPES, BackgroundModel, BackgroundSettings, shaded
from sender.reconstruction.outline import REACH

UTD_MHAD = Path(__file__).parents[1] / "../shared/data/rgbd/utd_mhad/Depth"
W, H = 160, 120
CAMERA = Camera("cam1", W, H, 130.0, 130.0, 80.0, 60.0, np.eye(4))
ROOM_MM = 3000
BOX = (slice(30, 91), slice(51, 98))  # rows, columns; odd sizes, so that the half-resolution mask does not fit


def _frame(depth: NDArray[np.uint16], colour: NDArray[np.uint8] | None = None) -> DepthFrame:
    return DepthFrame(0, 0, 0, depth, colour)


def _room(depth_mm: int = ROOM_MM) -> NDArray[np.uint16]:
    return np.full((H, W), depth_mm, np.uint16)


def _with_person(depth_mm: int = 2000, room_mm: int = ROOM_MM) -> NDArray[np.uint16]:
    depth = _room(room_mm)
    depth[BOX] = depth_mm
    return depth


def _whole(model: BackgroundModel, depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """The foreground put back into a full image."""
    whole = np.zeros((H, W), np.uint16)
    view = model.foreground(_frame(depth))
    if view is not None:
        h, w = view.depth_mm.shape
        whole[view.v0 : view.v0 + h, view.u0 : view.u0 + w] = view.depth_mm
    return whole


def _noise(rng: np.random.Generator, depth: NDArray[np.uint16], sigma_mm: float) -> NDArray[np.uint16]:
    return np.where(depth > 0, np.rint(depth + rng.normal(0, sigma_mm, depth.shape)), 0).astype(np.uint16)


def test_person_in_front_is_cut_out_to_the_pixel() -> None:
    expected = np.zeros((H, W), np.uint16)
    expected[BOX] = 2000
    np.testing.assert_array_equal(_whole(BackgroundModel(CAMERA, _room()), _with_person()), expected)


def test_view_is_the_bounding_box_with_its_colour() -> None:
    colour = np.random.default_rng(0).integers(0, 255, (H, W, 3), np.uint8)
    view = BackgroundModel(CAMERA, _room()).foreground(_frame(_with_person(), colour))
    assert view is not None
    assert view.u0 <= 51 - 2
    assert view.v0 <= 30 - 2
    assert view.depth_mm.shape[0] <= 61 + 2 * (REACH + 1) + 4
    assert view.depth_mm.shape[1] <= 47 + 2 * (REACH + 1) + 4
    h, w = view.depth_mm.shape
    np.testing.assert_array_equal(view.colour, colour[view.v0 : view.v0 + h, view.u0 : view.u0 + w])
    assert view.depth_mm.flags.c_contiguous
    assert view.colour.flags.c_contiguous


@pytest.mark.parametrize("depth", [_room(), _with_person(3300), np.zeros((H, W), np.uint16)])
def test_nobody_in_view_is_none(depth: NDArray[np.uint16]) -> None:
    """The room itself, something behind the wall it knows, no reading at all."""
    assert BackgroundModel(CAMERA, _room()).foreground(_frame(depth)) is None


def test_noise_of_the_room_is_not_a_person_but_one_a_little_in_front_is() -> None:
    rng = np.random.default_rng(1)
    model = BackgroundModel(CAMERA, _noise(rng, _room(), 14))
    for _ in range(3 * UPDATE_STRIPES):
        model.foreground(_frame(_noise(rng, _room(), 14)))
    assert model.foreground(_frame(_noise(rng, _room(), 14))) is None
    person = _whole(model, _noise(rng, _with_person(2850), 14))
    assert (person[BOX] > 0).mean() > 0.98


def test_background_that_moves_is_learned_and_a_person_who_stands_still_is_not() -> None:
    model = BackgroundModel(CAMERA, _room())
    nearer = ROOM_MM - 40  # within k σ: a drifting sensor
    for _ in range(200 * UPDATE_STRIPES):
        model.foreground(_frame(_with_person(room_mm=nearer)))
    person = _whole(model, _with_person(room_mm=nearer - 40))  # 80 mm from where it began: would be foreground
    assert (person[BOX] > 0).all()
    person[BOX] = 0
    assert not person.any()


def test_holes_in_the_empty_room_do_not_become_foreground() -> None:
    empty = _room()
    empty[20:25, 20:140] = 0  # too many pixels for a speckle
    assert BackgroundModel(CAMERA, empty).foreground(_frame(_room())) is None


def test_without_an_empty_room_every_reading_in_range_is_the_person() -> None:
    depth = np.zeros((H, W), np.uint16)
    depth[BOX] = 2000
    depth[0:30, 0:30], depth[90:, 120:] = 6500, 200  # beyond far, before near
    model = BackgroundModel(CAMERA, None, BackgroundSettings(near_m=0.3, far_m=6.0))
    expected = np.where(depth == 2000, depth, 0)
    for _ in range(3):
        np.testing.assert_array_equal(_whole(model, depth), expected)


def test_speckles_and_flying_pixels_go_and_thin_limbs_stay() -> None:
    depth = _with_person()
    depth[10:14, 10:14] = 2000  # an island
    depth[40:60, 98:130] = 2000  # an arm
    depth[45:48, 130:150] = 2000  # three pixels thin
    depth[60, 70] = 2600  # between the person and the wall
    whole = _whole(BackgroundModel(CAMERA, _room()), depth)
    assert not whole[10:14, 10:14].any()
    assert whole[60, 70] == 0
    assert (whole[45:48, 98:149] == 2000).all()


def test_smoothing_lowers_noise_and_keeps_slopes_and_steps() -> None:
    rng = np.random.default_rng(2)
    columns = np.arange(W)
    slope = np.broadcast_to(np.where(columns < 80, 1500 + 8 * columns, 2500 + 8 * columns), (H, W)).astype(np.uint16)
    far_away = np.full((H, W), 5900, np.uint16)
    smooth = _whole(BackgroundModel(CAMERA, far_away), slope).astype(float)
    seen = smooth[2:-2, 2:-2] > 0
    np.testing.assert_allclose(smooth[2:-2, 2:-2][seen], slope[2:-2, 2:-2][seen], atol=1)  # noise-free: unchanged
    noisy = _whole(BackgroundModel(CAMERA, far_away), _noise(rng, slope, 8)).astype(float)
    raw = _whole(BackgroundModel(CAMERA, far_away, BackgroundSettings(smooth=False)), _noise(rng, slope, 8)).astype(
        float
    )

    def spread(image: NDArray[np.float64]) -> float:
        inner = image[5:-5, 5:70]
        return float((inner - slope[5:-5, 5:70])[inner > 0].std())

    assert spread(noisy) < 0.5 * spread(raw)


def test_a_camera_without_colour_gets_shaded_depth() -> None:
    view = BackgroundModel(CAMERA, _room()).foreground(_frame(_with_person()))
    assert view is not None
    flat = view.colour[view.depth_mm > 0]
    assert (flat[:, 0] == flat[:, 1]).all()
    steep = shaded(CAMERA, (2000 + 60 * np.arange(40, dtype=np.uint16))[None].repeat(9, 0))
    assert steep[4, 20, 0] < flat.max() - 40


def test_wrong_sizes_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="cam1: empty room"):
        BackgroundModel(CAMERA, np.zeros((10, 10), np.uint16))
    with pytest.raises(ValueError, match="cam1: frame"):
        BackgroundModel(CAMERA, None).foreground(_frame(np.zeros((10, 10), np.uint16)))


@pytest.mark.skipif(not UTD_MHAD.exists(), reason="recordings not there (../shared/data/rgbd/utd_mhad)")
def test_real_recording_keeps_the_whole_silhouette() -> None:
    depth = scipy.io.loadmat(UTD_MHAD / "a1_s1_t1_depth.mat")["d_depth"][:, :, 0].astype(np.uint16)
    camera = Camera("kinect", 320, 240, 285.63, 285.63, 160.0, 120.0, np.eye(4))
    view = BackgroundModel(camera, None).foreground(_frame(np.ascontiguousarray(depth)))
    assert view is not None
    outline = cv2.morphologyEx((depth > 0).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    assert (view.depth_mm > 0).sum() > 0.95 * outline.sum()
