"""ARTICP with global fitting as a tracker (Lien 2009 §5.1): the paper's method, kept beside the default one.

The model is the initial cloud, segmented by the skeleton it started with; each cloud is fitted from where the last one
was, without prediction. The paper starts by hand; here the start is given, or a person is looked for over frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_PARENTS, Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from sender.fitting.articp import CARRIER, LinkPoints, LinkState, articp, carriers_of, segmented
from sender.fitting.body_model import BodyModel
from sender.fitting.body_outline import NoPose
from sender.fitting.clustered_kdtree import ClusterBins, ClusteredKdTree, build_clustered_tree
from sender.fitting.global_fitting import GlobalFitting, LinkMoments, fit_globally, link_moments
from sender.fitting.initial_pose_search import InitialPoseSearch
from sender.fitting.link_icp import IcpStop, partner_distances
from sender.fitting.pose_prediction import LossTimer
from sender.fitting.tracker import MINIMUM_POINTS, FitResult, Tracker, untrusted

Array = NDArray[Any]

SKIN_M2 = 1.9  # of an adult: how far apart the points of a cloud lie
NEAR_M = 0.02  # a good fit is within this and the points' own spacing
ENOUGH = 0.5  # of the points a link had in the initial cloud: with fewer it is sure of less
JUDGED_POINTS = 500  # of the cloud, for the share that the model explains
ONE_CLUSTER = ClusterBins(1, 1, 1, 1)


@dataclass(frozen=True, slots=True)
class ArticpSettings:
    """``model_share``: of the initial cloud's points that become the model. The paper takes 25 % (synthetic) and 50 %
    (real) of about 10,000 points; a tracker here is given 2,500, already such a share. ``articulation``: links stay
    joined; ``global_fitting``: None for links on their own; ``stop``: τ of ICP; ``bins``: of the clustered tree.
    ``lost_confidence``: below it a person counts as lost, ``lost_s``: for this long before looking again."""

    model_share: float = 1.0
    articulation: bool = True
    global_fitting: GlobalFitting | None = field(default_factory=GlobalFitting)
    stop: IcpStop = field(default_factory=IcpStop)
    bins: ClusterBins = field(default_factory=ClusterBins)
    lost_confidence: float = 0.5
    lost_s: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.model_share <= 1:
            raise ValueError(f"model_share: {self.model_share} is outside 0..1")


@dataclass(frozen=True, slots=True, eq=False)
class _Person:
    """Who is followed: their sizes, P_S and μ(P_l)."""

    skeleton: Skeleton
    model: LinkPoints
    moments: LinkMoments
    fitted: Array  # (L,) bool: the links with points of their own


class ArticpTracker:
    """Implements ``Tracker``. It learns nothing after its first cloud, so there is no ``body`` to save."""

    def __init__(self, settings: ArticpSettings) -> None:
        self._settings = settings
        self._person: _Person | None = None
        self._state: LinkState | None = None
        self._result: FitResult | None = None
        self._loss = LossTimer(settings.lost_s)
        self._search = InitialPoseSearch()
        self._status = "looking for a person"

    @property
    def status(self) -> str:
        """What the tracker is doing, or why there is no pose yet, for the operator."""
        return self._status

    @property
    def body(self) -> BodyModel | None:
        """None: the model is one cloud."""
        return None

    def start_from(self, skeleton: Skeleton, pose: SkeletonPose, cloud: PointCloud, capture_ns: int) -> FitResult:
        """Starts with sizes and pose known from elsewhere and the cloud they belong to: the model (§5.1.1). A cloud of
        too few points is no model: the pose comes back at confidence 0, and the person is looked for."""
        if len(cloud) < MINIMUM_POINTS:
            self._status = f"{len(cloud)} points: nobody to start from"
            return untrusted(FitResult(skeleton, pose, False, 0, 0.0, 0.0, 0.0))
        T = forward_kinematics(skeleton, pose).astype(np.float64)
        state = LinkState(T[:, :3, :3], np.ascontiguousarray(T[:, :3, 3]))
        self._person = _person_of(cloud, skeleton, state, self._settings)
        self._loss.seen_well(capture_ns)
        self._search = InitialPoseSearch()
        return self._accept(cloud, state, build_clustered_tree(cloud, self._settings.bins), 0, capture_ns)

    def track(self, cloud: PointCloud, capture_ns: int) -> FitResult | None:
        """The pose in ``cloud``; with too few points the last pose at confidence 0, or None before the start."""
        if len(cloud) < MINIMUM_POINTS:
            self._status = f"{len(cloud)} points: nobody to see"
            return self._unseen()
        if self._state is None or self._person is None:
            return self._look(cloud, capture_ns)
        result = self._follow(self._person, self._state, cloud, capture_ns)
        if self._loss.lost(capture_ns):
            self._state = None
            self._status = "lost: looking for the person"
            return self._unseen()
        return result

    def _look(self, cloud: PointCloud, capture_ns: int) -> FitResult | None:
        found = self._search.step(cloud, capture_ns)
        if isinstance(found, NoPose):
            self._status = f"looking for a person: {found.reason}"
            return self._unseen()
        return self.start_from(found.skeleton, found.pose, cloud, capture_ns)

    def _follow(self, person: _Person, state: LinkState, cloud: PointCloud, capture_ns: int) -> FitResult:
        """Algorithm 5.1."""
        plan = self._settings
        tree = build_clustered_tree(cloud, plan.bins)
        state, iterations = articp(person.model, state, tree, person.fitted, plan.stop, plan.articulation)
        if plan.global_fitting is not None:
            fit = fit_globally(
                person.model, person.moments, person.skeleton, cloud, state, plan.bins, plan.stop, plan.articulation,
                plan.global_fitting,
            )  # fmt: skip
            state, iterations = fit.state, iterations + fit.iterations
        return self._accept(cloud, state, tree, iterations, capture_ns)

    def _accept(
        self, cloud: PointCloud, state: LinkState, tree: ClusteredKdTree, iterations: int, capture_ns: int
    ) -> FitResult:
        """Takes the pose as the new state and says how it went."""
        assert self._person is not None
        person = self._person
        skeleton, pose, self._state = _pose_of(person.skeleton, state, self._settings.articulation)
        share = _link_confidence(person, self._state, cloud, tree)
        explained = _distances_to_model(cloud, person.model, self._state, _near_m(len(person.model.points)))
        inlier = np.isfinite(explained)
        seen = float(np.average(share, weights=np.diff(person.model.first)))
        confidence = seen * float(inlier.mean())
        self._status = "tracking"
        if confidence >= self._settings.lost_confidence:
            self._loss.seen_well(capture_ns)
        else:
            self._status = f"unsure: {seen:.0%} of the model and {inlier.mean():.0%} of the points fit"
        self._result = FitResult(
            skeleton=skeleton,
            pose=SkeletonPose(pose.root_position, pose.rotations, _down_the_tree(share)),
            converged=confidence >= self._settings.lost_confidence,
            iterations=iterations,
            inliers=float(inlier.mean()),
            rms_m=float(np.sqrt(np.mean(explained[inlier] ** 2))) if inlier.any() else 0.0,
            confidence=confidence,
        )
        return self._result

    def _unseen(self) -> FitResult | None:
        """The last pose, not to be trusted; None when there never was one."""
        return None if self._result is None else untrusted(self._result)


ARTICP_ABLATIONS: dict[str, Callable[[BodyModel | None], Tracker]] = {
    "articp-no-global": lambda _: ArticpTracker(ArticpSettings(global_fitting=None)),
    "articp-no-articulation": lambda _: ArticpTracker(ArticpSettings(articulation=False)),
    "articp-no-constraints": lambda _: ArticpTracker(ArticpSettings(articulation=False, global_fitting=None)),
}


def _person_of(cloud: PointCloud, skeleton: Skeleton, state: LinkState, settings: ArticpSettings) -> _Person:
    count = max(round(settings.model_share * len(cloud)), 1)
    chosen = np.random.default_rng(0).permutation(len(cloud))[:count]
    some = PointCloud(cloud.positions[chosen], cloud.normals[chosen], cloud.colours[chosen])
    model = segmented(some, skeleton, state, settings.bins)
    moments = link_moments(segmented(cloud, skeleton, state, settings.bins))
    return _Person(skeleton, model, moments, np.diff(model.first) > 0)


def _pose_of(skeleton: Skeleton, state: LinkState, jointed: bool) -> tuple[Skeleton, SkeletonPose, LinkState]:
    """Sizes, pose, and the state again with clean rotations: rounding must not add up over frames. Links that came
    apart have other offsets than the skeleton's."""
    R = quaternion.to_matrix(quaternion.from_matrix(state.rotations))
    parents = np.array(LINK_PARENTS[1:])
    above = np.swapaxes(R[parents], 1, 2)
    local = np.concatenate([R[:1], above @ R[1:]])
    if not jointed:
        offsets = np.zeros((LINK_COUNT, 3))
        offsets[1:] = np.einsum("lij,lj->li", above, state.joints[1:] - state.joints[parents])
        skeleton = Skeleton(offsets.astype(np.float32), skeleton.tips, skeleton.radii)
    rotations = quaternion.from_matrix(local).astype(np.float32)
    pose = SkeletonPose(state.joints[0].astype(np.float32), rotations, np.ones(LINK_COUNT, np.float32))
    return skeleton, pose, LinkState(R, state.joints)


def _near_m(count: int) -> float:
    return NEAR_M + float(np.sqrt(SKIN_M2 / max(count, 1)))


def _link_confidence(person: _Person, state: LinkState, cloud: PointCloud, tree: ClusteredKdTree) -> Array:
    """For each link (L,) the share of its points with a partner near by, less where it claims too few of the cloud's
    points: a limb out of sight folds onto what is there, and every one of its points finds a partner."""
    points, normals = person.model.posed(state)
    near = np.isfinite(partner_distances(points, normals, person.model.colours, tree, _near_m(len(cloud))))
    counts = np.diff(person.model.first)
    links = np.repeat(np.arange(LINK_COUNT), counts)
    share = np.bincount(links, near, LINK_COUNT) / np.maximum(counts, 1)
    claimed = np.bincount(carriers_of(cloud.positions, person.skeleton, state), minlength=LINK_COUNT)
    usual = counts * len(cloud) / len(points)
    return np.asarray(share * np.minimum(claimed / np.maximum(ENOUGH * usual, 1.0), 1.0))


def _down_the_tree(share: Array) -> Array:
    """Confidence (L,) float32 of all links: a link is no surer than the one it hangs from."""
    confidence = share[CARRIER]
    for link in range(1, LINK_COUNT):
        confidence[link] = min(confidence[link], confidence[LINK_PARENTS[link]])
    return np.asarray(confidence, np.float32)


def _distances_to_model(cloud: PointCloud, model: LinkPoints, state: LinkState, near_m: float) -> Array:
    """Distances (≤ JUDGED_POINTS,) [m] of some of the cloud's points to the posed model's nearest point, infinity
    where it is not within ``near_m``."""
    points, normals = model.posed(state)
    posed = PointCloud(points.astype(np.float32), normals.astype(np.float32), np.zeros(points.shape, np.uint8))
    tree = build_clustered_tree(posed, ONE_CLUSTER)
    every = slice(None, None, -(-len(cloud) // JUDGED_POINTS))
    some, at = cloud.positions[every].astype(np.float64), cloud.normals[every].astype(np.float64)
    return partner_distances(some, at, np.zeros(len(some), np.int64), tree, near_m)
