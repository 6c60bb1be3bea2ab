"""Joints from several sensors: steadier than each, not late, and no jump when a sensor comes or goes."""

from __future__ import annotations

import numpy as np
import pytest

from sender.fitting.joint_filter import JointFilter

FRAME_S, NOISE_M = 1 / 30, 0.003


def followed(
    places: np.ndarray, noise_m: tuple[float, ...], offsets_m: tuple[float, ...], present: np.ndarray | None = None
) -> np.ndarray:
    """What is found (F, 3) of one joint at ``places`` (F, 3); ``present`` (F, S)."""
    random, found = np.random.default_rng(0), []
    joints = JointFilter(1, len(noise_m))
    tracked = np.zeros(len(noise_m), bool)
    present = np.ones((len(places), len(noise_m)), bool) if present is None else present
    for place, here in zip(places, present, strict=True):
        joints.advance(FRAME_S)
        seen = place + random.normal(0, 1, (len(noise_m), 3)) * np.reshape(noise_m, (-1, 1))
        seen[:, 0] += offsets_m
        for sensor in np.nonzero(here & ~tracked)[0].tolist():
            joints.welcome(sensor, seen[sensor][None], np.array([True]))
        tracked = here
        joints.wander(FRAME_S, np.where(here, np.square(noise_m), np.inf)[None])
        for sensor in np.nonzero(here)[0].tolist():
            joints.take(sensor, seen[sensor][None], 0.0, np.array([noise_m[sensor] ** 2]))
        found.append(joints.places[0].copy())
    return np.array(found)


def test_at_rest_sensors_and_time_are_averaged() -> None:
    found = followed(np.zeros((200, 3)), (NOISE_M, NOISE_M), (0.0, 0.0))[50:]
    assert found.std(axis=0).max() < 0.6 * NOISE_M  # 0.71 of the sensors alone


@pytest.mark.parametrize("hz", [0.5, 1.0, 2.0])
def test_what_moves_is_not_late(hz: float) -> None:
    t = np.arange(200) * FRAME_S

    def place(at: np.ndarray) -> np.ndarray:
        return np.stack([0 * at, 0.15 * np.sin(2 * np.pi * hz * at), 0 * at], axis=1)

    found = followed(place(t), (NOISE_M, NOISE_M), (0.02, -0.02))[60:]
    errors = [np.abs(found - place(t - late * FRAME_S)[60:])[:, 1].mean() for late in (-0.5, 0.0, 0.5)]
    assert np.argmin(errors) == 1


def test_who_comes_and_goes_makes_no_jump() -> None:
    present = np.ones((150, 2), bool)
    present[50:100, 0] = False
    found = followed(np.zeros((150, 3)), (1e-4, 1e-4), (0.0, 0.1), present)
    assert np.linalg.norm(np.diff(found[5:], axis=0), axis=1).max() < 0.004


def test_motion_follows_the_sensor_whose_word_is_worth_more() -> None:
    random = np.random.default_rng(1)
    walk = np.cumsum(random.normal(0, 0.004, (200, 3)), axis=0)
    joints, found = JointFilter(1, 2), []
    for frame in range(200):
        joints.advance(FRAME_S)
        joints.wander(FRAME_S, np.array([[1e-6, 1e-4]]))
        joints.take(0, np.zeros((1, 3)), 0.0, np.array([1e-6]))
        joints.take(1, walk[frame][None], 0.0, np.array([1e-4]))
        found.append(joints.places[0].copy())
    assert np.linalg.norm(np.array(found)[5:], axis=1).max() < 0.25 * np.linalg.norm(walk, axis=1).max()


def test_what_arrives_late_says_where_the_joint_was() -> None:
    joints = JointFilter(1, 1)
    for frame in range(90):
        joints.advance(FRAME_S)
        joints.wander(FRAME_S, np.array([[1e-6]]))
        joints.take(0, np.array([[(frame - 1) * 0.02, 0.0, 0.0]]), FRAME_S, np.array([1e-6]))
    assert joints.places[0, 0] == pytest.approx(89 * 0.02, abs=0.002)
