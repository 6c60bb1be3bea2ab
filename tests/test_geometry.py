"""Transforms, quaternions and cameras, each against an independent route (SciPy, OpenCV, closed forms)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common.geometry import quaternion
from common.geometry.camera_model import Camera, pixel_rays, project
from common.geometry.rigid_transform import inverse, look_at, rigid_transform, transform_points

seeds = st.integers(0, 2**32 - 1)


def random_quaternions(seed: int, count: int) -> np.ndarray:
    return quaternion.normalized(np.random.default_rng(seed).normal(size=(count, 4)))


def scipy_rotation(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(q, -1, axis=-1))


@given(seeds)
def test_matrix_and_product_agree_with_scipy(seed):
    a, b = random_quaternions(seed, 8), random_quaternions(seed + 1, 8)
    np.testing.assert_allclose(quaternion.to_matrix(a), scipy_rotation(a).as_matrix(), atol=1e-12)
    product = scipy_rotation(a) * scipy_rotation(b)
    np.testing.assert_allclose(quaternion.to_matrix(quaternion.multiply(a, b)), product.as_matrix(), atol=1e-12)


@given(seeds)
def test_from_matrix_inverts_to_matrix(seed):
    q = random_quaternions(seed, 16)
    back = quaternion.from_matrix(quaternion.to_matrix(q))
    assert (back[:, 0] >= 0).all()
    np.testing.assert_allclose(np.abs(np.sum(back * q, -1)), 1.0, atol=1e-9)


def test_from_matrix_handles_half_turns():
    for axis in np.eye(3):
        R = Rotation.from_rotvec(np.pi * axis).as_matrix()
        np.testing.assert_allclose(quaternion.to_matrix(quaternion.from_matrix(R)), R, atol=1e-9)


@given(seeds, st.floats(0, 3.1))
def test_rotation_vector_round_trip(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    v = axis / np.linalg.norm(axis) * angle
    q = quaternion.from_rotation_vector(v)
    np.testing.assert_allclose(quaternion.to_rotation_vector(q), v, atol=1e-9)
    np.testing.assert_allclose(quaternion.to_matrix(q), Rotation.from_rotvec(v).as_matrix(), atol=1e-12)


def test_slerp_ends_middle_and_extrapolation():
    a, b = random_quaternions(3, 2)
    assert quaternion.angle_between(quaternion.slerp(a, b, 0.0), a) < 1e-9
    assert quaternion.angle_between(quaternion.slerp(a, b, 1.0), b) < 1e-9
    full = quaternion.angle_between(a, b)
    assert quaternion.angle_between(quaternion.slerp(a, b, 0.5), a) == pytest.approx(full / 2, abs=1e-9)
    small = quaternion.from_rotation_vector(np.array([0.1, 0, 0]))
    ahead = quaternion.slerp(quaternion.IDENTITY, small, 2.0)
    np.testing.assert_allclose(quaternion.to_rotation_vector(ahead), [0.2, 0, 0], atol=1e-12)


@given(seeds)
def test_shortest_arc_turns_a_onto_b(seed):
    a, b = np.random.default_rng(seed).normal(size=(2, 5, 3))
    turned = (quaternion.to_matrix(quaternion.shortest_arc(a, b)) @ a[..., None])[..., 0]
    np.testing.assert_allclose(np.cross(turned, b), 0, atol=1e-7)
    assert (np.sum(turned * b, -1) > 0).all()


def test_shortest_arc_of_opposite_directions_is_a_half_turn():
    a = np.array([0.0, 1.0, 0.0])
    turned = quaternion.to_matrix(quaternion.shortest_arc(a, -a)) @ a
    np.testing.assert_allclose(turned, -a, atol=1e-9)


def test_inverse_and_transform_points():
    T = rigid_transform(Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), np.array([1.0, 2.0, 3.0]))
    points = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    there = transform_points(T, points)
    assert there.dtype == np.float32
    np.testing.assert_allclose(transform_points(inverse(T), there), points, atol=1e-5)
    np.testing.assert_allclose(there[0], T[:3, :3] @ points[0] + T[:3, 3], atol=1e-5)


def test_look_at_puts_the_target_on_the_optical_axis_upright():
    eye, target = np.array([2.0, 1.5, 2.0]), np.array([0.0, 1.0, 0.0])
    T_camera_world = inverse(look_at(eye, target))
    seen = T_camera_world[:3, :3] @ target + T_camera_world[:3, 3]
    np.testing.assert_allclose(seen, [0, 0, np.linalg.norm(target - eye)], atol=1e-9)
    above = T_camera_world[:3, :3] @ (target + np.array([0, 0.1, 0])) + T_camera_world[:3, 3]
    assert above[1] < seen[1]  # y points down in a camera
    with pytest.raises(ValueError, match="do not span"):
        look_at(eye, eye)


def distorted_camera() -> Camera:
    pose = look_at(np.array([0.5, 1.4, 2.5]), np.array([0.0, 1.0, 0.0]))
    return Camera("cam1", 640, 480, 520.0, 525.0, 310.0, 245.0, pose, np.array([0.1, -0.05, 0.001, -0.002, 0.0]))


def test_project_inverts_pixel_rays_with_distortion():
    camera = distorted_camera()
    rays = pixel_rays(camera)
    assert rays.shape == (480, 640, 3)
    v, u = np.mgrid[20:460:40, 20:620:50].reshape(2, -1)
    depth = 1.0 + 0.003 * np.arange(len(u))
    in_camera = rays[v, u] * depth[:, None]
    world = in_camera @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    pixels, z = project(camera, world)
    np.testing.assert_allclose(pixels, np.stack([u, v], -1), atol=0.05)
    np.testing.assert_allclose(z, depth, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "image size"),
        ({"height": 100_000}, "image size"),
        ({"fx": -1.0}, "intrinsics"),
        ({"cx": float("nan")}, "intrinsics"),
        ({"T_world_camera": np.eye(3)}, "pose or distortion"),
        ({"T_world_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "not a rigid transform"),
        ({"T_world_camera": np.full((4, 4), np.nan)}, "pose or distortion"),
        ({"distortion": np.zeros(8)}, "distortion terms"),
    ],
)
def test_impossible_cameras_are_refused(change, message):
    good = {
        "name": "cam1", "width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0,
        "T_world_camera": np.eye(4),
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        Camera(**{**good, **change})
