"""The measures of every report, against cases whose answer is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from common.geometry.camera_model import project
from scripts.fidelity import (
    IMAGE_PIXELS,
    bounding_ball_radius,
    compare,
    constant_offsets,
    joint_errors_m,
    measuring_cameras,
)


def picture(grey: int, silhouette: slice) -> tuple[np.ndarray, np.ndarray]:
    colour = np.full((10, 10, 3), 255, np.uint8)
    depth = np.zeros((10, 10), np.float32)
    colour[:, silhouette] = grey
    depth[:, silhouette] = 2.0
    return colour, depth


def test_equal_pictures_are_perfect():
    result = compare([picture(10, slice(0, 5))] * 2, [picture(10, slice(0, 5))] * 2)
    assert (result.psnr_db, result.psnr_inside_db, result.iou) == (99.0, 99.0, 1.0)


def test_error_is_averaged_over_views_before_the_logarithm():
    truth = [picture(100, slice(0, 5))] * 2
    shown = [picture(100, slice(0, 5)), picture(110, slice(0, 5))]  # one view of two is off by 10, in half its pixels
    result = compare(truth, shown)
    assert result.psnr_db == pytest.approx(10 * np.log10(255**2 / 25))
    assert result.psnr_inside_db == pytest.approx(10 * np.log10(255**2 / 50))


def test_silhouettes_half_apart():
    result = compare([picture(0, slice(0, 4))], [picture(0, slice(2, 6))])
    assert result.iou == pytest.approx(2 / 6)
    assert result.psnr_inside_db == 99.0


def test_the_person_fills_four_fifths_of_the_height_in_all_six_views():
    rng = np.random.default_rng(0)
    surface = rng.uniform([-0.2, 0.0, -0.2], [0.2, 1.8, 0.2], (2000, 3))
    cameras = measuring_cameras(surface)
    assert len(cameras) == 6
    for camera in cameras:
        pixels, depth = project(camera, surface)
        assert (depth > 0).all()
        assert np.ptp(pixels[:, 1]) == pytest.approx(0.8 * IMAGE_PIXELS, rel=0.06)
    directions = np.array([camera.T_world_camera[:3, 2] for camera in cameras])
    assert np.arccos(np.clip(directions[0] @ directions[1], -1, 1)) == pytest.approx(np.pi / 3)


def test_constant_offsets_remove_exactly_what_is_constant_in_the_links_frame():
    rng = np.random.default_rng(1)
    rotations = Rotation.random(40 * 16, random_state=1).as_matrix().reshape(40, 16, 3, 3)
    truth = rng.normal(size=(40, 16, 3))
    offset = rng.normal(scale=0.03, size=(16, 3))
    estimated = truth - np.einsum("njab,jb->nja", rotations, offset)
    assert joint_errors_m(estimated, truth).mean() > 0.02
    np.testing.assert_allclose(joint_errors_m(constant_offsets(estimated, rotations, truth), truth), 0, atol=1e-12)


def test_an_error_fixed_in_the_world_does_not_pass_for_an_offset_of_the_link():
    rotations = Rotation.random(400 * 16, random_state=2).as_matrix().reshape(400, 16, 3, 3)
    truth = np.zeros((400, 16, 3))
    estimated = truth + np.array([0.03, 0, 0])
    assert joint_errors_m(constant_offsets(estimated, rotations, truth), truth).mean() > 0.025


def test_bounding_ball():
    assert bounding_ball_radius(np.array([[0, 0, 0], [0, 2.0, 0]])) == 1.0
