"""A candidate pose made small: who sees nobody yet sees somebody at once, coarsely, even over a thin link.

Half or a third of the pixels each way, a rough JPEG and rough depth: a tenth of the bytes.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from common.body.view import View
from common.geometry.camera_model import Camera
from common.wire.candidate_pose import CandidatePose, encode_candidate_pose

SHRINK = 3
JPEG_QUALITY, DEPTH_STEP_MM = 40, 8


def encode_preview(candidate: CandidatePose) -> bytes:
    """Bytes of the same pose, id and all, of small views."""
    views = tuple(small_view(view, SHRINK) for view in candidate.views)
    return encode_candidate_pose(replace(candidate, views=views), JPEG_QUALITY, DEPTH_STEP_MM)


def small_view(view: View, shrink: int) -> View:
    """The view as a camera of 1 / ``shrink`` the resolution sees it: every so manieth reading of depth, the mean colour
    of the person around it."""
    camera = view.camera
    small = Camera(
        camera.name, -(-camera.width // shrink), -(-camera.height // shrink), camera.fx / shrink, camera.fy / shrink,
        camera.cx / shrink, camera.cy / shrink, camera.T_world_camera, camera.distortion,
    )  # fmt: skip
    left, top = -view.u0 % shrink, -view.v0 % shrink  # to pixels that both cameras have
    depth = np.ascontiguousarray(view.depth_mm[top::shrink, left::shrink])
    seen = (view.depth_mm > 0).astype(np.float32)
    around = (shrink + 1, shrink + 1)
    share = cv2.blur(seen, around)
    mean = cv2.blur(view.colour * seen[..., None], around) / np.maximum(share, 1e-6)[..., None]
    colour = np.where(depth[..., None] > 0, mean[top::shrink, left::shrink], 0).round().astype(np.uint8)
    return View(small, (view.u0 + left) // shrink, (view.v0 + top) // shrink, depth, colour)
