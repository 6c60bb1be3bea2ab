"""What Rao & Hodges tried and left out: each experiment shows what it is about, on half a second of the routine."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from common.geometry.camera_model import project
from scripts.particle_experiments import (
    PAPER,
    LegMotion,
    cameras_around_pelvis,
    leg_motion,
    pca_space,
    projection_error_deg,
    selection_inversions,
    silhouettes,
    swapped_share,
    tracked,
    tracked_in_pca,
    uniform_chi_square,
    weigh_points,
    weigh_reprojection,
    with_legs_swapped,
)
from sender.capture.builtin_body import builtin_body
from sender.capture.choreography import routine
from sender.capture.retarget import retarget
from sender.fitting.annealed_particle_filter import anneal
from sender.fitting.ellipsoid_body import quadrics
from sender.fitting.motion_noise import MotionNoise, default_noise

RANDOM = replace(PAPER, selection="random")
STRIDE_RAD = np.radians([-30.0, 0, 0, 10, 0, 20, 0, 0, 25, 0])  # left leg before, right behind


@pytest.fixture(scope="module")
def motion() -> LegMotion:
    """Standing, with the built-in body's legs."""
    body = builtin_body()
    return leg_motion(body, retarget(body, routine()), 15, 0.5)


@pytest.fixture(scope="module")
def stride(motion: LegMotion) -> LegMotion:
    return replace(motion, particles=STRIDE_RAD[None], carriers=motion.carriers[:1])


@pytest.fixture(scope="module")
def walk(motion: LegMotion) -> LegMotion:
    """Sixteen frames of legs that swing against each other, knees bending in turn."""
    phase = np.linspace(0, 2 * np.pi, 16)
    particles = np.zeros((16, 10))
    particles[:, 0], particles[:, 5] = -0.5 * np.sin(phase), 0.5 * np.sin(phase)
    particles[:, 3], particles[:, 8] = 0.4 * (1 + np.cos(phase)), 0.4 * (1 - np.cos(phase))
    return replace(motion, particles=particles, carriers=np.repeat(motion.carriers[:1], 16, axis=0))


@pytest.fixture(scope="module")
def noise(motion: LegMotion) -> MotionNoise:
    return default_noise(motion.body)


def test_true_legs_hold_all_points_and_swapped_ones_few(stride: LegMotion) -> None:
    points = stride.points(0, np.random.default_rng(0))
    true, swapped = weigh_points(stride, 0, points)(np.stack([STRIDE_RAD, with_legs_swapped(STRIDE_RAD)]))
    assert true > 0.999
    assert swapped < 0.4


def test_swapping_legs_twice_changes_nothing() -> None:
    particle = np.random.default_rng(0).standard_normal(10)
    assert not np.array_equal(with_legs_swapped(particle), particle)
    np.testing.assert_array_equal(with_legs_swapped(with_legs_swapped(particle)), particle)


def test_silhouettes_show_where_points_of_the_body_fall(stride: LegMotion) -> None:
    T = stride.carriers[0]
    cameras = cameras_around_pelvis(T)
    images = silhouettes(quadrics(stride.body, STRIDE_RAD[None], T), cameras)[0]
    for camera, image in zip(cameras, images, strict=True):
        pixels, depth = project(camera, stride.points(0, np.random.default_rng(0)))
        assert depth.min() > 1
        u, v = np.rint(pixels).astype(int).T
        grown = cv2.dilate(image.astype(np.uint8), np.ones((3, 3), np.uint8))  # a point is up to half a pixel off
        assert grown[v, u].mean() > 0.999, camera.name
        assert 0.03 < image.mean() < 0.4


def test_images_take_swapped_legs_for_better_than_points_do(stride: LegMotion) -> None:
    """Fig. 4: in four images the legs of the other side cover most of the foreground."""
    swapped = with_legs_swapped(STRIDE_RAD)[None]
    points = stride.points(0, np.random.default_rng(0))
    in_images = weigh_reprojection(stride, 0, both_sides=False)(swapped)[0]
    assert in_images > 0.6 > 0.4 > weigh_points(stride, 0, points)(swapped)[0]
    assert weigh_reprojection(stride, 0, both_sides=True)(STRIDE_RAD[None])[0] == 1


def test_points_never_end_with_the_legs_swapped_and_images_sometimes_do(stride: LegMotion) -> None:
    sigma = np.full(10, 0.35)
    points = stride.points(0, np.random.default_rng(0))
    assert swapped_share(stride, 0, weigh_points(stride, 0, points), sigma, PAPER, 12) == 0
    assert swapped_share(stride, 0, weigh_reprojection(stride, 0, both_sides=False), sigma, PAPER, 12) > 0


def test_random_selection_prefers_lighter_particles_again_and_again() -> None:
    """Fig. 5 b, c."""
    weights = np.random.default_rng(0).uniform(0.4, 0.8, 81)
    random, deterministic = selection_inversions(weights, RANDOM, 100), selection_inversions(weights, PAPER, 3)
    assert random.draws == 1
    assert 0.2 < random.pairs < 0.5
    assert random.missed > 0.1
    assert (deterministic.draws, deterministic.pairs, deterministic.missed) == (0, 0, 0)


def test_it_is_the_drawing_and_not_the_generator() -> None:
    """Fig. 5 a blames the generator; numpy's is uniform, and the order of the weights is turned round all the same."""
    assert np.mean([uniform_chi_square(20_000, 50, seed) for seed in range(20)]) == pytest.approx(1, abs=0.15)


def test_the_published_filter_follows_a_walk_and_random_selection_does_worse(
    walk: LegMotion, noise: MotionNoise
) -> None:
    errors = {
        settings.selection: np.mean([tracked(walk, noise, settings, seed).errors_deg.mean() for seed in range(3)])
        for settings in (PAPER, RANDOM)
    }
    assert errors["deterministic"] < 10
    assert errors["random"] > errors["deterministic"]


def test_crossover_mixes_angles_of_survivors_and_leaves_their_spread(walk: LegMotion, noise: MotionNoise) -> None:
    """Fig. 5 d shows more variance in some angles. Here it is so in some, too, but the mean over all hardly moves: each
    angle still comes from a survivor, and only what belongs together is torn apart."""
    mixed, plain = (
        np.mean(
            [tracked(walk, noise, replace(PAPER, crossover=share), seed).variance[:, -1] for seed in range(3)], (0, 1)
        )
        for share in (0.5, 0.0)
    )
    ratio = mixed / plain
    assert ratio.max() > 1
    assert 0.8 < ratio.mean() < 1.25


def test_pca_space_fails_on_motion_it_was_not_learned_from(walk: LegMotion, noise: MotionNoise) -> None:
    """Fig. 10: components of legs that move together cannot show legs that move in turn."""
    squat = walk.particles.copy()
    squat[:, 5:] = squat[:, :5]
    space = pca_space([squat], 1, 2)
    in_pca, in_angles = tracked_in_pca(walk, space, PAPER), tracked(walk, noise, PAPER)
    assert projection_error_deg(walk, space) > 5
    moving = [0, 3, 5, 8]
    assert in_pca.errors_deg[:, moving].mean() > 1.5 * in_angles.errors_deg[:, moving].mean()


def test_pca_space_of_all_components_is_the_space_of_angles(walk: LegMotion) -> None:
    particles = np.random.default_rng(0).standard_normal((40, 10))
    space = pca_space([particles], 1, 10)
    assert projection_error_deg(walk, space) < 1e-9
    pose = walk.particles[3]
    np.testing.assert_allclose(space.particles(space.coordinates(pose)), pose, atol=1e-12)
    weigh = weigh_points(walk, 3, walk.points(3, np.random.default_rng(0)))
    found = anneal(
        space.coordinates(pose), space.sigma, lambda z: weigh(space.particles(z)), PAPER, np.random.default_rng(0)
    )
    assert found.layers[-1].weights.max() > 0
