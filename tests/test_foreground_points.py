"""World points from views: where they lie, how they face, how many there are."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from common.body.view import View
from common.geometry.camera_model import Camera, pixel_rays, project
from common.geometry.rasterizer import render
from common.geometry.rigid_transform import look_at
from sender.reconstruction.foreground_points import PointSampler

CENTRE, RADIUS_M = np.array([0.1, 1.0, -0.05]), 0.35


def _camera(name: str, around_rad: float, distortion: NDArray[np.float64] | None = None) -> Camera:
    eye = np.array([2.5 * np.sin(around_rad), 1.4, 2.5 * np.cos(around_rad)])
    pose = look_at(eye, CENTRE).astype(np.float64)
    return Camera(name, 640, 480, 525.0, 525.0, 331.0, 236.0, pose, np.zeros(5) if distortion is None else distortion)


CAMERAS = [_camera(f"cam{i + 1}", i * np.pi / 2) for i in range(4)]


def _sphere() -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8]]:
    """Vertices, faces, and colours: red where x > centre, green elsewhere."""
    rows, columns = 60, 120
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns), indexing="ij")
    unit = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1).reshape(-1, 3)
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)]).astype(np.int32)
    colours = np.where(unit[:, :1] > 0, [[220, 0, 0]], [[0, 220, 0]]).astype(np.uint8)
    return (CENTRE + RADIUS_M * unit).astype(np.float32), faces, colours


def _view(camera: Camera, depth_m: NDArray[np.float32], colour: NDArray[np.uint8]) -> View:
    rows, columns = np.nonzero(depth_m)
    crop = slice(rows.min() - 2, rows.max() + 3), slice(columns.min() - 2, columns.max() + 3)
    depth_mm = np.ascontiguousarray(np.rint(depth_m * 1000).astype(np.uint16)[crop])
    return View(camera, crop[1].start, crop[0].start, depth_mm, np.ascontiguousarray(colour[crop]))


@pytest.fixture(scope="module")
def sphere_views() -> list[View]:
    vertices, faces, colours = _sphere()
    images = [render(vertices, faces, colours, camera) for camera in CAMERAS]
    return [_view(camera, depth, colour) for camera, (colour, depth) in zip(CAMERAS, images, strict=True)]


def test_points_lie_on_the_surface_with_outward_normals_and_its_colours(sphere_views: list[View]) -> None:
    cloud = PointSampler(CAMERAS).points(sphere_views)
    outward = (cloud.positions - CENTRE) / np.linalg.norm(cloud.positions - CENTRE, axis=1, keepdims=True)
    distance = np.linalg.norm(cloud.positions - CENTRE, axis=1) - RADIUS_M
    assert np.abs(distance).max() < 0.004
    assert np.rad2deg(np.arccos(np.clip((cloud.normals * outward).sum(1), -1, 1))).max() < 15
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    right = cloud.positions[:, 0] > CENTRE[0] + 0.03
    assert (cloud.colours[right, 0] > 200).all()
    assert cloud.positions.dtype == cloud.normals.dtype == np.float32
    assert cloud.colours.dtype == np.uint8


@pytest.mark.parametrize("budget", [50, 700, 2500])
def test_budget_is_kept_and_used(sphere_views: list[View], budget: int) -> None:
    cloud = PointSampler(CAMERAS, budget).points(sphere_views)
    assert 0.9 * min(budget, 1500) <= len(cloud) <= budget
    assert len(np.unique(np.sign(cloud.positions - CENTRE.astype(np.float32)), axis=0)) == 8  # all around, not a part


def test_what_two_cameras_see_is_not_counted_twice(sphere_views: list[View]) -> None:
    cloud = PointSampler(CAMERAS).points([sphere_views[0], sphere_views[1]])
    both = (cloud.normals @ [0.7071, 0.0, 0.7071]) > 0.95  # between cam1 and cam2
    front = (cloud.normals @ [0.0, 0.0, 1.0]) > 0.95
    assert both.sum() < 1.4 * front.sum()


def test_any_subset_of_views_in_any_order_and_none(sphere_views: list[View]) -> None:
    sampler = PointSampler(CAMERAS)
    behind = sampler.points([sphere_views[2]])
    assert (behind.positions[:, 2] < CENTRE[2] + 0.01).all()
    forth, back = sampler.points(sphere_views[:2]), sampler.points(sphere_views[1::-1])
    assert np.median(cKDTree(forth.positions).query(back.positions)[0]) < 0.01
    assert len(sampler.points([])) == 0
    with pytest.raises(KeyError):
        sampler.points([View(_camera("other", 0.0), 0, 0, sphere_views[0].depth_mm, sphere_views[0].colour)])


def test_distortion_is_honoured() -> None:
    camera = _camera("cam1", 0.3, np.array([-0.25, 0.08, 0.001, -0.002, 0.0]))
    depth_mm = np.full((480, 640), 2000, np.uint16)
    view = View(camera, 0, 0, depth_mm, np.zeros((480, 640, 3), np.uint8))
    cloud = PointSampler([camera], 4000, voxel_m=0.001).points([view])
    pixels, z = project(camera, cloud.positions)
    np.testing.assert_allclose(z, 2.0, atol=1e-3)
    np.testing.assert_allclose(pixels, np.rint(pixels), atol=0.04)  # back on the pixels they came from
    T = camera.T_world_camera
    expected = 2.0 * pixel_rays(camera)[240, 600] @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    assert cKDTree(cloud.positions).query(expected)[0] < 0.05


def test_no_points_at_depth_edges() -> None:
    camera = Camera("cam1", 320, 240, 260.0, 260.0, 160.0, 120.0, np.eye(4))
    depth_mm = np.full((240, 320), 2000, np.uint16)
    depth_mm[:, 160:] = 2300
    sampler = PointSampler([camera], 20000, voxel_m=0.001)
    cloud = sampler.points([View(camera, 0, 0, depth_mm, np.zeros((240, 320, 3), np.uint8))])
    pixels, z = project(camera, cloud.positions)
    assert ((np.abs(z - 2.0) < 1e-3) | (np.abs(z - 2.3) < 1e-3)).all()
    assert np.abs(pixels[:, 0] - 159.5).min() > 1.4
    np.testing.assert_allclose(cloud.normals, np.tile([0, 0, -1.0], (len(cloud), 1)), atol=1e-3)


def test_front_and_back_of_a_thin_hand_stay_two_points() -> None:
    front = Camera("front", 320, 240, 260.0, 260.0, 160.0, 120.0, look_at(np.array([0, 0, 2.011]), np.zeros(3)))
    back = Camera("back", 320, 240, 260.0, 260.0, 160.0, 120.0, look_at(np.array([0, 0, -1.989]), np.zeros(3)))
    depth_mm = np.full((100, 100), 1994, np.uint16)  # 12 mm thick, inside one layer of voxels
    views = [View(camera, 110, 70, depth_mm, np.zeros((100, 100, 3), np.uint8)) for camera in (front, back)]
    cloud = PointSampler([front, back]).points(views)
    facing = cloud.normals[:, 2]
    assert (np.abs(facing) > 0.99).all()
    np.testing.assert_allclose(cloud.positions[facing > 0, 2], 0.017, atol=1e-3)
    np.testing.assert_allclose(cloud.positions[facing < 0, 2], 0.005, atol=1e-3)


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="budget"):
        PointSampler(CAMERAS, 0)
    with pytest.raises(ValueError, match="different names"):
        PointSampler([CAMERAS[0], CAMERAS[0]])
