"""Where a single camera without a known pose is assumed to stand: level, looking at the person from the front."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from common.geometry.rigid_transform import rigid_transform

HEIGHT_M = 1.1  # where the floor is not to be seen
STANDING_M = 1.2  # who is shorter sits, or is not seen whole
_LOOKING_BACK = np.diag([1.0, -1.0, -1.0])  # along −Z of the world: image right is +X, the person's left


def assumed_pose(
    depth_mm: Sequence[NDArray[np.uint16]] | NDArray[np.uint16], fx: float, fy: float, cx: float, cy: float
) -> NDArray[np.float64]:
    """``T_world_camera`` (4, 4) that puts the person of ``depth_mm`` (frames of (H, W), 0 = nothing) at the origin.

    The middle of the readings comes to x = z = 0. When they are as tall as a standing person and do not touch the lower
    edge of the images, the lowest are taken for soles on y = 0; otherwise the camera is put 1.1 m high.

    Raises:
        ValueError: there is not a single reading.
    """
    stack = np.asarray(depth_mm)
    _, v, u = np.nonzero(stack)
    if len(v) == 0:
        raise ValueError("no depth reading in the frames that were looked at")
    z = stack[stack > 0] / 1000
    across, down = np.median((u - cx) / fx * z), (v - cy) / fy * z
    top, bottom = np.percentile(down, (0.1, 99.9))
    stands = bottom - top > STANDING_M and v.max() < stack.shape[1] - 2
    height = bottom if stands else HEIGHT_M
    return rigid_transform(_LOOKING_BACK, np.array([-across, height, np.median(z)])).astype(np.float64)
