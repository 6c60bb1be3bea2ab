"""World points with normals and colours from the person's pixels of all cameras, down-sampled to a budget.

Three steps: a grid of pixels just dense enough for the budget (stratified in the image), a normal per pixel from its
neighbours, and one point per voxel and facing (so that surfaces seen by several cameras are not counted twice).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from common.body.view import View
from common.geometry.camera_model import Camera, pixel_rays
from common.geometry.point_cloud import PointCloud

CANDIDATES_PER_POINT = 4  # pixels looked at per point asked for: overlap and edges eat about half of them


@njit(nogil=True, cache=True, error_model="numpy")
def _sample_view(depth, rays, u0, v0, R, t, fx, step, baseline_m, positions, normals, pixels, first):  # type: ignore[no-untyped-def]
    """Append the view's points on a pixel grid of ``step`` to the arrays from ``first`` on; return the new count.

    The normal is the cross product of central differences over ±``baseline_m``, at least one pixel: wide enough to
    average the sensor's noise. Pixels whose neighbours lie on another surface are edges and left out.
    """
    h, w = depth.shape
    n = first
    for i in range(v0 % step, h, step):
        for j in range(u0 % step, w, step):
            d = np.float32(depth[i, j]) * np.float32(0.001)
            if d <= 0.0:
                continue
            k = min(max(int(baseline_m * fx / d + 0.5), 1), 6)
            if i < k or j < k or i + k >= h or j + k >= w:
                continue
            left, right = depth[i, j - k] * np.float32(0.001), depth[i, j + k] * np.float32(0.001)
            up, down = depth[i - k, j] * np.float32(0.001), depth[i + k, j] * np.float32(0.001)
            reach = 4.0 * k * d / fx + 0.01  # steeper than about 75°: not one surface
            if left <= 0.0 or right <= 0.0 or up <= 0.0 or down <= 0.0:
                continue
            if max(abs(left - d), abs(right - d), abs(up - d), abs(down - d)) > reach:
                continue
            v, u = v0 + i, u0 + j
            ax = rays[v, u + k, 0] * right - rays[v, u - k, 0] * left
            ay = rays[v, u + k, 1] * right - rays[v, u - k, 1] * left
            az = right - left
            bx = rays[v + k, u, 0] * down - rays[v - k, u, 0] * up
            by = rays[v + k, u, 1] * down - rays[v - k, u, 1] * up
            bz = down - up
            x, y = rays[v, u, 0] * d, rays[v, u, 1] * d
            nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax  # b × a: towards the camera
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if not length > 0.0 or n >= len(positions):
                continue
            for row in range(3):
                positions[n, row] = R[row, 0] * x + R[row, 1] * y + R[row, 2] * d + t[row]
                normals[n, row] = (R[row, 0] * nx + R[row, 1] * ny + R[row, 2] * nz) / length
            pixels[n, 0], pixels[n, 1] = i, j
            n += 1
    return n


@njit(nogil=True, cache=True, error_model="numpy")
def _merge_voxels(positions, normals, colours, voxel_m, table):  # type: ignore[no-untyped-def]
    """Average points of one voxel and one facing (the normal's largest axis and its sign) in place; return the count.

    ``table``: hash table of point indices, a power of two long, filled with -1; front and back of a thin hand fall in
    one voxel but face apart, so they stay two points.
    """
    mask = len(table) - 1
    n = 0
    counts = np.zeros(len(positions), np.float32)
    keys = np.empty(len(positions), np.int64)
    for i in range(len(positions)):
        facing = 0
        for axis in range(1, 3):
            if abs(normals[i, axis]) > abs(normals[i, facing]):
                facing = axis
        face = 2 * facing + (1 if normals[i, facing] > 0.0 else 0)
        key = np.int64(face)
        for axis in range(3):
            key = (key << 19) ^ (np.int64(np.floor(positions[i, axis] / voxel_m)) & np.int64(0x7FFFF))
        slot = ((key * np.int64(0x9E3779B97F4A7C1)) >> 20) & mask
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & mask
        m = table[slot]
        if m < 0:
            m = n
            table[slot] = n
            keys[n] = key
            for axis in range(3):  # n <= i: the source row is still whole
                positions[n, axis] = positions[i, axis]
                normals[n, axis] = normals[i, axis]
                colours[n, axis] = colours[i, axis]
            counts[n] = 1.0
            n += 1
            continue
        counts[m] += 1.0
        share = np.float32(1.0) / counts[m]
        for axis in range(3):
            positions[m, axis] += (positions[i, axis] - positions[m, axis]) * share
            normals[m, axis] += (normals[i, axis] - normals[m, axis]) * share
            colours[m, axis] += (colours[i, axis] - colours[m, axis]) * share
    return n


class PointSampler:
    """Turns views into one world cloud of at most ``budget`` points; viewing rays are computed once per camera.

    ``voxel_m``: edge of the voxels that merge points. ``baseline_m``: half the width over which a normal is taken.

    Raises:
        ValueError: no budget, or two cameras of one name.
    """

    def __init__(
        self, cameras: Sequence[Camera], budget: int = 2500, voxel_m: float = 0.022, baseline_m: float = 0.015
    ) -> None:
        if budget < 1:
            raise ValueError(f"a budget of {budget} points")
        self._rays = {camera.name: pixel_rays(camera) for camera in cameras}
        if len(self._rays) != len(cameras):
            raise ValueError("cameras need different names")
        self._budget = budget
        self._voxel_m = voxel_m
        self._baseline_m = baseline_m
        capacity = CANDIDATES_PER_POINT * budget * 3  # a step of whole pixels overshoots by up to 2.25
        self._positions = np.empty((capacity, 3), np.float32)
        self._normals = np.empty((capacity, 3), np.float32)
        self._pixels = np.empty((capacity, 2), np.int32)
        self._table = np.empty(1 << int(np.ceil(np.log2(2 * capacity))), np.int32)

    def points(self, views: Sequence[View]) -> PointCloud:
        """World cloud of ``views`` (any subset of the cameras, in any order), at most ``budget`` points; may be empty.

        Positions in metres, unit normals towards the camera that saw the point, colours RGB.

        Raises:
            KeyError: a view of a camera that was not announced.
        """
        total = sum(int(np.count_nonzero(view.depth_mm)) for view in views)
        step = max(1, int(np.sqrt(total / (CANDIDATES_PER_POINT * self._budget))))
        colours, count = [], 0
        for view in views:
            first, count = count, self._add_view(view, step, count)
            rows, columns = self._pixels[first:count].T
            colours.append(view.colour[rows, columns])
        if count == 0:
            empty = np.empty((0, 3), np.float32)
            return PointCloud(empty, empty, empty.astype(np.uint8))
        mixed = np.concatenate(colours).astype(np.float32)
        self._table.fill(-1)
        count = _merge_voxels(self._positions[:count], self._normals[:count], mixed, self._voxel_m, self._table)
        chosen = np.arange(count) if count <= self._budget else np.arange(self._budget) * count // self._budget
        normals = self._normals[chosen]
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        return PointCloud(self._positions[chosen], normals, (mixed[chosen] + 0.5).astype(np.uint8))

    def _add_view(self, view: View, step: int, first: int) -> int:
        T = view.camera.T_world_camera.astype(np.float32)
        return int(
            _sample_view(
                view.depth_mm,
                self._rays[view.camera.name],
                view.u0,
                view.v0,
                np.ascontiguousarray(T[:3, :3]),
                np.ascontiguousarray(T[:3, 3]),
                np.float32(view.camera.fx),
                step,
                np.float32(self._baseline_m),
                self._positions,
                self._normals,
                self._pixels,
                first,
            )
        )
