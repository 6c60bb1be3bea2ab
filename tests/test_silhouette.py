"""Silhouettes: a person before a noisy room, shadows, specks and holes, and a lens that bends straight lines."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from common.geometry.camera_model import Camera, project
from sender.capture.frame_set import ColourFrame
from sender.reconstruction.silhouette import (
    BACKGROUND,
    PERSON,
    Silhouette,
    SilhouetteModel,
    SilhouetteSettings,
    cleaned,
    pinhole_of,
)

W, H = 160, 120
CAMERA = Camera("cam", W, H, 130.0, 130.0, 79.5, 59.5, np.eye(4))
BENT = dataclasses.replace(CAMERA, distortion=np.array([-0.36, 0.17, 0.001, -0.001, -0.05]))
ROOM = np.clip(np.indices((H, W)).sum(0)[..., None] * 0.3 + (90, 120, 100), 0, 255)
BODY = (slice(20, 100), slice(60, 90))


def noisy(picture: np.ndarray, seed: int) -> np.ndarray:
    return np.clip(picture + np.random.default_rng(seed).normal(0, 3, picture.shape), 0, 255).astype(np.uint8)


def empty_room(frames: int = 20) -> np.ndarray:
    return np.stack([noisy(ROOM, seed) for seed in range(frames)])


def model(camera: Camera = CAMERA) -> SilhouetteModel:
    return SilhouetteModel(camera, empty_room())


def with_person(seed: int = 99) -> np.ndarray:
    picture = ROOM.copy()
    picture[BODY] = 40, 30, 160
    return noisy(picture, seed)


def body_mask() -> np.ndarray:
    mask = np.zeros((H, W), np.uint8)
    mask[BODY] = PERSON
    return mask


def test_a_person_before_a_noisy_room_is_cut_out():
    mask = model().silhouette(ColourFrame(0, 1, 0, with_person())).mask
    assert np.mean(mask != body_mask()) < 0.002
    assert (model().silhouette(ColourFrame(0, 1, 0, noisy(ROOM, 99))).mask == BACKGROUND).all()


def test_a_shadow_is_no_person():
    picture = ROOM.copy()
    picture[80:110, 20:60] *= 0.7
    assert (model().silhouette(ColourFrame(0, 1, 0, noisy(picture, 7))).mask == BACKGROUND).all()


def test_who_stands_still_does_not_become_part_of_the_room():
    watched = model()
    for seed in range(200):
        mask = watched.silhouette(ColourFrame(0, seed, 0, with_person(seed))).mask
    assert np.mean(mask != body_mask()) < 0.002


def test_specks_and_small_holes_go_and_large_holes_stay():
    mask = np.zeros((H, W), np.uint8)
    mask[20:100, 40:120] = PERSON
    mask[50:54, 60:64] = BACKGROUND  # a buckle
    mask[40:80, 80:110] = BACKGROUND  # between arm and body
    expected = mask.copy()
    expected[50:54, 60:64] = PERSON
    mask[5, 5:9] = mask[10:14, 140:144] = PERSON  # noise
    found = cleaned(mask, SilhouetteSettings())
    assert np.count_nonzero(found != expected) < 0.03 * np.count_nonzero(expected)
    assert (found[51:53, 61:63] == PERSON).all()
    assert (found[42:78, 82:108] == BACKGROUND).all()
    assert (found[:15] == BACKGROUND).all()
    assert (cleaned(np.zeros((H, W), np.uint8), SilhouetteSettings()) == BACKGROUND).all()


def test_a_source_of_silhouettes_needs_no_room():
    given = np.where(body_mask() > 0, 200, 90).astype(np.uint8)
    found = SilhouetteModel(CAMERA, None).silhouette(ColourFrame(0, 1, 0, None, given))
    np.testing.assert_array_equal(found.mask, body_mask())


def test_a_large_picture_is_worked_on_small_and_what_it_shows_stays_in_place():
    large = dataclasses.replace(CAMERA, width=4 * W, height=4 * H, fx=520.0, fy=520.0, cx=319.5, cy=239.5)
    mask = np.kron(body_mask(), np.ones((4, 4), np.uint8))
    settings = SilhouetteSettings(longest_px=W)
    found = SilhouetteModel(large, None, settings).silhouette(ColourFrame(0, 1, 0, None, mask))
    np.testing.assert_array_equal(found.mask, body_mask())
    point = np.array([[0.1, 0.2, 1.0]])
    small, _ = project(found.camera, point)
    np.testing.assert_allclose(small, (project(large, point)[0] + 0.5) / 4 - 0.5, atol=1e-6)


@pytest.mark.parametrize("camera", [BENT, dataclasses.replace(BENT, width=2 * W, height=2 * H, fx=260.0, fy=260.0)])
def test_distortion_is_taken_out_of_the_mask(camera: Camera):
    camera = dataclasses.replace(camera, cx=camera.width / 2 - 5, cy=camera.height / 2 + 3)
    centre = np.array([[0.25, -0.15, 1.0]])
    mask = np.zeros((camera.height, camera.width), np.uint8)
    u, v = np.rint(project(camera, centre)[0][0]).astype(int)
    cv2.circle(mask, (int(u), int(v)), 8, 255, -1)
    found = SilhouetteModel(camera, None).silhouette(ColourFrame(0, 1, 0, None, mask))
    assert not found.camera.distortion.any()
    rows, columns = np.nonzero(found.mask)
    straight, _ = project(found.camera, centre)
    np.testing.assert_allclose([columns.mean(), rows.mean()], straight[0], atol=0.7)


def test_the_pinhole_sees_nothing_that_the_lens_does_not_see():
    pinhole = pinhole_of(BENT, W)
    u, v = np.meshgrid([0.0, W / 2, W - 1.0], [0.0, H / 2, H - 1.0])
    rays = np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy, np.ones_like(u)], -1).reshape(-1, 3)
    pixels, _ = project(BENT, rays)
    assert (pixels > -1.5).all()
    assert (pixels < np.array([W, H]) + 0.5).all()


def test_wrong_input_is_refused():
    with pytest.raises(ValueError, match="cam: empty room"):
        SilhouetteModel(CAMERA, ROOM.astype(np.uint8))
    with pytest.raises(ValueError, match="cam: empty room"):
        SilhouetteModel(CAMERA, np.zeros((0, H, W, 3), np.uint8))
    with pytest.raises(ValueError, match="neither a silhouette nor"):
        SilhouetteModel(CAMERA, None).silhouette(ColourFrame(0, 1, 0, with_person()))
    with pytest.raises(ValueError, match="cam: frame"):
        model().silhouette(ColourFrame(0, 1, 0, with_person()[:-2]))
    with pytest.raises(ValueError, match="not a pinhole"):
        Silhouette(BENT, body_mask())
    with pytest.raises(ValueError, match="is not its image"):
        Silhouette(CAMERA, body_mask()[1:])


@pytest.mark.parametrize(
    ("colour", "silhouette"),
    [
        (None, None),
        (np.zeros((4, 5), np.uint8), None),
        (np.zeros((4, 5, 4), np.uint8), None),
        (np.zeros((4, 5, 3), np.float32), None),
        (np.zeros((4, 5, 3), np.uint8), np.zeros((5, 4), np.uint8)),
    ],
)
def test_a_frame_of_no_image_has_no_shape(colour: np.ndarray | None, silhouette: np.ndarray | None):
    with pytest.raises(ValueError, match="image"):
        _ = ColourFrame(0, 1, 0, colour, silhouette).shape
