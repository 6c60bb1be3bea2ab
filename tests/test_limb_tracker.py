"""Limb trackers on known motions: as published, improved, and what happens when things go wrong."""

from dataclasses import replace

import numpy as np
import pytest

from common.body.skeleton import human_skeleton
from sender.fitting.annealed_particle_filter import AnnealingSettings
from sender.fitting.ellipsoid_body import LEGS, arm_links, ellipsoid_body
from sender.fitting.limb_tracker import IMPROVED, PUBLISHED, LimbSettings, LimbTracker
from sender.fitting.motion_noise import default_noise
from sender.fitting.particle_weights import numba_weights
from tests.ellipsoid_cloud import surface_cloud

SKELETON = human_skeleton(1.75)
BODY = ellipsoid_body(SKELETON, LEGS)
FRAME_NS = 33_333_333


def walking(frame: int) -> np.ndarray:
    """A brisk walk: thighs ±25°, knees to 60°, a step in 0.55 s."""
    phase = 2 * np.pi * frame / 33
    leg = [
        np.array([-5 - 25 * np.sin(p), 3, 4 * np.cos(p), 32 - 28 * np.cos(p + 0.6), 8 * np.sin(p)])
        for p in (phase, phase + np.pi)
    ]
    return np.radians(np.concatenate(leg))


def pelvis(frame: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = [0.1, 0.92 + 0.02 * np.sin(frame / 3), 0.04 * frame]
    return T


def errors_deg(settings: LimbSettings, frames: range, seed: int = 0) -> np.ndarray:
    """Mean error per frame [deg] on ``frames`` of the walk, the first given."""
    tracker = LimbTracker(BODY, default_noise(BODY), settings, seed)
    out = []
    for frame in frames:
        points = surface_cloud(BODY, walking(frame), pelvis(frame), 150, seed=frame)
        if frame == frames[0]:
            tracker.start_from(points, walking(frame), pelvis(frame), frame * FRAME_NS)
            continue
        fit = tracker.track(points, pelvis(frame), frame * FRAME_NS)
        out.append(np.degrees(np.abs(fit.particle - walking(frame))).mean())
    return np.array(out)


def test_the_published_tracker_follows_a_walk() -> None:
    errors = errors_deg(PUBLISHED, range(40))
    assert errors.mean() < 8.0
    assert errors.max() < 19.3


def test_the_improved_tracker_follows_far_more_closely() -> None:
    errors = errors_deg(IMPROVED, range(40))
    assert errors.mean() < 2.0
    assert errors.max() < 5.0


def test_the_improved_tracker_follows_at_four_frames_a_second() -> None:
    errors = errors_deg(IMPROVED, range(0, 100, 7))
    assert np.median(errors) < 2.5
    assert errors.mean() < 5.0


def test_gauss_newton_alone_without_particles_would_not() -> None:
    alone = replace(IMPROVED, annealing=AnnealingSettings(particles=1, layers=1), finalists=1)
    assert errors_deg(alone, range(0, 100, 7)).mean() > 2 * errors_deg(IMPROVED, range(0, 100, 7)).mean()


def test_the_same_seed_gives_the_same_poses_and_another_seed_others() -> None:
    first, again, other = (errors_deg(PUBLISHED, range(4), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


def test_an_arm_is_followed_from_swing_to_bend() -> None:
    body = ellipsoid_body(SKELETON, arm_links("right"))
    tracker = LimbTracker(body, default_noise(body), IMPROVED)
    for frame in range(25):
        pose = np.array([0.3, 0.04 * frame - 0.5, 0.3 - 0.03 * frame, 0.3 + 0.05 * frame])
        points = surface_cloud(body, pose, np.eye(4), 400, seed=frame)
        if frame == 0:
            tracker.start_from(points, pose, np.eye(4), 0)
        else:
            fit = tracker.track(points, np.eye(4), frame * FRAME_NS)
    assert np.degrees(np.abs(fit.particle - pose)).max() < 4.0
    assert fit.T_world_link.shape == (2, 3, 4)
    assert fit.weight > 0.85


def test_without_points_the_limb_stays_and_says_it_sees_nothing() -> None:
    tracker = LimbTracker(BODY, default_noise(BODY), IMPROVED)
    tracker.start_from(surface_cloud(BODY, walking(0), pelvis(0), 100), walking(0), pelvis(0), 0)
    fit = tracker.track(np.zeros((0, 3), np.float32), pelvis(1), FRAME_NS)
    np.testing.assert_array_equal(fit.particle, walking(0))
    assert fit.weight == 0.0


def test_time_that_runs_backwards_or_stands_still_is_survived() -> None:
    tracker = LimbTracker(BODY, default_noise(BODY), PUBLISHED)
    points = surface_cloud(BODY, walking(0), pelvis(0), 100)
    tracker.start_from(points, walking(0), pelvis(0), 10 * FRAME_NS)
    for capture_ns in (10 * FRAME_NS, 5 * FRAME_NS, 6 * FRAME_NS):
        fit = tracker.track(points, pelvis(0), capture_ns)
    assert np.degrees(np.abs(fit.particle - walking(0))).mean() < 10.0


def test_a_jump_is_searched_a_second_time_and_found() -> None:
    searched: list[int] = []

    def spy(points: np.ndarray, quadrics: np.ndarray, expected: np.ndarray) -> np.ndarray:
        searched.append(len(quadrics))
        return numba_weights(points, quadrics, expected)

    tracker = LimbTracker(BODY, default_noise(BODY), IMPROVED, weights=spy)
    tracker.start_from(surface_cloud(BODY, walking(0), pelvis(0), 150), walking(0), pelvis(0), 0)
    tracker.track(surface_cloud(BODY, walking(0), pelvis(0), 150, seed=1), pelvis(0), FRAME_NS)
    assert len(searched) == 3
    jumped = walking(0) + np.radians([-100, 0, 20, 80, 0, 20, 0, -20, 70, 0])
    for frame in range(2, 6):
        fit = tracker.track(surface_cloud(BODY, jumped, pelvis(0), 150, seed=frame), pelvis(0), frame * FRAME_NS)
    assert len(searched) > 3 + 4 * 3
    assert np.degrees(np.abs(fit.particle - jumped)).mean() < 3.0


@pytest.mark.parametrize("settings", [PUBLISHED, IMPROVED])
def test_weights_come_from_the_device_that_was_chosen(settings: LimbSettings) -> None:
    asked: list[tuple[int, int, float]] = []

    def spy(points: np.ndarray, quadrics: np.ndarray, expected: np.ndarray) -> np.ndarray:
        asked.append((len(points), len(quadrics), float(expected.sum())))
        return numba_weights(points, quadrics, expected)

    tracker = LimbTracker(BODY, default_noise(BODY), settings, weights=spy)
    points = surface_cloud(BODY, walking(0), pelvis(0), 400)
    tracker.start_from(points, walking(0), pelvis(0), 0)
    tracker.track(points, pelvis(0), FRAME_NS)
    assert [count for _, count, _ in asked] == [settings.annealing.particles] * 3
    if settings is PUBLISHED:
        assert asked[0][0] == len(points)
        assert asked[0][2] == 0.0
    else:
        assert asked[0][0] <= settings.weighed
        assert asked[0][2] == pytest.approx(0.7 * 0.95, abs=0.05)
