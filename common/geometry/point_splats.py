"""Software renderer of a coloured point cloud: every point a round disc that faces the camera, the nearest wins."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from common.geometry.rigid_transform import inverse

_NEAR_M = 0.02


def render_points(
    positions: NDArray[np.floating],
    colours: NDArray[np.uint8],
    camera: Camera,
    radius_m: float,
    background: int = 255,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Points (N, 3) [m, world] with ``colours`` (N, 3) RGB, seen by a camera without distortion.

    Returns colour (H, W, 3) uint8 and depth (H, W) float32 [m], 0 = nothing. A disc of ``radius_m`` covers the pixels
    whose centres lie in it, at least the one its own centre is in.

    Raises:
        ValueError: shapes that do not fit, or a camera with distortion.
    """
    if positions.ndim != 2 or positions.shape[1] != 3 or colours.shape != positions.shape:
        raise ValueError(f"splats: positions {positions.shape} and colours {colours.shape} are not both (N, 3)")
    if camera.distortion.any():
        raise ValueError(f"splats: camera {camera.name} has distortion")
    colour = np.full((camera.height, camera.width, 3), background, np.uint8)
    depth = np.zeros((camera.height, camera.width), np.float32)
    into = np.ascontiguousarray(inverse(camera.T_world_camera)[:3], np.float32)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    _splat(np.ascontiguousarray(positions, np.float32), colours, into, intrinsics, np.float32(radius_m), colour, depth)
    return colour, depth


@njit(nogil=True, cache=True, error_model="numpy")
def _splat(positions, colours, into, intrinsics, radius_m, colour, depth):  # type: ignore[no-untyped-def]
    height, width = depth.shape
    for n in range(len(positions)):
        x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
        far = into[2, 0] * x + into[2, 1] * y + into[2, 2] * z + into[2, 3]
        if not far > np.float32(_NEAR_M):
            continue
        u = (into[0, 0] * x + into[0, 1] * y + into[0, 2] * z + into[0, 3]) / far * intrinsics[0] + intrinsics[2]
        v = (into[1, 0] * x + into[1, 1] * y + into[1, 2] * z + into[1, 3]) / far * intrinsics[1] + intrinsics[3]
        reach = radius_m * intrinsics[0] / far
        if not (-reach - 1 < u < width + reach and -reach - 1 < v < height + reach):
            continue
        middle_u, middle_v = int(np.floor(u + np.float32(0.5))), int(np.floor(v + np.float32(0.5)))
        top, bottom = min(int(np.ceil(v - reach)), middle_v), max(int(np.floor(v + reach)), middle_v)
        left, right = min(int(np.ceil(u - reach)), middle_u), max(int(np.floor(u + reach)), middle_u)
        for row in range(max(top, 0), min(bottom, height - 1) + 1):
            for column in range(max(left, 0), min(right, width - 1) + 1):
                inside = (row - v) * (row - v) + (column - u) * (column - u) <= reach * reach
                if not inside and not (row == middle_v and column == middle_u):
                    continue
                if depth[row, column] == 0 or far < depth[row, column]:
                    depth[row, column] = far
                    for c in range(3):
                        colour[row, column, c] = colours[n, c]
