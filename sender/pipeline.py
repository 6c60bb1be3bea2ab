"""The sender on one page: from a set of depth frames to a skeleton packet, and, behind it, to candidate poses.

The two paths are DISPOSE Fig. 1: ``SkeletonPath`` runs for every frame and never waits for ``CandidatePath``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.body.view import View
from common.geometry.camera_model import Camera
from common.runtime.stage_timer import StageTimer
from common.wire.body_message import BodyMessage, encode_body, quantized_skeleton
from common.wire.skeleton_packet import SkeletonPacket, encode_skeleton, quantized_pose
from sender.capture.frame_set import FrameSet
from sender.fitting.tracker import FitResult, Tracker
from sender.reconstruction.background import BackgroundModel
from sender.reconstruction.foreground_points import PointSampler

BODY_CHANGE_M = 0.001  # sizes that differ by less are the same body to a receiver


@dataclass(frozen=True, slots=True)
class StreamIdentity:
    """What every message says of itself: person, and the sender's run (epoch)."""

    person: int
    epoch: int


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """One frame set after the fast path. ``packet`` is None while nobody has been found. ``body``: a new body message
    to publish before the packet. ``skeleton``, ``pose``: as the receiver will decode them."""

    capture_ns: int
    views: tuple[View, ...]
    fit: FitResult | None
    packet: bytes | None = None
    body: bytes | None = None
    skeleton: Skeleton | None = None
    pose: SkeletonPose | None = None


class SkeletonPath:
    """Every frame: background → points → pose → packet."""

    def __init__(
        self,
        identity: StreamIdentity,
        cameras: Sequence[Camera],
        backgrounds: Sequence[BackgroundModel],
        sampler: PointSampler,
        tracker: Tracker,
        frame_rate_hz: float,
        timer: StageTimer,
    ) -> None:
        self._identity = identity
        self._cameras = cameras
        self._backgrounds = backgrounds
        self._sampler = sampler
        self._tracker = tracker
        self._frame_rate_hz = frame_rate_hz
        self._timer = timer
        self._sequence = 0
        self._revision = 0
        self._body: Skeleton | None = None
        self._previous: tuple[int, SkeletonPose] | None = None

    def process(self, frames: FrameSet) -> TrackedFrame:
        """Fit the person in one frame set."""
        with self._timer.stage("background"):
            views = self._views(frames)
        with self._timer.stage("points"):
            cloud = self._sampler.points(views)
        with self._timer.stage("fitting"):
            fit = self._tracker.track(cloud, frames.capture_ns)
        if fit is None:
            return TrackedFrame(frames.capture_ns, views, None)
        with self._timer.stage("packet"):
            return self._pack(frames.capture_ns, views, fit)

    def _views(self, frames: FrameSet) -> tuple[View, ...]:
        pairs = zip(self._backgrounds, frames.frames, strict=True)
        views = (background.foreground(frame) for background, frame in pairs if frame is not None)
        return tuple(view for view in views if view is not None)

    def _pack(self, capture_ns: int, views: tuple[View, ...], fit: FitResult) -> TrackedFrame:
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
            )
        )
        self._sequence += 1
        self._previous = (capture_ns, fit.pose)
        return TrackedFrame(capture_ns, views, fit, packet, message, body, pose)

    def _current_body(self, found: Skeleton) -> tuple[Skeleton, bytes | None]:
        """The body the receiver holds, and the message that tells it when it changed."""
        if self._body is not None and _largest_change_m(self._body, found) < BODY_CHANGE_M:
            return self._body, None
        self._body = quantized_skeleton(found)
        self._revision = (self._revision + 1) % 256
        identity = self._identity
        message = BodyMessage(identity.person, identity.epoch, self._revision, self._body, self._frame_rate_hz)
        return self._body, encode_body(message)


def _largest_change_m(a: Skeleton, b: Skeleton) -> float:
    pairs = ((a.offsets, b.offsets), (a.tips, b.tips), (a.radii, b.radii))
    return max(float(np.abs(x - y).max()) for x, y in pairs)
