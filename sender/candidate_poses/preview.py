"""A candidate pose made small: who sees nobody yet sees somebody at once, coarsely, even over a thin link.

A third of the pixels each way, rough colour and rough depth: a tenth of the bytes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from common.body.view import View
from common.geometry.camera_model import Camera
from common.wire.candidate_pose import CandidatePose, encode_candidate_pose
from common.wire.view_quality import ViewQuality

SHRINK = 3
QUALITY = ViewQuality("webp", 40, 4)


def encode_preview(candidate: CandidatePose) -> bytes:
    """Bytes of the same pose, id and all, of small views."""
    views = tuple(small_view(view, SHRINK) for view in candidate.views)
    return encode_candidate_pose(replace(candidate, views=views), QUALITY)


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
    colour = np.zeros((*depth.shape, 3), np.uint8)
    _mean_colours(view.colour, view.depth_mm, top, left, shrink, colour)
    return View(small, (view.u0 + left) // shrink, (view.v0 + top) // shrink, depth, colour)


@njit(nogil=True, cache=True, error_model="numpy")
def _mean_colours(colour, depth_mm, top, left, shrink, out):  # type: ignore[no-untyped-def]
    """Into ``out`` (h', w', 3), of every so manieth pixel of the person the mean of the person's colours around it."""
    h, w = depth_mm.shape
    reach = (shrink + 1) // 2
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            y, x = top + row * shrink, left + column * shrink
            if depth_mm[y, x] == 0:
                continue
            red, green, blue, count = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for j in range(max(y - reach, 0), min(y - reach + shrink + 1, h)):
                for i in range(max(x - reach, 0), min(x - reach + shrink + 1, w)):
                    if depth_mm[j, i] > 0:
                        red += colour[j, i, 0]
                        green += colour[j, i, 1]
                        blue += colour[j, i, 2]
                        count += 1
            out[row, column, 0] = np.rint(red / count)
            out[row, column, 1] = np.rint(green / count)
            out[row, column, 2] = np.rint(blue / count)
