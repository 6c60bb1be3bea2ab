"""The default pose tracker: finds a person, learns their surface and follows them with Gauss–Newton.

Looking → building (the first second after the start pose: the surface is gathered) → tracking → looking again after
the person was lost for a while. Everything depends only on the clouds and their capture times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from sender.fitting.articulated_gauss_newton import FitArrays, PoseState, Schedule, forward
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.body_learning import BodyLearning
from sender.fitting.body_model import BodyModel
from sender.fitting.fit_confidence import FitConfidence, ScoreScale
from sender.fitting.initial_pose import NoPose
from sender.fitting.initial_pose_search import InitialPoseSearch
from sender.fitting.joint_limits import joint_table
from sender.fitting.limb_search import CLEARLY_BETTER, Limb, limbs, thinned, within_reach
from sender.fitting.particle_recovery import BodyRecovery, LimbRecovery
from sender.fitting.pose_prediction import FRAME_NS, LossTimer, predicted_poses
from sender.fitting.tracker import MINIMUM_POINTS, FitResult, untrusted
from sender.fitting.whole_body_search import WholeBodySearch

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class GaussNewtonSettings:
    """``building_s``: how long the surface is gathered after the start pose. ``good_score``, ``lost_score``: mean
    robust cost per point (0..1) below which a pose is trusted, and above which the person counts as lost; ``lost_s``:
    for this long before looking again. ``stranger_s``: how long the known person is looked for before anybody else
    will do. ``floor_y`` [m]: height of the floor, when known. ``match_colours``: whether a point goes rather to
    surface of its own colour."""

    building_s: float = 1.5
    good_score: float = 0.095
    lost_score: float = 0.25
    lost_s: float = 1.0
    stranger_s: float = 2.0
    floor_y: float | None = None
    match_colours: bool = False


HYPOTHESES = (1.0, 0.5, 0.0)  # shares of the last velocity
GUESS = Schedule(1, 0.20, 0.10, 0.2, 1.0, 1.0)
COARSE = Schedule(2, 0.15, 0.08, 0.1, 1.0, 1.0, 0.025)
FINE = Schedule(2, 0.08, 0.06, 0.1, 1.0, 1.0, 0.025)
GUESS_POINTS, COARSE_POINTS, FINE_POINTS = 250, 600, 2500
NOISY_COARSE = Schedule(2, 0.20, 0.15, 0.1, 1.0, 1.0)  # for noisy clouds: the robust kernel is as wide as the noise
NOISY_FINE = Schedule(3, 0.15, 0.12, 0.1, 1.0, 1.0)
RETRY_FRAMES = 5  # after a limb search in vain
GUESSED_SIGMA_M, KNOWN_SIGMA_M = 0.04, 0.005  # of joint centres found by the automatic start, and of given ones


class GaussNewtonTracker:
    """Implements ``Tracker``. ``body``: a person seen before, then no start pose is needed."""

    def __init__(self, settings: GaussNewtonSettings, body: BodyModel | None = None) -> None:
        self._settings = settings
        self._table = joint_table()
        self._limbs = limbs(self._table)
        self._body = body
        if body is not None:
            body.match_colours = settings.match_colours
        self._search: WholeBodySearch | None = None if body is None else WholeBodySearch(body, self._table)
        self._newcomer = InitialPoseSearch(settings.floor_y)
        self._state: PoseState | None = None
        self._before: PoseState | None = None  # the frame before: velocity
        self._times_ns = (0, 0)  # of the state and of the frame before
        self._scale = ScoreScale(settings.good_score, settings.lost_score)
        self._good: PoseState | None = None  # the last pose that fitted well
        self._confidence = FitConfidence()
        self._learning: BodyLearning | None = None
        self._limb_recovery: LimbRecovery | None = None
        self._body_recovery: BodyRecovery | None = None
        self._result: FitResult | None = None
        self._looking_since_ns: int | None = None
        self._loss = LossTimer(settings.lost_s)
        self._frames = 0
        self._retry_after = np.zeros(LINK_COUNT, np.int64)
        self._status = "looking for a person"

    @property
    def status(self) -> str:
        """What the tracker is doing, or why there is no pose yet, for the operator."""
        return self._status

    @property
    def body(self) -> BodyModel | None:
        """The person's model once one was found; worth saving when the status is "tracking"."""
        return self._body

    def start_from(self, skeleton: Skeleton, pose: SkeletonPose, cloud: PointCloud, capture_ns: int) -> FitResult:
        """Starts with sizes and pose known from elsewhere (a recording's own joints) and the cloud they belong to."""
        return self._start(skeleton, pose, cloud, capture_ns, KNOWN_SIGMA_M)

    def _start(
        self, skeleton: Skeleton, pose: SkeletonPose, cloud: PointCloud, capture_ns: int, sigma_m: float
    ) -> FitResult:
        """A fresh body; ``sigma_m``: how well its joint centres are known."""
        self._body = BodyModel(skeleton, self._settings.match_colours)
        self._body.add(cloud, forward_kinematics(skeleton, pose))
        self._begin(_state_of(pose), capture_ns, capture_ns + int(self._settings.building_s * 1e9), sigma_m)
        judged = thinned(cloud, FINE_POINTS)
        return self._accept(self._fitter().judge(judged, _state_of(pose)), cloud, judged, capture_ns)

    def track(self, cloud: PointCloud, capture_ns: int) -> FitResult | None:
        """The pose in ``cloud``; with too few points the last pose at confidence 0, or None before the start."""
        if len(cloud) < MINIMUM_POINTS:
            return self._nobody(len(cloud), capture_ns)
        self._frames += 1
        if self._state is None:
            return self._look(cloud, capture_ns)
        judged = thinned(cloud, FINE_POINTS)
        fit = self._follow(cloud, judged, capture_ns)
        self._scale.update(fit.score)
        if fit.score < self._scale.lost:
            self._loss.seen_well(capture_ns)
        elif self._loss.lost(capture_ns):
            self._state = None
            self._status = "lost: looking for the person"
            return self._unseen()
        return self._accept(fit, cloud, judged, capture_ns)

    def _nobody(self, points: int, capture_ns: int) -> FitResult | None:
        """Nobody to see; who comes after a while may be somebody else, and is looked at afresh."""
        if self._loss.lost(capture_ns):
            self._state = None
        self._looking_since_ns = None
        self._status = f"{points} points: nobody to see"
        return self._unseen()

    def _look(self, cloud: PointCloud, capture_ns: int) -> FitResult | None:
        """The known person in any pose; when there is none, or they do not come, anybody upright."""
        if self._looking_since_ns is None:
            self._looking_since_ns = capture_ns
        if self._search is not None:
            found = self._search.step(cloud)
            if self._search.recognises(found, cloud):
                judged = thinned(cloud, FINE_POINTS)
                fit = self._fitter().judge(judged, found.pose)
                self._begin(fit.pose, capture_ns, 0, KNOWN_SIGMA_M)
                return self._accept(fit, cloud, judged, capture_ns)
            self._status = f"looking for the known person: best score {found.score:.2f}"
            if capture_ns - self._looking_since_ns < self._settings.stranger_s * 1e9:
                return self._unseen()
        first = self._newcomer.step(cloud, capture_ns)
        if isinstance(first, NoPose):
            self._status = f"looking for a person: {first.reason}"
            return self._unseen()
        return self._start(first.skeleton, first.pose, cloud, capture_ns, GUESSED_SIGMA_M)

    def _begin(self, state: PoseState, capture_ns: int, building_until_ns: int, sigma_m: float) -> None:
        body = self._known_body()
        self._search = WholeBodySearch(body, self._table)
        self._newcomer = InitialPoseSearch(self._settings.floor_y)
        self._state = self._before = self._good = state
        self._times_ns = (capture_ns, capture_ns)
        self._confidence = FitConfidence()
        self._scale = ScoreScale(self._settings.good_score, self._settings.lost_score)
        self._learning = BodyLearning(body, self._table, building_until_ns, sigma_m)
        self._limb_recovery, self._body_recovery = None, None
        self._loss.seen_well(capture_ns)
        self._looking_since_ns = None

    def _follow(self, cloud: PointCloud, judged: PointCloud, capture_ns: int) -> FitArrays:
        """Velocity hypotheses on a tenth of the points, coarse then fine fit of the best, then what got lost."""
        fitter = self._fitter()
        frames_passed = float(np.clip((capture_ns - self._times_ns[0]) / FRAME_NS, 1.0, 4.0))
        plans = (GUESS, NOISY_COARSE, NOISY_FINE) if self._scale.noisy else (GUESS, COARSE, FINE)
        guess, coarse, fine = (plan._replace(step_scale=frames_passed) for plan in plans)
        some = thinned(cloud, GUESS_POINTS)
        guesses = self._predicted(capture_ns)
        fits = [fitter.fit(some, start, start, guess) for start in guesses]
        best = min(range(len(fits)), key=lambda k: fits[k].score)
        predicted = guesses[best]
        pose = fitter.move(thinned(cloud, COARSE_POINTS), fits[best].pose, predicted, coarse)
        return self._recovered(fitter.fit(judged, pose, predicted, fine), judged, fitter)

    def _recovered(self, fit: FitArrays, cloud: PointCloud, fitter: BodyFitter) -> FitArrays:
        """The fit, or a better one: one limb is looked for at a time, or else the whole body when it fits badly."""
        assert self._good is not None
        if fit.score > self._scale.bad:
            if self._body_recovery is None:
                self._body_recovery = BodyRecovery(self._good, self._frames)
            found = self._body_recovery.step(fit.pose, cloud, fitter)
            other = fitter.fit(cloud, found, found, FINE)
            if other.score < CLEARLY_BETTER * fit.score:
                fit = other
        else:
            self._body_recovery = None
        if self._limb_recovery is None:
            lost = next((limb for limb in self._limbs if self._is_lost(limb, fit, cloud)), None)
            if lost is None:
                return fit
            self._limb_recovery = LimbRecovery(lost, self._good, self._frames)
        recovery = self._limb_recovery
        pose = recovery.step(fit, cloud, fitter)
        if pose is not None:
            fit = fitter.fit(cloud, pose, pose, FINE)
        still_lost = self._is_lost(recovery.limb, fit, cloud)
        if recovery.ended and still_lost:
            self._retry_after[recovery.limb.links[1]] = self._frames + RETRY_FRAMES
        if recovery.ended or not still_lost:
            self._limb_recovery = None
        return fit

    def _predicted(self, capture_ns: int) -> list[PoseState]:
        assert self._state is not None
        axis = self._table.twist_axis
        return predicted_poses(self._state, self._before, self._times_ns, capture_ns, HYPOTHESES, axis)

    def _fitter(self) -> BodyFitter:
        return BodyFitter(self._known_body(), self._table)

    def _known_body(self) -> BodyModel:
        assert self._body is not None
        return self._body

    def _is_lost(self, limb: Limb, fit: FitArrays, cloud: PointCloud) -> bool:
        """Whether the limb explains much less than usual while points in its reach, which it could explain, are left
        over."""
        outer = limb.links[1:]
        usual = self._confidence.usual[outer].sum() * len(cloud)
        if fit.explained[outer].sum() > 0.4 * usual or self._frames < self._retry_after[outer[0]]:
            return False
        fitter = self._fitter()
        _, joints = forward(fit.pose.root, fit.pose.local, fitter.offsets, self._table.parents)
        left_over = within_reach(limb, joints, fitter.offsets, cloud) & (fit.owner < 0)
        return bool(left_over.sum() >= 0.4 * usual)

    def _accept(self, fit: FitArrays, cloud: PointCloud, judged: PointCloud, capture_ns: int) -> FitResult:
        """Takes the fit as the new state, lets the model learn from it, and says how it went; ``judged``: the points of
        the fit."""
        skeleton = self._known_body().skeleton
        rotations = quaternion.from_matrix(fit.pose.local)
        local = quaternion.to_matrix(rotations)  # rounding must not add up over frames
        if capture_ns > self._times_ns[0]:
            self._before, self._times_ns = self._state, (capture_ns, self._times_ns[0])
        self._state = PoseState(fit.pose.root, local)
        good = fit.score < self._scale.good
        if good:
            self._good = self._state
        pose = SkeletonPose(fit.pose.root, rotations, self._confidence.update(fit, len(fit.owner)))
        assert self._learning is not None
        building = self._learning.building(capture_ns)
        self._status = "tracking, learning the surface" if building else "tracking"
        if good:
            self._learning.frame(fit, pose, cloud, judged, capture_ns)
        self._result = FitResult(
            skeleton=skeleton,
            pose=pose,
            converged=fit.score < self._scale.lost,
            iterations=COARSE.iterations + FINE.iterations,
            inliers=fit.inliers,
            rms_m=fit.rms_m,
            confidence=self._scale.confidence(fit),
        )
        return self._result

    def _unseen(self) -> FitResult | None:
        """The last pose, not to be trusted; None when there never was one."""
        return None if self._result is None else untrusted(self._result)


GAUSS_NEWTON_ABLATIONS: dict[str, Callable[[BodyModel | None], GaussNewtonTracker]] = {
    "gauss-newton-colours": lambda body: GaussNewtonTracker(GaussNewtonSettings(match_colours=True), body),
}


def _state_of(pose: SkeletonPose) -> PoseState:
    return PoseState(pose.root_position.astype(np.float64), quaternion.to_matrix(pose.rotations.astype(np.float64)))
