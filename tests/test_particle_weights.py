"""Particle weights: the true ellipsoid, a point claimed once, and what the second side of the score is for."""

import numpy as np
import pytest

from common.body.skeleton import human_skeleton
from sender.fitting import particle_weights
from sender.fitting.ellipsoid_body import LEGS, ellipsoid_body, quadrics
from sender.fitting.particle_weights import claimed_points, numba_weights, weights_of

BODY = ellipsoid_body(human_skeleton(1.75), LEGS)
ONE_SIDED = np.zeros(6, np.float32)


def ball(radii: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """One particle of one axis-parallel ellipsoid, (1, 1, 3, 4)."""
    Q = np.zeros((1, 1, 3, 4), np.float32)
    Q[0, 0, :, :3] = np.diag(1 / np.array(radii))
    Q[0, 0, :, 3] = -np.array(centre) / np.array(radii)
    return Q


def cloud(count: int, seed: int = 0, size: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-size, size, (count, 3)).astype(np.float32)


def flags_as_printed(points: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Rao & Hodges §6 step by step, in float64, with the quadric in place of the printed box: claimed (P, E)."""
    claimed = np.zeros(Q.shape[:2])
    for p in range(len(Q)):
        belongs_to_none = np.ones(len(points), bool)
        for e in range(Q.shape[1]):
            local = points.astype(np.float64) @ Q[p, e, :, :3].T.astype(np.float64) + Q[p, e, :, 3]
            inside = belongs_to_none & ((local**2).sum(axis=1) <= 1)
            claimed[p, e] = inside.sum()
            belongs_to_none &= ~inside
    return claimed


def test_the_quadric_holds_the_ellipsoids_volume_and_the_printed_bounds_a_box_of_1_91_times_that() -> None:
    points = cloud(200_000)
    radii = (0.9, 0.5, 0.7)
    inside = numba_weights(points, ball(radii), np.zeros(1, np.float32))[0]
    printed = (np.abs(points / np.array(radii)) <= 1).all(axis=1).mean()  # with the absolute values it lacks
    assert inside == pytest.approx(4 / 3 * np.pi * np.prod(radii) / 8, rel=0.01)
    assert printed / inside == pytest.approx(6 / np.pi, rel=0.01)
    assert pytest.approx(1.91, abs=0.005) == 6 / np.pi


def test_a_point_in_two_ellipsoids_is_claimed_once_by_the_first() -> None:
    both = np.concatenate([ball((1, 1, 1)), ball((1, 1, 1), (1, 0, 0))], axis=1)
    points = np.array([[0.5, 0, 0], [0.6, 0, 0], [1.5, 0, 0], [5, 0, 0]], np.float32)
    assert claimed_points(points, both).tolist() == [[2, 1]]
    assert numba_weights(points, both, np.zeros(2, np.float32)).tolist() == [0.75]


def test_kernel_and_its_python_twin_follow_the_printed_steps() -> None:
    particles = 0.3 * np.random.default_rng(1).standard_normal((5, BODY.dof_count))
    Q = quadrics(BODY, particles, np.eye(4))
    points = cloud(1200, 2, 0.4) - np.array([0, 0.4, 0], np.float32)  # more than one block
    expected = flags_as_printed(points, Q)
    assert expected.sum(axis=1).min() > 20
    np.testing.assert_array_equal(claimed_points(points, Q), expected)
    twin = np.zeros(Q.shape[:2], np.float32)
    python = getattr(particle_weights._claim, "py_func", particle_weights._claim)
    python(*np.ascontiguousarray(points.T), Q, twin)
    np.testing.assert_array_equal(twin, expected)


def test_without_points_every_weight_is_zero() -> None:
    Q = quadrics(BODY, np.zeros((3, BODY.dof_count)), np.eye(4))
    assert numba_weights(np.zeros((0, 3), np.float32), Q, ONE_SIDED).tolist() == [0, 0, 0]


def test_expected_shares_lower_the_weight_by_what_is_missing() -> None:
    claimed = np.array([[30, 10], [40, 0], [0, 40]], np.float32)
    weights = weights_of(claimed, 50, np.array([0.3, 0.3], np.float32))
    np.testing.assert_allclose(weights, [0.8 * 0.9, 0.8 * 0.7, 0.8 * 0.7], rtol=1e-6)


def test_a_limb_hidden_in_the_torso_wins_one_sided_and_loses_two_sided() -> None:
    """Two arms side by side before a torso that is not quite an ellipsoid. One arm can hold the points of both; the
    other then does better in the torso, where it picks up points the torso's ellipsoid leaves over."""
    random = np.random.default_rng(5)
    unit = random.standard_normal((2600, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    torso = unit[:2000] * [0.16, 0.32, 0.12] * random.uniform(0.93, 1.04, (2000, 1))
    arms = [unit[2000 + 300 * k : 2300 + 300 * k] * [0.035, 0.13, 0.035] + [0.02 * k, 0, 0.25] for k in (0, 1)]
    points = np.concatenate([torso, *arms]).astype(np.float32)
    arm = (0.05, 0.15, 0.05)
    in_place = ball(arm, (0, 0, 0.25)), ball(arm, (0.02, 0, 0.25))
    hidden = ball(arm, (0.01, 0, 0.25)), ball(arm, (0.05, 0.1, 0.09))
    body = ball((0.16, 0.32, 0.12))
    Q = np.concatenate([np.concatenate([body, *pose], axis=1) for pose in (in_place, hidden)])
    one_sided = numba_weights(points, Q, np.zeros(3, np.float32))
    expected = 0.7 * np.array([0.5, 0.1, 0.1], np.float32)
    two_sided = numba_weights(points, Q, expected)
    assert one_sided[1] > one_sided[0]
    assert two_sided[0] > two_sided[1]
