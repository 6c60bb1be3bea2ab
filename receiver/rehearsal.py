"""The receiver's whole path once over a mannequin, so that every kernel is there before the first real frame."""

from __future__ import annotations

from collections import deque

import numpy as np

from common.body.mannequin import mannequin, mannequin_camera, mannequin_depth
from common.body.rigging import Rigging
from common.body.view import View
from common.runtime.clock import MonotonicClock
from common.runtime.stage_timer import StageTimer
from common.wire.candidate_pose import CandidatePose, encode_candidate_pose
from common.wire.skeleton_packet import SkeletonPacket, decode_skeleton, encode_skeleton
from receiver.config import RepositorySettings
from receiver.pipeline import AnimationPath, SkeletonToShow, mesh_of
from receiver.viewer.offscreen_viewer import OffscreenViewer
from receiver.viewer.page_messages import encode_frame, encode_pose


def rehearse() -> None:
    """Mesh a candidate pose, select and animate it, and show it both ways."""
    skeleton, pose = mannequin()
    camera = mannequin_camera()
    depth = mannequin_depth(camera)
    view = View(camera, 0, 0, depth, np.full((*depth.shape, 3), 128, np.uint8))
    rigging = Rigging("region-growing", "zippered")  # whatever a sender chooses
    message = encode_candidate_pose(CandidatePose(1, 0, 0, 0, skeleton, pose, (view, view), rigging))
    packet = decode_skeleton(encode_skeleton(SkeletonPacket(0, 0, 0, 0, 0, 1.0, pose)))
    clock = MonotonicClock()
    path = AnimationPath(RepositorySettings(), StageTimer(clock), clock)
    viewer = OffscreenViewer()
    for _ in range(2):  # the second pose meets the first in the repository
        shown = path.show(SkeletonToShow(packet, skeleton, deque([mesh_of(message, 0, "all-edges")])))
        for mesh in shown.added:
            viewer.add_pose(mesh)
            encode_pose(mesh)
        if shown.frame is not None:
            viewer.show(shown.frame)
            encode_frame(shown.frame)
    viewer.render([camera])
