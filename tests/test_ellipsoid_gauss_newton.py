"""Gauss–Newton on ellipsoid distances: it finds known angles, and its derivatives are those of the kinematics."""

import numpy as np
import pytest

from common.body.skeleton import human_skeleton
from sender.fitting.ellipsoid_body import LEGS, WHOLE_BODY, arm_links, ellipsoid_body, link_transforms, quadrics
from sender.fitting.ellipsoid_gauss_newton import Polish, _motions, _nearest, polished
from tests.ellipsoid_cloud import surface_cloud

SKELETON = human_skeleton(1.75)
BODY = ellipsoid_body(SKELETON, LEGS)
PELVIS = np.array([[0.0, 0, 1, 0.3], [0, 1, 0, 0.9], [-1, 0, 0, 0.1], [0, 0, 0, 1]])
BENT = np.radians([-40.0, 5, 8, 50, 10, 15, -5, -6, 20, -10])


def test_a_pose_some_degrees_away_comes_back_onto_the_surface() -> None:
    points = surface_cloud(BODY, BENT, PELVIS, 200)
    starts = BENT + np.radians(8) * np.random.default_rng(1).uniform(-1, 1, (3, BODY.dof_count))
    found, costs = polished(BODY, points, starts, PELVIS, Polish(steps=10))
    assert np.degrees(np.abs(found - BENT)).mean() < 1.0
    _, before = polished(BODY, points, starts, PELVIS, Polish(steps=0))
    assert (costs < 0.3 * before).all()


def test_without_steps_nothing_moves() -> None:
    points = surface_cloud(BODY, BENT, PELVIS, 50)
    found, costs = polished(BODY, points, BENT[None], PELVIS, Polish(steps=0))
    np.testing.assert_array_equal(found[0], BENT)
    assert 0 <= costs[0] < 0.1


def test_hinges_stay_within_their_limits() -> None:
    arm = ellipsoid_body(SKELETON, arm_links("left"))
    wrong = np.array([0.0, 0.1, 0.1, 0.9])  # an elbow bent the wrong way
    points = surface_cloud(arm, wrong, np.eye(4), 200)
    found, _ = polished(arm, points, wrong[None], np.eye(4), Polish())
    assert found[0, 3] <= arm.high[3] < 0.9


def test_motions_are_the_derivatives_of_every_degree_of_freedom() -> None:
    body = ellipsoid_body(SKELETON, WHOLE_BODY)
    particle = 0.3 * np.random.default_rng(2).standard_normal(body.dof_count)
    S = _motions(body, particle[None], np.eye(4))[0]
    step = 1e-5
    for d in (0, 4, 9, 14, 29):
        moved = particle.copy()
        moved[d] += step
        T, T_moved = (link_transforms(body, p[None], np.eye(4))[0] for p in (particle, moved))
        for e, link in enumerate(body.ellipsoid_link):
            point = body.centres[e] + 0.05
            here, there = (M[link, :, :3] @ point + M[link, :, 3] for M in (T, T_moved))
            np.testing.assert_allclose(np.cross(S[d, e, :3], here) + S[d, e, 3:], (there - here) / step, atol=1e-3)


@pytest.mark.parametrize(("point", "away"), [((0.0, 0.52, 0.0), 0.02), ((0.0, 0.0, 0.11), 0.01), ((0.09, 0, 0), -0.01)])
def test_the_distance_to_an_ellipsoid_is_signed_metres(point: tuple[float, float, float], away: float) -> None:
    Q = np.zeros((1, 3, 4))
    Q[0, :, :3] = np.diag([1 / 0.1, 1 / 0.5, 1 / 0.1])
    own, distance, *normal = _nearest(Q, *point)
    assert own == 0
    assert distance == pytest.approx(away, abs=1e-3)
    np.testing.assert_allclose(np.array(normal), np.array(point) / np.linalg.norm(point), atol=1e-6)


def test_a_point_belongs_to_the_ellipsoid_whose_surface_is_nearest() -> None:
    Q = quadrics(BODY, BENT[None], PELVIS)[0]
    for e in range(len(BODY.axes)):
        point = surface_cloud(BODY, BENT, PELVIS, 1, only=e)[0]
        assert _nearest(Q, *point)[0] == e
