"""Compile every numba kernel of both daemons into the cache, by taking one person through the whole path once.

Setup runs this, so that no daemon compiles anything when it starts or comes back.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from common.body.skinning import animate_rigid, link_motion
from common.runtime.clock import MonotonicClock
from common.runtime.stage_timer import StageTimer
from common.wire.body_message import decode_body
from common.wire.skeleton_packet import decode_skeleton
from receiver.config import RepositorySettings
from receiver.pipeline import AnimationPath, SkeletonToShow, mesh_of
from sender.capture.frame_set import DepthFrame, FrameSet
from sender.capture.performer import open_performer
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import RigRenderer
from sender.config import CandidateSettings
from sender.fitting.body_model import BodyModel
from sender.fitting.gauss_newton_tracker import GaussNewtonSettings, GaussNewtonTracker
from sender.pipeline import CandidatePath, SkeletonPath, StreamIdentity, TrackedFrame
from sender.reconstruction.background import BackgroundModel
from sender.reconstruction.foreground_points import PointSampler

RATE_HZ = 30.0
FRAMES = 45


def rendered(renderer: RigRenderer, time_s: float, sequence: int, colour: bool = True) -> FrameSet:
    """What all cameras of a rig see at one time."""
    frames = []
    for index, camera in enumerate(renderer.cameras):
        depth = np.zeros((camera.height, camera.width), np.uint16)
        picture = np.zeros((camera.height, camera.width, 3), np.uint8)
        renderer.view(index, time_s, depth, picture)
        capture_ns = round(time_s * 1e9)
        frames.append(DepthFrame(index, sequence, capture_ns, depth, picture if colour else None))
    return FrameSet(round(time_s * 1e9), tuple(frames))


def skeleton_path(renderer: RigRenderer, tracker: GaussNewtonTracker, timer: StageTimer) -> SkeletonPath:
    """The sender's fast path before the rig's cameras."""
    rooms = [renderer.empty_room(index) for index in range(len(renderer.cameras))]
    backgrounds = [BackgroundModel(c, room) for c, room in zip(renderer.cameras, rooms, strict=True)]
    sampler, clock = PointSampler(renderer.cameras), MonotonicClock()
    return SkeletonPath(StreamIdentity(0, 1), backgrounds, sampler, tracker, RATE_HZ, timer, clock)


def main() -> None:
    clock = MonotonicClock()
    timer = StageTimer(clock)
    renderer = RigRenderer(open_performer("builtin"), RigSettings())
    tracker = GaussNewtonTracker(GaussNewtonSettings())
    path = skeleton_path(renderer, tracker, timer)
    tracked: list[TrackedFrame] = []
    for sequence in range(1, FRAMES):
        tracked.append(path.process(rendered(renderer, sequence / RATE_HZ, sequence)))
    shown = [frame for frame in tracked if frame.packet is not None]
    candidates = CandidatePath(StreamIdentity(0, 1), CandidateSettings(), timer)
    animation = AnimationPath(RepositorySettings(), timer, clock)
    bodies = [frame.body for frame in shown if frame.body is not None]
    body = decode_body(bodies[-1]).skeleton
    for frame in shown[-3:]:
        candidates.remember(frame)
        mesh = mesh_of(candidates.process(frame).encoded, 0)
        assert frame.packet is not None
        animation.show(SkeletonToShow(decode_skeleton(frame.packet), body, deque([mesh])))
        assert frame.T_world_link is not None
        animate_rigid(mesh.mesh, link_motion(mesh.mesh, frame.T_world_link))
    assert tracker.body is not None
    again = GaussNewtonTracker(GaussNewtonSettings(), BodyModel.from_bytes(tracker.body.to_bytes()))
    restarted = skeleton_path(renderer, again, timer)
    for sequence in range(FRAMES, FRAMES + 5):
        restarted.process(rendered(renderer, sequence / RATE_HZ, sequence, colour=False))


if __name__ == "__main__":
    main()
