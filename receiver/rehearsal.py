"""The receiver's path over a mannequin, so that every kernel is there before the first real frame that needs it."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from common.body.cylindrical_map import LinkMaps
from common.body.mannequin import mannequin, mannequin_camera, mannequin_depth
from common.body.rigged_mesh import build_rigged_mesh
from common.body.rigging import Rigging
from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.body.view import View
from common.runtime.clock import MonotonicClock
from common.runtime.stage_timer import StageTimer
from common.wire.candidate_pose import CandidatePose, encode_candidate_pose
from common.wire.map_codec import MapQuality
from common.wire.residual_packet import ResidualHeader
from common.wire.skeleton_packet import SkeletonPacket, decode_skeleton, encode_skeleton
from receiver.config import RepositorySettings
from receiver.live_path import FADE_NS
from receiver.pipeline import AnimationPath, ReceivedPose, SkeletonToShow, mesh_of
from receiver.residual_decoder import ResidualMaps
from receiver.viewer.offscreen_viewer import OffscreenViewer
from receiver.viewer.page_messages import encode_frame, encode_pose

_RIGGING = Rigging("region-growing", "zippered")  # whatever a sender chooses


def rehearse_picture() -> None:
    """What the first picture waits for: mesh a candidate pose, select and animate it."""
    skeleton, pose = mannequin()
    view = _view()
    mesh = build_rigged_mesh(0, 0, skeleton, pose, (view, view), _RIGGING, "all-edges")
    arrived = deque(
        ReceivedPose(0, replace(mesh, pose_id=number)) for number in range(2)
    )  # they meet in the repository
    _animation_path().show(SkeletonToShow(SkeletonPacket(0, 0, 0, 0, 0, 1.0, pose), skeleton, arrived))


def rehearse() -> None:
    """The whole path: mesh a message, select and animate it, let it follow residual maps, and show it both ways."""
    skeleton, pose = mannequin()
    view, path = _view(), _animation_path()
    message = encode_candidate_pose(CandidatePose(1, 0, 0, 0, skeleton, pose, (view, view), _RIGGING))
    packet = decode_skeleton(encode_skeleton(SkeletonPacket(0, 0, 0, 0, 0, 1.0, pose)))
    viewer = OffscreenViewer(mode="live")
    path.live.note_maps(_maps(skeleton, pose))
    for _ in range(2):  # the second pose meets the first in the repository
        packet = replace(packet, sequence=packet.sequence + 1, capture_ns=packet.capture_ns + FADE_NS)
        shown = path.show(SkeletonToShow(packet, skeleton, deque([mesh_of(message, 0, "all-edges")])))
        for mesh in shown.added:
            viewer.add_pose(mesh)
            encode_pose(mesh)
        if shown.frame is not None:
            viewer.show(shown.frame)
            encode_frame(shown.frame)
    viewer.render([view.camera])


def _animation_path() -> AnimationPath:
    clock = MonotonicClock()
    return AnimationPath(RepositorySettings(), StageTimer(clock), clock)


def _view() -> View:
    camera = mannequin_camera()
    depth = mannequin_depth(camera)
    return View(camera, 0, 0, depth, np.full((*depth.shape, 3), 128, np.uint8))


def _maps(skeleton: Skeleton, pose: SkeletonPose) -> ResidualMaps:
    """A band around the middle of each link."""
    quality = MapQuality(50, 1)
    header = ResidualHeader(0, 0, 0, "key", 0, 0, 0, 0, 1000, 50.0, quality)
    layout = header.layout(skeleton)
    shape = layout.height, layout.width
    maps = LinkMaps(np.ones(shape, np.bool_), np.full((*shape, 3), 128, np.uint8), np.full(shape, 30, np.uint8))
    return ResidualMaps(header, skeleton, layout, maps)
