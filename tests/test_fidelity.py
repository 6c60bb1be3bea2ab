"""The measures of every report, against cases whose answer is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from common.geometry.camera_model import Camera, project
from common.geometry.rasterizer import render
from scripts.fidelity import (
    IMAGE_PIXELS,
    bounding_ball_radius,
    centres,
    compare,
    constant_offsets,
    finer,
    joint_errors_m,
    measuring_cameras,
    smooth,
    smooth_psnr_db,
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


def test_a_finer_camera_s_centres_are_what_the_camera_sees_and_its_means_are_smooth() -> None:
    """A slanted half-plane, black on white: single samples are black or white, means are what of a pixel is covered."""
    camera = Camera("c", 40, 30, 30.0, 30.0, 19.5, 14.5, np.eye(4))
    corners = np.array([[-9, -9, 2], [0.1, -9, 2], [-9, 9, 2], [0.9, 9, 2]], np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    surface = corners, faces, np.zeros((4, 3), np.uint8)
    colour, depth = render(*surface, camera)
    fine = render(*surface, finer(camera))
    np.testing.assert_array_equal(centres(fine)[0], colour)
    np.testing.assert_array_equal(centres(fine)[1] > 0, depth > 0)
    means = smooth(fine[0])
    edge = (means > 0) & (means < 255)
    assert edge.any()
    assert set(np.unique(colour)) == {0, 255}
    assert abs(means.astype(int) - colour).max() < 160  # at most half a pixel, and a sample more


def test_smooth_psnr_is_of_the_mean_square_over_all_views() -> None:
    black, grey = np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), 10, np.uint8)
    assert smooth_psnr_db([black, black], [grey, black]) == pytest.approx(10 * np.log10(255**2 / 50))
    assert smooth_psnr_db([grey], [grey]) == 99.0
