"""Ways to show a distant person over a thin link, all fed the same frames: DISPOSE and what it claims to beat."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from common.body.rigged_mesh import RiggedMesh
from common.body.rigging import Rigging
from common.body.skeleton import LINK_COUNT, LINK_INDEX, SIDES, Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.body.skinning import animate, link_motion
from common.geometry import quaternion
from common.geometry.camera_model import Camera
from common.geometry.rasterizer import render
from common.runtime.stage_timer import StageTimer
from common.wire.candidate_pose import CandidatePose, encode_candidate_pose
from common.wire.skeleton_packet import SkeletonPacket
from receiver.config import RepositorySettings
from receiver.live_path import Moved
from receiver.pipeline import AnimationPath, ReceivedPose, SkeletonToShow, mesh_of
from receiver.viewer.pose_blending import blended
from scripts.capture_files import CapturedFrame
from scripts.fidelity import Picture
from scripts.fidelity_capture import FRAME_NS, FRAME_RATE_HZ
from scripts.fidelity_link import ByteLink
from sender.candidate_poses.mesh_scheduler import MeshScheduler
from sender.config import CandidateSettings
from sender.fitting.tracker import FitResult
from sender.pipeline import CandidatePath, StreamIdentity, TrackedFrame
from sender.reconstruction.depth_fusion import DepthFusion, PosedViews

CANDIDATE_EVERY = 6  # frames: 200 ms, as in the sender
LEAST_CONFIDENCE = 0.5
WRONG_SHARE, WRONG_BY_RAD = 0.2, 0.35  # of the candidates; at the shoulder: 12 to 20 cm at a stretched arm's wrist
RIGGING = Rigging(CandidateSettings().segmentation, CandidateSettings().views)


@dataclass(frozen=True, slots=True, eq=False)
class Screen:
    """What is on screen: the posture of frame ``shown_k``, and how it looks from cameras."""

    shown_k: int
    picture: Callable[[list[Camera]], list[Picture]]


class Method(Protocol):
    """``frame``: the k-th frame is captured, and as much as the link carries in a frame's time arrives. ``screen``:
    what is then on screen; None: nobody."""

    link: ByteLink

    def frame(self, k: int, captured: CapturedFrame) -> None: ...
    @property
    def screen(self) -> Screen | None: ...
    @property
    def switches(self) -> int: ...


def posed(captured: CapturedFrame, own: bool) -> tuple[Skeleton, SkeletonPose, float] | None:
    """Skeleton, pose and confidence a method is given."""
    return captured.own if own else (*captured.true, 1.0)


def encoded_candidate(
    pose_id: int, k: int, captured: CapturedFrame, own: bool, fusion: DepthFusion | None = None
) -> bytes | None:
    """The candidate pose of a frame, or None when its skeleton is doubtful or nobody is seen. Its depth is fused with
    that of the frames ``fusion`` remembers."""
    fitted = posed(captured, own)
    if fitted is None or fitted[2] < LEAST_CONFIDENCE or not captured.views:
        return None
    posed_views = PosedViews(k * FRAME_NS, captured.views, forward_kinematics(fitted[0], fitted[1]))
    views = captured.views if fusion is None else fusion.fused(posed_views, fitted[0])
    candidate = CandidatePose(pose_id, 0, 1, k * FRAME_NS, fitted[0], fitted[1], views, RIGGING)
    return encode_candidate_pose(candidate, CandidateSettings().quality)


class _NoClock:
    def now_ns(self) -> int:
        return 0


def blended_picture(moved: list[Moved], cameras: list[Camera]) -> list[Picture]:
    """The mean of several meshes' pictures, as the receiver's viewers show it."""
    pictures = zip(*(animated_picture(*each, cameras) for each in moved), strict=True)
    return [blended(of_one_camera) for of_one_camera in pictures]


def animated_picture(mesh: RiggedMesh, motion: NDArray[np.float32], cameras: list[Camera]) -> list[Picture]:
    """A mesh moved, seen by the cameras."""
    vertices = animate(mesh, motion)
    return [render(vertices, mesh.faces_drawn, mesh.mesh.surface, camera) for camera in cameras]


class _Animated:
    """Shared by the methods that animate a captured mesh: which mesh, and the links it is moved to."""

    def __init__(self, rate_bps: float, own: bool) -> None:
        self.link = ByteLink(rate_bps, FRAME_RATE_HZ, skeletons=True)
        self.own = own
        self.screen: Screen | None = None
        self.switches = 0
        self._poses = 0
        self._on_screen: RiggedMesh | None = None
        self._fusion = DepthFusion(CandidateSettings().fused_frames)

    def _remember(self, k: int, captured: CapturedFrame) -> None:
        """For the depth of the frames to come, as the sender does."""
        fitted = posed(captured, self.own)
        if fitted is not None and fitted[2] >= LEAST_CONFIDENCE:
            T_world_link = forward_kinematics(fitted[0], fitted[1])
            self._fusion.remember(PosedViews(k * FRAME_NS, captured.views, T_world_link))

    def _show(self, k: int, mesh: RiggedMesh, motion: NDArray[np.float32], others: Sequence[Moved] = ()) -> None:
        self.switches += self._on_screen is not None and self._on_screen is not mesh
        self._on_screen = mesh
        self.screen = Screen(k, partial(blended_picture, [(mesh, motion), *others]))


class Dispose(_Animated):
    """Both pipelines whole: what is worth sending, scheduler; repository, selection by σ."""

    def __init__(
        self,
        rate_bps: float,
        own: bool,
        settings: RepositorySettings | None = None,
        choice: Literal["coverage", "paper"] = "coverage",
    ) -> None:
        super().__init__(rate_bps, own)
        clock = _NoClock()
        self._candidates = CandidatePath(StreamIdentity(0, 1), CandidateSettings(choice=choice), StageTimer(clock))
        self._scheduler = MeshScheduler()
        self._scheduler.receiver_joined("receiver", 1)
        self._animation = AnimationPath(settings or RepositorySettings(), StageTimer(clock), clock)
        self._arrived: deque[ReceivedPose] = deque()
        self._meshes: dict[int, RiggedMesh] = {}

    def frame(self, k: int, captured: CapturedFrame) -> None:
        """Offer a candidate now and then, carry bytes, select and animate."""
        fitted = posed(captured, self.own)
        self.link.start_frame()
        if fitted is not None:
            tracked = self._candidate(k, captured, fitted)
            self._candidates.remember(tracked)
            if k % CANDIDATE_EVERY == 0 and self._candidates.may_become_one(tracked):
                self._candidates.note_budget(self._scheduler.budget_bytes)
                found = self._candidates.process(tracked)
                self._scheduler.offer(found.pose_id, found.encoded, found.capture_ns, found.worth, found.preview)
        self._carry(k)
        if fitted is not None:
            self._animate(k, fitted)

    def _candidate(self, k: int, captured: CapturedFrame, fitted: tuple[Skeleton, SkeletonPose, float]) -> TrackedFrame:
        return _tracked(k, captured, fitted)

    def _carry(self, k: int) -> None:
        while True:
            if self.link.idle:
                budget_bytes = int(self.link.bytes_per_frame * FRAME_RATE_HZ)
                chosen = self._scheduler.next_for("receiver", budget_bytes, k * FRAME_NS)
                if chosen is None:
                    return
                record = self._scheduler.sent("receiver", chosen[0], k * FRAME_NS)
                if record is not None and not record.preview:
                    self._candidates.note_sent(record.pose_id, record.retain_threshold)
                self.link.send(chosen[1], len(chosen[1]))
            message = self.link.arrived()
            if message is None:
                return
            assert isinstance(message, bytes)
            self._arrived.append(mesh_of(message, 0))

    def _animate(self, k: int, fitted: tuple[Skeleton, SkeletonPose, float]) -> None:
        skeleton, pose, confidence = fitted
        packet = SkeletonPacket(0, 1, k, k * FRAME_NS, 1, confidence, pose, None)
        shown = self._animation.show(SkeletonToShow(packet, skeleton, self._arrived))
        self._meshes |= {mesh.pose_id: mesh for mesh in shown.added}
        if not shown.frame.withheld and shown.frame.pose_id is not None and shown.frame.motion is not None:
            others = [(self._meshes[other.pose_id], other.motion) for other in shown.frame.others]
            self._show(k, self._meshes[shown.frame.pose_id], shown.frame.motion, others)
        for pose_id in shown.removed:
            self._meshes.pop(pose_id, None)


def _tracked(k: int, captured: CapturedFrame, fitted: tuple[Skeleton, SkeletonPose, float]) -> TrackedFrame:
    """The frame as the sender's skeleton path would hand it on."""
    skeleton, pose, confidence = fitted
    fit = FitResult(skeleton, pose, True, 1, 1.0, 0.0, confidence)
    T_world_link = forward_kinematics(skeleton, pose)
    return TrackedFrame(k * FRAME_NS, captured.views, fit, skeleton=skeleton, pose=pose, T_world_link=T_world_link)


class DisposeMistold(Dispose):
    """As ``Dispose``, with a fifth of the candidates' skeletons wrong: an arm is said to be elsewhere, its hand more
    than 5 cm away (DISPOSE §8). ``told``: their fit says that it is doubtful. What is shown follows the right ones."""

    def __init__(self, rate_bps: float, own: bool, told: bool) -> None:
        super().__init__(rate_bps, own)
        self._told = told
        self._random = np.random.default_rng(0)

    def _candidate(self, k: int, captured: CapturedFrame, fitted: tuple[Skeleton, SkeletonPose, float]) -> TrackedFrame:
        skeleton, pose, confidence = fitted
        if self._random.random() < WRONG_SHARE:
            side = SIDES[int(self._random.integers(2))]
            turn = quaternion.from_rotation_vector(self._random.choice([-1, 1], 3) * WRONG_BY_RAD / np.sqrt(3))
            rotations = pose.rotations.copy()
            link = LINK_INDEX[f"{side}_upper_arm"]
            rotations[link] = quaternion.multiply(rotations[link].astype(np.float64), turn)
            pose = SkeletonPose(pose.root_position, rotations, pose.confidence)
            confidence = 0.2 if self._told else confidence
        return _tracked(k, captured, (skeleton, pose, confidence))


class LastMesh(_Animated):
    """Raghuraman et al. 2013: the newest mesh that has arrived, moved by the newest skeleton."""

    def __init__(self, rate_bps: float, own: bool) -> None:
        super().__init__(rate_bps, own)
        self._mesh: RiggedMesh | None = None

    def frame(self, k: int, captured: CapturedFrame) -> None:
        """Whenever the link is free, the newest frame's mesh goes out."""
        self._remember(k, captured)
        self.link.start_frame()
        while True:
            if self.link.idle:
                encoded = encoded_candidate(self._poses + 1, k, captured, self.own, self._fusion)
                if encoded is None:
                    break
                self._poses += 1
                self.link.send(encoded, len(encoded))
            message = self.link.arrived()
            if message is None:
                break
            assert isinstance(message, bytes)
            self._mesh = mesh_of(message, 0).mesh
        fitted = posed(captured, self.own)
        if self._mesh is not None and fitted is not None:
            self._show(k, self._mesh, link_motion(self._mesh, forward_kinematics(fitted[0], fitted[1])))


class FirstMesh(LastMesh):
    """The first mesh for ever: what all selection must beat."""

    def frame(self, k: int, captured: CapturedFrame) -> None:
        """As ``LastMesh`` until something has arrived."""
        if self._mesh is None:
            super().frame(k, captured)
            return
        fitted = posed(captured, self.own)
        if fitted is not None:
            self._show(k, self._mesh, link_motion(self._mesh, forward_kinematics(fitted[0], fitted[1])))


class Ceiling(_Animated):
    """The newest capture, no limit: what the cameras and the mesher can do at best."""

    def frame(self, k: int, captured: CapturedFrame) -> None:
        """Shown where it was captured; meshed only when looked at, of what there was then."""
        self._remember(k, captured)
        if (fitted := posed(captured, self.own)) is not None and fitted[2] >= LEAST_CONFIDENCE and captured.views:
            self.screen = Screen(k, partial(self._picture, k, captured, self._fusion.copy()))

    def _picture(self, k: int, captured: CapturedFrame, fusion: DepthFusion, cameras: list[Camera]) -> list[Picture]:
        encoded = encoded_candidate(1, k, captured, self.own, fusion)
        assert encoded is not None
        still = np.tile(np.eye(3, 4, dtype=np.float32), (LINK_COUNT, 1, 1))
        return animated_picture(mesh_of(encoded, 0).mesh, still, cameras)


PAPER = RepositorySettings(search="threshold", hold=True, blended=1)
METHODS: dict[str, Callable[[float, bool], Method]] = {
    "dispose": Dispose,
    "dispose-alone": lambda rate, own: Dispose(rate, own, RepositorySettings(blended=1)),
    "dispose-paper": lambda rate, own: Dispose(rate, own, PAPER, "paper"),
    "dispose-paper-sender": lambda rate, own: Dispose(rate, own, choice="paper"),
    "dispose-mistold": lambda rate, own: DisposeMistold(rate, own, told=False),
    "dispose-doubted": lambda rate, own: DisposeMistold(rate, own, told=True),
    "dispose-paper-receiver": lambda rate, own: Dispose(rate, own, PAPER),
    "last-mesh": LastMesh,
    "first-mesh": FirstMesh,
    "ceiling": Ceiling,
}
