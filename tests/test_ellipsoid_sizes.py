"""Ellipsoids measured on a cloud with a known pose."""

import numpy as np

from common.body.skeleton import human_skeleton
from sender.fitting.ellipsoid_body import LEGS, arm_links, ellipsoid_body, quadrics
from sender.fitting.ellipsoid_sizes import measured
from sender.fitting.particle_weights import claimed_points
from tests.ellipsoid_cloud import surface_cloud

SKELETON = human_skeleton(1.75)
POSE = np.radians([-30.0, 5, 8, 40, 10, 15, -5, -6, 20, -10])


def test_limbs_thicker_than_the_skeleton_says_are_found() -> None:
    body = ellipsoid_body(SKELETON, LEGS)
    thick = body.scaled(1.25)
    found = measured(body, surface_cloud(thick, POSE, np.eye(4), 400), POSE, np.eye(4))
    np.testing.assert_allclose(found.axes[:, [0, 2]], thick.axes[:, [0, 2]], rtol=0.2)
    assert (np.abs(found.directions[[0, 1, 3, 4]][:, 1, 1]) > 0.99).all()  # thighs and shins along their bones
    np.testing.assert_allclose(np.linalg.det(found.directions), 1.0, atol=1e-9)


def test_half_of_the_points_lie_inside_the_measured_ellipsoids_and_nearly_all_in_larger_ones() -> None:
    body = ellipsoid_body(SKELETON, arm_links("right"))
    pose = np.array([0.2, 0.3, -0.4, 0.8])
    points = surface_cloud(body, pose, np.eye(4), 500)
    found = measured(body, points, pose, np.eye(4))
    half, nearly_all = (
        claimed_points(points, quadrics(found.scaled(factor), pose[None], np.eye(4))).sum() / len(points)
        for factor in (1.0, 1.15)
    )
    assert 0.4 < half < 0.6
    assert nearly_all > 0.9


def test_an_ellipsoid_that_no_point_shows_keeps_its_sizes() -> None:
    body = ellipsoid_body(SKELETON, LEGS)
    left = surface_cloud(body, POSE, np.eye(4), 300)[:900]  # the first three ellipsoids
    found = measured(body, left, POSE, np.eye(4))
    np.testing.assert_array_equal(found.axes[3:], body.axes[3:])
    assert (found.axes[:3] != body.axes[:3]).any(axis=1).all()
