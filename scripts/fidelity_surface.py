"""What is drawn of views that come without a skeleton: one textured surface, its long triangles left out."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.depth_mesher import mesh_view
from common.body.rigged_mesh import DRAWN_EDGE_M
from common.body.view import View
from common.geometry.camera_model import Camera
from common.geometry.rasterizer import render
from common.geometry.triangle_mesh import TriangleMesh
from scripts.fidelity import Picture


def surface_of(views: Sequence[View], stride: int, longest_m: float = DRAWN_EDGE_M) -> TriangleMesh:
    """All views meshed, a vertex every ``stride`` pixels, in one mesh; triangles with a longer edge bridge a gap."""
    meshes = [mesh_view(view, stride) for view in views]
    width = max((m.texture.shape[1] for m in meshes), default=1)
    height = sum(m.texture.shape[0] for m in meshes)
    atlas = np.zeros((max(height, 1), width, 3), np.uint8)
    vertices, faces, uv = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.int32)], [np.zeros((0, 2), np.float32)]
    top = first = 0
    for m in meshes:
        h, w = m.texture.shape[:2]
        atlas[top : top + h, :w] = m.texture
        vertices.append(m.vertices)
        faces.append((m.faces + first)[_short(m, longest_m)])
        pixels = m.uv * np.array([w, h], np.float32) + np.array([0, top], np.float32)
        uv.append(np.asarray(pixels / np.array([width, height]), np.float32))
        top, first = top + h, first + len(m.vertices)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv), atlas)


def _short(mesh: TriangleMesh, longest_m: float) -> NDArray[np.bool_]:
    corners = mesh.vertices[mesh.faces]
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return np.asarray(lengths.max(axis=1) <= longest_m)


def pictures_of(mesh: TriangleMesh, cameras: Sequence[Camera]) -> list[Picture]:
    """The surface seen by each camera."""
    return [render(mesh.vertices, mesh.faces, mesh.surface, camera) for camera in cameras]


def reduced(view: View, step: int) -> View:
    """A view with one pixel in place of ``step`` × ``step``: the person's mean colour, the depth in the middle."""
    if step == 1:
        return view
    height, width = (-(-n // step) for n in view.depth_mm.shape)
    padding = ((0, height * step - view.depth_mm.shape[0]), (0, width * step - view.depth_mm.shape[1]))
    depth = np.pad(view.depth_mm, padding)
    seen = (depth > 0).astype(np.float32)
    colour = np.pad(view.colour, (*padding, (0, 0))).astype(np.float32) * seen[..., None]
    size = (width, height)
    share = cv2.resize(seen, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(colour, size, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)[..., None]
    c = view.camera
    middle = step // 2
    camera = Camera(
        c.name, width, height, c.fx / step, c.fy / step,
        (c.cx - view.u0 - middle) / step, (c.cy - view.v0 - middle) / step, c.T_world_camera,
    )  # fmt: skip
    small = np.ascontiguousarray(depth[middle::step, middle::step])
    return View(camera, 0, 0, small, np.asarray(np.clip(mean + 0.5, 0, 255), np.uint8))
