"""The sender on one page: from a set of depth frames to a skeleton packet, and, behind it, to candidate poses.

The two paths are DISPOSE Fig. 1: ``SkeletonPath`` runs for every frame and never waits for ``CandidatePath``.
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
from sender.candidate_poses.usable_pose_set import UsablePoseSet, UsablePoseSettings
from sender.capture.frame_set import FrameSet
from sender.config import CandidateSettings
from sender.fitting.outside_tracker import OutsideTracker
from sender.fitting.start_joints import skeleton_from_joints
from sender.fitting.tracker import MINIMUM_POINTS, FitResult, Tracker
from sender.reconstruction.person_points import Reconstruction

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
    their forward kinematics. ``complete``: no camera's frame was missing."""

    capture_ns: int
    views: tuple[View, ...]
    fit: FitResult | None
    packet: bytes | None = None
    body: bytes | None = None
    skeleton: Skeleton | None = None
    pose: SkeletonPose | None = None
    T_world_link: NDArray[np.float32] | None = None
    complete: bool = True


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
        self._sequence += 1
        self._previous = (capture_ns, fit.pose)
        T_world_link = forward_kinematics(body, pose)
        self._last_joints = T_world_link[:, :3, 3] if fit.confidence > 0 else None
        complete = None not in frames.frames
        return TrackedFrame(capture_ns, views, fit, packet, message, body, pose, T_world_link, complete)

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
    """What one captured frame changed: the new pose as sent, its χ, and χ and retained flags of the usable pose set."""

    pose_id: int
    encoded: bytes
    capture_ns: int
    chi: dict[int, float]
    retained: frozenset[int]


class CandidatePath:
    """Some frames: views → rigged mesh → usable pose set and rigging quotients. ``process`` is one thread's own;
    ``remember`` and ``note_sent`` may be called from another."""

    def __init__(self, identity: StreamIdentity, settings: CandidateSettings, timer: StageTimer) -> None:
        self._identity = identity
        self._settings = settings
        self._timer = timer
        self._usable = UsablePoseSet(region_weights=region_weights(settings.region_weights))
        self._poses = 0
        self._skeletons: deque[tuple[int, NDArray[np.float32]]] = deque(maxlen=UsablePoseSettings().max_skeletons)
        self._sent: deque[tuple[int, float]] = deque(maxlen=UsablePoseSettings().max_poses)

    def may_become_one(self, tracked: TrackedFrame) -> bool:
        """Whether a frame is fit to become a candidate pose: somebody is seen, by every camera that is there, and the
        skeleton is not doubtful."""
        fit = tracked.fit
        seen = bool(tracked.views) and tracked.complete
        return seen and fit is not None and fit.confidence >= self._settings.least_confidence

    def remember(self, tracked: TrackedFrame) -> None:
        """A skeleton was sent: candidate poses are judged by how many of those they animate."""
        if tracked.T_world_link is not None:
            self._skeletons.append((tracked.capture_ns, tracked.T_world_link))

    def note_sent(self, pose_id: int, retain_threshold: float) -> None:
        """A pose went out to a receiver, when RT was ``retain_threshold``."""
        self._sent.append((pose_id, retain_threshold))

    def process(self, tracked: TrackedFrame) -> Candidates:
        """Make a candidate pose of a frame that may become one.

        The mesh is built from the encoded views, as the receiver will build it, so both ends judge the same one.
        """
        with self._timer.stage("encode views"):
            encoded = self._encode(tracked)
        with self._timer.stage("candidate mesh"):
            candidate = decode_candidate_pose(encoded)
            mesh = build_rigged_mesh(
                candidate.pose_id,
                candidate.capture_ns,
                candidate.skeleton,
                candidate.pose,
                candidate.views,
                candidate.rigging,
                self._settings.score_form,
            )
        with self._timer.stage("usable poses"):
            while self._sent:
                self._usable.sent(*self._sent.popleft())
            while self._skeletons:
                self._usable.add_skeleton(*self._skeletons.popleft())
            self._usable.add_pose(mesh)
            chi, retained = self._usable.quotients(), self._usable.retained()
        return Candidates(candidate.pose_id, encoded, candidate.capture_ns, chi, retained)

    def _encode(self, tracked: TrackedFrame) -> bytes:
        assert tracked.skeleton is not None
        assert tracked.fit is not None
        identity, settings = self._identity, self._settings
        self._poses += 1
        candidate = CandidatePose(
            pose_id=self._poses,
            person=identity.person,
            epoch=identity.epoch,
            capture_ns=tracked.capture_ns,
            skeleton=tracked.skeleton,
            pose=tracked.fit.pose,  # not the quantised one: rounding twice could end elsewhere than the packet's
            views=tracked.views,
            rigging=Rigging(settings.segmentation),
        )
        return encode_candidate_pose(candidate, settings.jpeg_quality, settings.depth_step_mm)


def _largest_change_m(a: Skeleton, b: Skeleton) -> float:
    pairs = ((a.offsets, b.offsets), (a.tips, b.tips), (a.radii, b.radii))
    return max(float(np.abs(x - y).max()) for x, y in pairs)
