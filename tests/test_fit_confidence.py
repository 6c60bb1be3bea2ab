"""What counts as good, bad and lost, and how sure a fit is of every link."""

import numpy as np
import pytest

from common.body.skeleton import LINK_COUNT, LINK_INDEX
from sender.fitting.articulated_gauss_newton import FitArrays, PoseState
from sender.fitting.fit_confidence import FIRST_FRAMES, NOISIEST, FitConfidence, ScoreScale


def fit_of(score: float, explained: float = 50.0, assigned: float = 50.0) -> FitArrays:
    state = PoseState(np.zeros(3), np.tile(np.eye(3), (LINK_COUNT, 1, 1)))
    everywhere = np.ones(LINK_COUNT)
    return FitArrays(state, score, 1.0, 0.01, assigned * everywhere, explained * everywhere, np.zeros(1000, np.int64))


def test_clean_clouds_keep_the_given_scale() -> None:
    scale = ScoreScale(0.1, 0.25)
    for _ in range(30):
        scale.update(0.02)
    assert (scale.good, scale.lost) == (0.1, 0.25)
    assert scale.good < scale.bad < scale.lost
    assert scale.confidence(fit_of(0.02)) == 1.0
    assert scale.confidence(fit_of(0.3)) == 0.0


def test_noisy_clouds_widen_the_scale_and_later_trouble_does_not() -> None:
    scale = ScoreScale(0.1, 0.25)
    for _ in range(FIRST_FRAMES):
        scale.update(0.2)
    assert scale.good == pytest.approx(0.23)
    before = scale.lost
    for _ in range(50):
        scale.update(0.6)
    assert scale.lost == before
    noisiest = ScoreScale(0.1, 0.25)
    noisiest.update(0.9)
    assert noisiest.good == pytest.approx(1.15 * NOISIEST)


def test_a_link_that_shows_less_than_usual_is_less_certain() -> None:
    confidence = FitConfidence()
    assert confidence.update(fit_of(0.02), 1000).min() == 1.0
    unseen = fit_of(0.02)
    foot, toes = LINK_INDEX["left_foot"], LINK_INDEX["left_toes"]
    unseen.explained[foot] = 0.0
    after = confidence.update(unseen, 1000)
    assert after[foot] == after[toes] == 0.0
    assert after[LINK_INDEX["head"]] == 1.0
    assert confidence.usual[foot] > 0.9 * 0.05
