"""The sender on one page: from a set of depth frames to a skeleton packet, and, behind it, to candidate poses.

The two paths are DISPOSE Fig. 1: ``SkeletonPath`` runs for every frame and never waits for ``CandidatePath``, nor for
the third layer, ``ResidualPath`` (``residual_path.py``).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from common.body.body_regions import region_weights
from common.body.rigged_mesh import build_rigged_mesh
from common.body.rigging import Rigging
from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.body.view import View
from common.geometry.point_cloud import PointCloud
from common.runtime.clock import Clock
from common.runtime.stage_timer import StageTimer
from common.wire.body_message import BodyMessage, encode_body, quantized_skeleton
from common.wire.candidate_pose import CandidatePose, decode_candidate_pose, encode_candidate_pose
from common.wire.skeleton_packet import SkeletonPacket, encode_skeleton, quantized_pose
from sender.candidate_poses.pose_coverage import Coverage, CoverageSet
from sender.candidate_poses.preview import encode_preview
from sender.candidate_poses.usable_pose_set import Quotients, UsablePoseSet
from sender.capture.frame_set import FrameSet
from sender.config import CandidateSettings
from sender.fitting.outside_tracker import OutsideTracker
from sender.fitting.start_joints import skeleton_from_joints
from sender.fitting.tracker import MINIMUM_POINTS, FitResult, Tracker
from sender.reconstruction.depth_fusion import DepthFusion, PosedViews
from sender.reconstruction.outline import completed
from sender.reconstruction.person_points import Reconstruction

FINE_BYTES = 80_000  # of a pose sent finely, before one was
THIN_S = 0.5  # a link is thin if a fine pose takes longer
SKELETONS_WAITING, SENDS_WAITING = 300, 64  # for the next candidate pose
BODY_CHANGE_M = 0.001  # sizes that differ by less are the same body to a receiver


@dataclass(frozen=True, slots=True)
class StreamIdentity:
    """What every message says of itself: person, and the sender's run (epoch)."""

    person: int
    epoch: int


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """One frame set after the fast path. ``packet`` is None while nobody has been found. ``body``: a new body message
    to publish before the packet. ``skeleton``, ``pose``: as the receiver will decode them; ``T_world_link`` (L, 4, 4):
    their forward kinematics. ``complete``: no camera's frame was missing. ``sequence``, ``body_revision``: the
    packet's."""

    capture_ns: int
    views: tuple[View, ...]
    fit: FitResult | None
    packet: bytes | None = None
    body: bytes | None = None
    skeleton: Skeleton | None = None
    pose: SkeletonPose | None = None
    T_world_link: NDArray[np.float32] | None = None
    complete: bool = True
    sequence: int = 0
    body_revision: int = 0


class SkeletonPath:
    """Every frame: the person's points → pose → packet, or the sensors' skeletons → pose (``outside``) → packet."""

    def __init__(
        self,
        identity: StreamIdentity,
        reconstruction: Reconstruction,
        tracker: Tracker,
        frame_rate_hz: float,
        timer: StageTimer,
        clock: Clock,
        start_joints: NDArray[np.floating] | None = None,
        outside: OutsideTracker | None = None,
    ) -> None:
        self._identity = identity
        self._reconstruction = reconstruction
        self._tracker = tracker
        self._frame_rate_hz = frame_rate_hz
        self._timer = timer
        self._clock = clock
        self._start_joints = start_joints
        self._outside = outside
        self._sequence = 0
        self._revision = 0
        self._body: Skeleton | None = None
        self._previous: tuple[int, SkeletonPose] | None = None
        self._last_joints: NDArray[np.float32] | None = None

    def process(self, frames: FrameSet) -> TrackedFrame:
        """Fit the person in one frame set."""
        if self._outside is not None:
            return self._process_skeletons(self._outside, frames)
        person = self._reconstruction.person(frames, self._last_joints, self._timer)
        with self._timer.stage("fitting"):
            fit = self._fit(person.cloud, frames.capture_ns)
        if fit is None:
            return TrackedFrame(frames.capture_ns, person.views, None)
        if person.certainty < 1:  # a ghost's joints are as doubtful as the ghost
            doubted = (fit.pose.confidence * person.certainty).astype(np.float32)
            pose = SkeletonPose(fit.pose.root_position, fit.pose.rotations, doubted)
            fit = replace(fit, pose=pose, confidence=fit.confidence * person.certainty)
        with self._timer.stage("packet"):
            return self._pack(frames, person.views, fit)

    def _process_skeletons(self, outside: OutsideTracker, frames: FrameSet) -> TrackedFrame:
        with self._timer.stage("fitting"):
            fit = outside.track(frames.skeletons)
        if fit is None:
            return TrackedFrame(frames.capture_ns, (), None)
        with self._timer.stage("packet"):
            return self._pack(frames, (), fit)

    def _fit(self, cloud: PointCloud, capture_ns: int) -> FitResult | None:
        if self._start_joints is None or len(cloud) < MINIMUM_POINTS:
            return self._tracker.track(cloud, capture_ns)
        skeleton, pose = skeleton_from_joints(self._start_joints)
        self._start_joints = None
        return self._tracker.start_from(skeleton, pose, cloud, capture_ns)

    def _pack(self, frames: FrameSet, views: tuple[View, ...], fit: FitResult) -> TrackedFrame:
        capture_ns = frames.capture_ns
        body, message = self._current_body(fit.skeleton)
        pose = quantized_pose(fit.pose)
        age_ns, previous = (0, None) if self._previous is None else (capture_ns - self._previous[0], self._previous[1])
        packet = encode_skeleton(
            SkeletonPacket(
                person=self._identity.person,
                epoch=self._identity.epoch,
                sequence=self._sequence,
                capture_ns=capture_ns,
                body_revision=self._revision,
                fit_confidence=fit.confidence,
                pose=fit.pose,
                previous=previous,
                previous_age_ns=age_ns,
                send_delay_ns=self._clock.now_ns() - capture_ns,
            )
        )
        sequence, self._sequence = self._sequence, self._sequence + 1
        self._previous = (capture_ns, fit.pose)
        T_world_link = forward_kinematics(body, pose)
        self._last_joints = T_world_link[:, :3, 3] if fit.confidence > 0 else None
        complete = None not in frames.frames
        return TrackedFrame(
            capture_ns, views, fit, packet, message, body, pose, T_world_link, complete, sequence, self._revision
        )

    def _current_body(self, found: Skeleton) -> tuple[Skeleton, bytes | None]:
        """The body the receiver holds, and the message that tells it when it changed."""
        if self._body is not None and _largest_change_m(self._body, found) < BODY_CHANGE_M:
            return self._body, None
        self._body = quantized_skeleton(found)
        self._revision = (self._revision + 1) % 256
        identity = self._identity
        message = BodyMessage(identity.person, identity.epoch, self._revision, self._body, self._frame_rate_hz)
        return self._body, encode_body(message)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """What one captured frame changed: the new pose as sent, its small ``preview``, and what the poses are worth."""

    pose_id: int
    encoded: bytes
    preview: bytes
    capture_ns: int
    worth: Quotients | Coverage


class CandidatePath:
    """Some frames: views → rigged mesh → what it is worth sending. ``process`` is one thread's own; ``remember`` and
    ``note_sent`` may be called from another."""

    def __init__(self, identity: StreamIdentity, settings: CandidateSettings, timer: StageTimer) -> None:
        self._identity = identity
        self._settings = settings
        self._timer = timer
        weights = region_weights(settings.region_weights)
        self._choice: UsablePoseSet | CoverageSet = (
            UsablePoseSet(region_weights=weights) if settings.choice == "paper" else CoverageSet(region_weights=weights)
        )
        self._poses = 0
        self._budget_bytes: int | None = None
        self._fine_bytes = FINE_BYTES
        self._skeletons: deque[tuple[int, NDArray[np.float32]]] = deque(maxlen=SKELETONS_WAITING)
        self._fusion = DepthFusion(settings.fused_frames)
        self._seen: deque[PosedViews] = deque(maxlen=settings.fused_frames + 1)
        self._sent: deque[tuple[int, float]] = deque(maxlen=SENDS_WAITING)

    def may_become_one(self, tracked: TrackedFrame) -> bool:
        """Whether a frame is fit to become a candidate pose: somebody is seen, by every camera that is there, and the
        skeleton is not doubtful."""
        fit = tracked.fit
        seen = bool(tracked.views) and tracked.complete
        return seen and fit is not None and fit.confidence >= self._settings.least_confidence

    def remember(self, tracked: TrackedFrame) -> None:
        """A skeleton was sent: candidate poses are judged by how many of those they animate. Doubtful ones do not
        count: no pose should be sought for what the person never did."""
        fit = tracked.fit
        if tracked.T_world_link is not None and fit is not None and fit.confidence >= self._settings.least_confidence:
            self._skeletons.append((tracked.capture_ns, tracked.T_world_link))
            self._seen.append(PosedViews(tracked.capture_ns, tracked.views, tracked.T_world_link))

    def note_budget(self, bytes_per_s: int | None) -> None:
        """What the thinnest link to a receiver can carry; None while there is none."""
        self._budget_bytes = bytes_per_s

    def note_sent(self, pose_id: int, retain_threshold: float) -> None:
        """A whole pose went out to a receiver, when RT was ``retain_threshold``."""
        self._sent.append((pose_id, retain_threshold))

    def process(self, tracked: TrackedFrame) -> Candidates:
        """Make a candidate pose of a frame that may become one.

        The mesh is built from the encoded views, as the receiver will build it, so both ends judge the same one.
        """
        with self._timer.stage("depth fusion"):
            views = self._fused(tracked)
        with self._timer.stage("encode views"):
            candidate = self._candidate(tracked, views)
            encoded = self._encode(candidate)
            preview = encode_preview(candidate)
        with self._timer.stage("candidate mesh"):
            decoded = decode_candidate_pose(encoded)
            mesh = build_rigged_mesh(
                decoded.pose_id,
                decoded.capture_ns,
                decoded.skeleton,
                decoded.pose,
                decoded.views,
                decoded.rigging,
                self._settings.score_form,
            )
        with self._timer.stage("usable poses"):
            while self._sent:
                self._choice.sent(*self._sent.popleft())
            while self._skeletons:
                self._choice.add_skeleton(*self._skeletons.popleft())
            self._choice.add_pose(mesh)
            worth = self._choice.worth()
        return Candidates(candidate.pose_id, encoded, preview, candidate.capture_ns, worth)

    def _encode(self, candidate: CandidatePose) -> bytes:
        """The pose as finely as its link allows: where it takes long, more poses are worth more than finer ones."""
        settings, budget_bytes = self._settings, self._budget_bytes
        thin = budget_bytes is not None and self._fine_bytes > budget_bytes * THIN_S
        if thin:
            return encode_candidate_pose(candidate, settings.thin_quality)
        encoded = encode_candidate_pose(candidate, settings.quality)
        self._fine_bytes = len(encoded)
        return encoded

    def _fused(self, tracked: TrackedFrame) -> tuple[View, ...]:
        """The frame's views, their outlines completed by colour and their depth averaged with the last frames'."""
        while self._seen:
            self._fusion.remember(self._seen.popleft())
        assert tracked.skeleton is not None
        assert tracked.T_world_link is not None
        views = tuple(completed(view) for view in tracked.views)
        posed = PosedViews(tracked.capture_ns, views, tracked.T_world_link)
        return self._fusion.fused(posed, tracked.skeleton)

    def _candidate(self, tracked: TrackedFrame, views: tuple[View, ...]) -> CandidatePose:
        assert tracked.skeleton is not None
        assert tracked.fit is not None
        self._poses += 1
        return CandidatePose(
            pose_id=self._poses,
            person=self._identity.person,
            epoch=self._identity.epoch,
            capture_ns=tracked.capture_ns,
            skeleton=tracked.skeleton,
            pose=tracked.fit.pose,  # not the quantised one: rounding twice could end elsewhere than the packet's
            views=views,
            rigging=Rigging(self._settings.segmentation, self._settings.views),
        )


def _largest_change_m(a: Skeleton, b: Skeleton) -> float:
    pairs = ((a.offsets, b.offsets), (a.tips, b.tips), (a.radii, b.radii))
    return max(float(np.abs(x - y).max()) for x, y in pairs)
