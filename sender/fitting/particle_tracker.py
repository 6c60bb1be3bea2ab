"""A pose tracker on ellipsoids and particles: for clouds without normals, colours or details to learn a surface from.

Every frame: the last motion goes on, the annealed particle filter searches around it part by part, and Gauss–Newton
on the ellipsoids brings what was found onto the cloud. A person of whom only the upper body shows at the start is
followed without legs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX, SIDES, Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from sender.fitting.annealed_particle_filter import AnnealingSettings
from sender.fitting.articulated_gauss_newton import PoseState, Schedule
from sender.fitting.body_model import BodyModel
from sender.fitting.body_outline import NoPose
from sender.fitting.initial_pose import find_initial_pose
from sender.fitting.initial_pose_search import InitialPoseSearch
from sender.fitting.joint_limits import joint_table
from sender.fitting.limb_search import thinned
from sender.fitting.particle_weights import ParticleWeights, numba_weights
from sender.fitting.pose_prediction import FRAME_NS, LossTimer, predicted_poses
from sender.fitting.tracker import MINIMUM_POINTS, FitResult, untrusted
from sender.fitting.whole_body_ellipsoids import Ellipsoids, whole_body_ellipsoids
from sender.fitting.whole_body_fit import EllipsoidFit, fit_ellipsoids, judge_ellipsoids
from sender.fitting.whole_body_particles import EXPECTED, WholeBodyParticles

Array = NDArray[Any]

SEARCH_POINTS, FIT_POINTS = 600, 1250
HYPOTHESES = (1.0, 0.0)  # shares of the last velocity
COARSE = Schedule(3, 0.20, 0.10, 0.0, 1.0, 1.0)
FINE = Schedule(4, 0.12, 0.08, 0.0, 1.0, 1.0)
CLEARLY_BETTER = 0.96  # cost of the particles' pose over that of plain motion: ghosts of a hull are no reason to jump
GUESS_AFTER_S = 1.5
FEW_POINTS = 6.0  # an ellipsoid with fewer is not seen
_LEGS = tuple(LINK_INDEX[f"{side}_{part}"] for side in SIDES for part in ("thigh", "shin", "foot"))
_FILLED_WITH = tuple(  # one ellipsoid for both
    (LINK_INDEX[f"{side}_{tip}"], LINK_INDEX[f"{side}_{link}"])
    for side in SIDES
    for tip, link in (("fingers", "hand"), ("toes", "foot"))
)
_HELD_BY = (  # joints that particles do not turn
    (LINK_INDEX["lower_spine"], LINK_INDEX["pelvis"]),
    (LINK_INDEX["neck"], LINK_INDEX["upper_spine"]),
    *(
        (LINK_INDEX[f"{side}_{link}"], LINK_INDEX[leader if leader == "upper_spine" else f"{side}_{leader}"])
        for side in SIDES
        for link, leader in (("clavicle", "upper_spine"), ("hand", "forearm"), ("fingers", "forearm"), ("toes", "foot"))
    ),
)


@dataclass(frozen=True, slots=True)
class ParticleSettings:
    """``annealing``: of each part. ``lost_score``: robust cost per point (0..1) above which the person counts as lost,
    ``lost_s``: for this long before looking again."""

    annealing: AnnealingSettings = field(default_factory=AnnealingSettings)
    lost_score: float = 0.45
    lost_s: float = 1.0


class ParticleTracker:
    """Implements ``Tracker``. ``weights``: on which device particles are weighed."""

    def __init__(self, settings: ParticleSettings, weights: ParticleWeights = numba_weights) -> None:
        self._weights, self._settings = weights, settings
        self._table = joint_table()
        self._skeleton: Skeleton | None = None
        self._search = InitialPoseSearch()
        self._looking_since_ns: int | None = None
        self._status = "looking for a person"
        self._result: FitResult | None = None
        self._loss = LossTimer(settings.lost_s)

    @property
    def status(self) -> str:
        """What the tracker is doing, or why there is no pose yet, for the operator."""
        return self._status

    @property
    def body(self) -> BodyModel | None:
        """Always None: ellipsoids come from the sizes, no surface is learned."""
        return None

    def start_from(self, skeleton: Skeleton, pose: SkeletonPose, cloud: PointCloud, capture_ns: int) -> FitResult:
        """Starts with sizes and pose known from elsewhere. Legs with confidence 0 are left out from then on."""
        ellipsoids = whole_body_ellipsoids(skeleton)
        if not pose.confidence[list(_LEGS)].any():
            shown = ~np.isin(ellipsoids.links, _LEGS)
            ellipsoids = Ellipsoids(*(array[shown] for array in ellipsoids))
        self._skeleton, self._ellipsoids = skeleton, ellipsoids
        self._looking_since_ns = None
        self._offsets = skeleton.offsets.astype(np.float64)
        self._particles = WholeBodyParticles(skeleton, ellipsoids, self._table, self._weights, self._settings.annealing)
        state = PoseState(
            pose.root_position.astype(np.float64), quaternion.to_matrix(pose.rotations.astype(np.float64))
        )
        self._state: PoseState | None = state
        self._before = state
        self._times_ns = (capture_ns, capture_ns)
        self._loss.seen_well(capture_ns)
        self._usual = np.zeros(len(ellipsoids.links))
        self._confidence = pose.confidence
        return self._accept(self._polished(cloud, state, state, FINE), cloud, capture_ns)

    def track(self, cloud: PointCloud, capture_ns: int) -> FitResult | None:
        """The pose in ``cloud``; with too few points the last pose at confidence 0, or None before the start."""
        if len(cloud) < MINIMUM_POINTS:
            self._status = f"{len(cloud)} points: nobody to see"
            self._looking_since_ns = None
            if self._loss.lost(capture_ns):
                self._skeleton = None  # who comes next may be somebody else
            return self._unseen()
        if self._skeleton is None:
            return self._look(cloud, capture_ns)
        fit = self._follow(thinned(cloud, FIT_POINTS), capture_ns)
        if fit.score < self._settings.lost_score:
            self._loss.seen_well(capture_ns)
        elif self._loss.lost(capture_ns):
            self._skeleton = None
            self._status = "lost: looking for the person"
            return self._unseen()
        return self._accept(fit, cloud, capture_ns)

    def _look(self, cloud: PointCloud, capture_ns: int) -> FitResult | None:
        """The search over frames where normals tell sides apart; else, or after a while, the best guess there is: a
        hull's ghosts keep the search from ever being certain."""
        if self._looking_since_ns is None:
            self._looking_since_ns, self._search = capture_ns, InitialPoseSearch()
        found = self._search.step(cloud, capture_ns) if cloud.normals.any() else find_initial_pose(cloud)
        if isinstance(found, NoPose) and capture_ns - self._looking_since_ns > GUESS_AFTER_S * 1e9:
            found = find_initial_pose(cloud)
        if isinstance(found, NoPose):
            self._status = f"looking for a person: {found.reason}"
            return self._unseen()
        return self.start_from(found.skeleton, found.pose, cloud, capture_ns)

    def _follow(self, cloud: PointCloud, capture_ns: int) -> EllipsoidFit:
        """The best of the velocity hypotheses, then particles around it; the better of both."""
        frames_passed = float(np.clip((capture_ns - self._times_ns[0]) / FRAME_NS, 1.0, 4.0))
        coarse, fine = (plan._replace(step_scale=frames_passed) for plan in (COARSE, FINE))
        some = thinned(cloud, SEARCH_POINTS)
        guesses = self._predicted(capture_ns)
        fits = [self._polished(some, guess, guess, coarse) for guess in guesses]
        best = min(range(len(fits)), key=lambda k: self._cost(fits[k], some))
        predicted = guesses[best]
        searched = self._particles.search(some, fits[best].pose, self._usual, self._confidence, frames_passed)
        stayed, moved = (self._polished(cloud, start, predicted, fine) for start in (fits[best].pose, searched))
        return moved if self._cost(moved, cloud) < CLEARLY_BETTER * self._cost(stayed, cloud) else stayed

    def _predicted(self, capture_ns: int) -> list[PoseState]:
        assert self._state is not None
        axis = self._table.twist_axis
        return predicted_poses(self._state, self._before, self._times_ns, capture_ns, HYPOTHESES, axis)

    def _polished(self, cloud: PointCloud, start: PoseState, predicted: PoseState, plan: Schedule) -> EllipsoidFit:
        points, normals = cloud.positions, cloud.normals
        pose = fit_ellipsoids(points, normals, start, predicted, self._offsets, self._ellipsoids, self._table, plan)
        return judge_ellipsoids(points, normals, pose, self._offsets, self._ellipsoids, self._table.parents)

    def _cost(self, fit: EllipsoidFit, cloud: PointCloud) -> float:
        """Two-sided, as the particles' weight: points nothing explains, and ellipsoids that explain too little."""
        missing = np.maximum(EXPECTED * self._usual - fit.explained / len(cloud), 0.0).sum()
        return float(fit.score + missing)

    def _accept(self, fit: EllipsoidFit, cloud: PointCloud, capture_ns: int) -> FitResult:
        assert self._skeleton is not None
        rotations = quaternion.from_matrix(fit.pose.local)
        if capture_ns > self._times_ns[0] and self._state is not None:
            self._before, self._times_ns = self._state, (capture_ns, self._times_ns[0])
        self._state = PoseState(fit.pose.root, quaternion.to_matrix(rotations))
        share = fit.explained / max(len(fit.owner), 1)
        self._usual = np.where(share > self._usual, share, self._usual + 0.02 * (share - self._usual))
        self._confidence = self._link_confidence(fit, cloud)
        lost = self._settings.lost_score
        self._status = "tracking"
        self._result = FitResult(
            skeleton=self._skeleton,
            pose=SkeletonPose(fit.pose.root, rotations, self._confidence),
            converged=fit.score < lost,
            iterations=COARSE.iterations + FINE.iterations,
            inliers=fit.inliers,
            rms_m=fit.rms_m,
            confidence=float(np.clip((lost - fit.score) / lost * 1.25, 0.0, 1.0)),
        )
        return self._result

    def _link_confidence(self, fit: EllipsoidFit, cloud: PointCloud) -> Array:
        """How well each link's ellipsoid is filled, times how surely its joint is held there; a link that particles do
        not turn goes with the one before or behind it."""
        enough = np.maximum(EXPECTED * self._usual * len(fit.owner), FEW_POINTS)
        filled = np.zeros(LINK_COUNT)
        filled[self._ellipsoids.links] = np.clip(fit.explained / enough, 0.0, 1.0)
        certain = self._particles.certainty(thinned(cloud, SEARCH_POINTS), fit.pose)
        for link, leader in _HELD_BY:
            certain[link] = certain[leader]
        for link, leader in _FILLED_WITH:
            filled[link] = filled[leader]
        return (filled * certain).astype(np.float32)

    def _unseen(self) -> FitResult | None:
        """The last pose, not to be trusted; None when there never was one."""
        return None if self._result is None else untrusted(self._result)
