"""The sensor's figures on planes, steps and slopes whose truth is known."""

import numpy as np
import pytest

from common.geometry.camera_model import pixel_rays
from common.geometry.rasterizer import Crop, render_crop
from sender.capture.rig_layout import HEIGHT_M, RADIUS_M, REACH_M, STEP_M, cameras_around, room_view
from sender.capture.sensor_model import DepthSensor, SensorSettings, averaged

FOCAL = 500.0


def wall(depth_m: float, shape: tuple[int, int] = (60, 80)) -> np.ndarray:
    return np.full(shape, depth_m, np.float32)


def readings(depth: np.ndarray, count: int = 40, seed: int = 3) -> np.ndarray:
    sensor = DepthSensor(depth, FOCAL, SensorSettings(), seed)
    return np.stack([sensor.background_reading() for _ in range(count)]).astype(float)


@pytest.mark.parametrize(("depth_m", "std_mm"), [(1.35, 2.3), (2.5, 8.0)])
def test_noise_is_that_of_real_recordings_and_unbiased(depth_m: float, std_mm: float) -> None:
    # over the whole wall and many depths, as the steps alias a single one
    measured = [readings(wall(depth_m + d), 4) - 1000 * (depth_m + d) for d in np.linspace(-0.02, 0.02, 9)]
    assert np.std(measured) == pytest.approx(std_mm, rel=0.1)
    assert abs(np.mean(measured)) < 0.1 * std_mm


def test_readings_are_steps_of_constant_disparity() -> None:
    values = np.unique(readings(wall(2.5)))
    steps = 1000 / values / SensorSettings().step_per_m
    assert len(values) > 1
    np.testing.assert_allclose(steps, np.rint(steps), atol=0.03)
    assert np.diff(values).max() == pytest.approx(18, abs=2)  # mm, at 2.5 m


def test_edges_lose_pixels_on_both_sides_and_nothing_else_does() -> None:
    depth = wall(3.0)
    depth[:, 40:] = 2.0
    missing = (readings(depth) == 0).mean(axis=(0, 1))
    s = SensorSettings()
    assert missing[39] == pytest.approx(s.lost_in_shadow, abs=0.05)  # the far side, shadowed
    assert missing[40] == pytest.approx(s.lost_at_edge, abs=0.05)
    assert missing[:39].max() == 0
    assert missing[41:].max() == 0


@pytest.mark.parametrize(("angle_rad", "lost"), [(0.8, 0.0), (1.35, 0.3), (1.5, 1.0)])
def test_grazing_surfaces_give_fewer_readings(angle_rad: float, lost: float) -> None:
    u = np.arange(80) - 40
    depth = (2.0 / (1 - np.tan(angle_rad) * u / FOCAL)) * np.ones((60, 1))
    middle = readings(depth.astype(np.float32))[:, 5:-5, 37:43]
    assert (middle == 0).mean() == pytest.approx(lost, abs=0.25 if 0 < lost < 1 else 0.01)


def test_nothing_is_read_beyond_the_range_and_where_nothing_is() -> None:
    assert (readings(wall(SensorSettings().max_range_m + 0.5), 1) == 0).all()
    assert (readings(wall(0.0), 1) == 0).all()


def test_person_is_in_front_of_the_background_only_where_nearer() -> None:
    depth = wall(3.0)
    person = wall(2.0, (20, 20))
    person[:, :5] = 0
    person[:, 15:] = 4.0  # behind the wall
    sensor = DepthSensor(depth, FOCAL, None, 0)
    frame = sensor.measure(Crop(30, 10, np.zeros((20, 20, 3), np.uint8), person))
    expected = np.full((60, 80), 3000)
    expected[10:30, 35:45] = 2000
    np.testing.assert_array_equal(frame, expected)
    noisy = DepthSensor(depth, FOCAL, SensorSettings(), 0).measure(
        Crop(30, 10, np.zeros((20, 20, 3), np.uint8), person)
    )
    inside = (slice(12, 28), slice(37, 43))
    assert np.abs(noisy[inside].astype(int) - 2000).max() < 60
    assert np.abs(noisy[40:].astype(int) - 3000).max() < 120


def test_person_is_measured_as_the_same_surface_in_the_background_is() -> None:
    wall_alone, person = wall(3.0), wall(2.0, (20, 20))
    both = wall_alone.copy()
    both[10:30, 30:50] = person
    settings = SensorSettings()
    crop = Crop(30, 10, np.zeros((20, 20, 3), np.uint8), person)
    sensor = DepthSensor(wall_alone, FOCAL, settings, 1)
    behind = DepthSensor(both, FOCAL, settings, 2)
    measured = np.stack([sensor.measure(crop) for _ in range(60)])
    expected = np.stack([behind.background_reading() for _ in range(60)])
    around = (slice(None), slice(8, 32), slice(28, 52))
    missing, also_missing = ((frames[around] == 0).mean(axis=0) for frames in (measured, expected))
    assert np.abs(missing - also_missing).max() < 0.4  # 60 frames, a pixel
    for ring in (9, 10, 11):  # the shadow beside the person, their edge, and inside
        assert measured[:, ring, 31:49].astype(bool).mean() == pytest.approx(
            expected[:, ring, 31:49].astype(bool).mean(), abs=0.06
        )
    inner = (slice(None), slice(12, 28), slice(32, 48))
    assert np.std(measured[inner].astype(float)) == pytest.approx(np.std(expected[inner].astype(float)), rel=0.1)
    assert np.mean(measured[inner]) == pytest.approx(np.mean(expected[inner]), abs=1)


def test_the_same_seed_gives_the_same_readings() -> None:
    np.testing.assert_array_equal(readings(wall(2.0), 3, seed=5), readings(wall(2.0), 3, seed=5))
    assert (readings(wall(2.0), 3, seed=5) != readings(wall(2.0), 3, seed=6)).any()


def test_average_of_the_empty_room_is_better_than_a_reading_and_keeps_holes() -> None:
    depth = wall(2.5)
    depth[:, :10] = 0
    frames = readings(depth, 40).astype(np.uint16)
    mean = averaged(list(frames))
    assert (mean[:, :10] == 0).all()
    assert np.std(mean[:, 12:].astype(float)) < 0.4 * np.std(frames[0][:, 12:].astype(float))


def test_every_camera_sees_feet_ahead_and_raised_hands() -> None:
    for camera in cameras_around(4):
        eye, ahead = camera.T_world_camera[:3, 3], camera.T_world_camera[:3, 2]
        assert np.hypot(eye[0], eye[2]) == pytest.approx(RADIUS_M)
        towards = np.array([eye[0], 0, eye[2]]) / RADIUS_M
        for point in (STEP_M * towards, np.array([0, REACH_M, 0])):
            slope = np.linalg.inv(camera.T_world_camera) @ np.append(point, 1)
            assert abs(slope[1] / slope[2]) * camera.fy < camera.height / 2
        assert ahead[1] < 0
        assert eye[1] == HEIGHT_M
    front = cameras_around(4)[0].T_world_camera[:3, 3]
    assert front[2] == pytest.approx(RADIUS_M)


def test_room_is_where_its_depth_says() -> None:
    camera = cameras_around(4, 160, 120)[1]
    colour, depth = room_view(camera)
    points = depth[..., None] * pixel_rays(camera) @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    on_floor = np.abs(points[..., 1]) < 1e-4
    assert on_floor[-20:].all()
    assert (np.abs(points) < 3.5001).all()
    assert colour[on_floor].std() > 5  # the tiles
    # a mesh of a floor tile seen by the renderer lies on the ray-cast floor
    quad = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], np.float32)
    crop = render_crop(quad, np.array([[0, 2, 1], [0, 3, 2]], np.int32), np.zeros((4, 3), np.uint8), camera)
    assert crop is not None
    h, w = crop.depth.shape
    part = depth[crop.v0 : crop.v0 + h, crop.u0 : crop.u0 + w]
    hit = crop.depth > 0
    assert hit.sum() > 100
    np.testing.assert_allclose(crop.depth[hit], part[hit], atol=1e-3)
