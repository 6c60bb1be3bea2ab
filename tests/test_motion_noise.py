"""Particle noise: a third of the largest change between frames, whatever the time between them."""

import numpy as np
import pytest

from common.body.skeleton import human_skeleton
from sender.fitting.ellipsoid_body import LEGS, TORSO, WHOLE_BODY, ellipsoid_body
from sender.fitting.motion_noise import default_noise, learned_noise

FRAME_S = 1 / 30


def test_the_noise_is_a_third_of_the_largest_change() -> None:
    times = np.arange(400) * FRAME_S
    swinging = np.stack([0.5 * np.sin(4 * times), 0.1 * np.sin(2 * times)], axis=1)
    noise = learned_noise([swinging])
    np.testing.assert_allclose(noise.after(FRAME_S) * 3, [0.5 * 4 * FRAME_S, 0.1 * 2 * FRAME_S], rtol=0.02)


def test_a_marker_that_jumps_in_one_frame_is_discounted_and_a_full_turn_is_no_change() -> None:
    times = np.arange(1000) * FRAME_S
    clean = 0.5 * np.sin(4 * times)[:, None]
    torn = clean.copy()
    torn[500] += 1.5
    torn[700:] += 2 * np.pi
    np.testing.assert_allclose(learned_noise([torn]).after(FRAME_S), learned_noise([clean]).after(FRAME_S), rtol=0.05)


def test_more_time_between_frames_means_more_noise() -> None:
    noise = learned_noise([np.cumsum(np.full((300, 1), 0.02), axis=0)])
    np.testing.assert_allclose([noise.after(k * FRAME_S)[0] for k in (0, 0.5, 1, 3, 8)],
                               np.array([0, 0.5, 1, 3, 8]) * 0.02 / 3, rtol=1e-6)  # fmt: skip
    assert noise.after(60.0)[0] == noise.after(8 * FRAME_S)[0]


def test_clips_too_short_to_learn_from_are_refused() -> None:
    with pytest.raises(ValueError, match="no clip of more than 8 frames"):
        learned_noise([np.zeros((8, 2))])


def test_the_default_covers_every_degree_of_freedom_and_stays_sane() -> None:
    for names in (LEGS, TORSO, WHOLE_BODY):
        body = ellipsoid_body(human_skeleton(1.75), names)
        noise = default_noise(body)
        frame, quarter_s = noise.after(FRAME_S), noise.after(0.25)
        turns = body.dof_axis < 3
        assert (np.degrees(frame[turns]) > 1).all()
        assert (np.degrees(frame[turns]) < 15).all()
        assert ((quarter_s > frame) & (quarter_s < 4 * frame)).all()
