"""Lost limbs and a lost body are found again, a little work per frame."""

import numpy as np
from scipy.spatial.transform import Rotation

from common.body.skeleton import LINK_INDEX
from sender.fitting.articulated_gauss_newton import PoseState
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.limb_search import Limb, limbs
from sender.fitting.particle_recovery import LAYERS, BodyRecovery, LimbRecovery
from tests.capsule_person import pose_at
from tests.test_gauss_newton import PLAN, TABLE, capsule_body, capsule_cloud, joint_error_m, state_of

TRUTH = pose_at(0.0)
CLOUD = capsule_cloud(TRUTH)
ARM: Limb = next(limb for limb in limbs(TABLE) if limb.links[0] == LINK_INDEX["left_upper_arm"])


def lost_arm() -> PoseState:
    lost = state_of(TRUTH)
    lost.local[LINK_INDEX["left_upper_arm"]] = Rotation.from_rotvec([0, 0, 1.2]).as_matrix()
    lost.local[LINK_INDEX["left_forearm"]] = Rotation.from_rotvec([0, -2.2, 0]).as_matrix()
    return lost


def searched(last_good: PoseState) -> list[float]:
    """Joint error [m] after each frame of a recovery, which goes on from what it found."""
    fitter = BodyFitter(capsule_body(), TABLE)
    recovery, fit, errors = LimbRecovery(ARM, last_good, 0), fitter.judge(CLOUD, lost_arm()), []
    while not recovery.ended:
        found = recovery.step(fit, CLOUD, fitter)
        fit = fit if found is None else fitter.fit(CLOUD, found, found, PLAN)
        errors.append(joint_error_m(fit.pose, TRUTH))
    return errors


def test_lost_arm_is_found_by_particles() -> None:
    errors = searched(lost_arm())
    assert joint_error_m(lost_arm(), TRUTH) > 0.03
    assert len(errors) == len(LAYERS) + 1
    assert errors[-1] < 0.01


def test_the_last_good_pose_is_tried_first() -> None:
    assert searched(state_of(TRUTH))[0] < 0.01


def test_recovery_is_deterministic() -> None:
    assert searched(lost_arm()) == searched(lost_arm())


def test_a_limb_in_its_place_stays() -> None:
    fitter, truth = BodyFitter(capsule_body(), TABLE), state_of(TRUTH)
    fit = fitter.fit(CLOUD, truth, truth, PLAN)
    recovery = LimbRecovery(ARM, truth, 0)
    while not recovery.ended:
        assert recovery.step(fit, CLOUD, fitter) is None


def test_a_body_that_was_turned_away_comes_back() -> None:
    fitter = BodyFitter(capsule_body(), TABLE)
    away = state_of(TRUTH)
    away.local[0] = Rotation.from_rotvec([0.5, 0.6, 0.0]).as_matrix() @ away.local[0]
    away = PoseState(away.root + np.array([0.12, 0.05, 0.0]), away.local)
    recovery, now = BodyRecovery(away, 0), away
    for _ in range(8):
        now = recovery.step(now, CLOUD, fitter)
    fit = fitter.fit(CLOUD, now, now, PLAN)
    assert joint_error_m(away, TRUTH) > 0.15
    assert joint_error_m(fit.pose, TRUTH) < 0.02
