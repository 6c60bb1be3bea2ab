"""Software renderer: a mesh seen by a calibrated camera, unlit, on ``cv2.triangleRasterize``.

The rasteriser knows only a centred OpenGL camera. Any other pinhole, and any crop of its image, differs from that
one by an affine map of (u·z, v·z, z), under which planes stay planes and z stays the depth: so vertices are brought
to a camera of 90° vertical field of view around the crop, and nothing of the image is approximated. Triangles that
cannot be seen are left out before, which halves the rasteriser's time.
Pixel (u, v) is sampled at its centre (u, v), as ``camera_model.project`` and ``pixel_rays`` count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.geometry.camera_model import Camera, project
from common.geometry.rigid_transform import inverse

# Vertex colours (V, 3) uint8, or texture coordinates (V, 2) float32 (origin top left, 0..1) with an image (h, w, 3).
Surface = NDArray[np.uint8] | tuple[NDArray[np.floating], NDArray[np.uint8]]

NEAR_M = 0.02  # triangles reaching nearer than this are left out: the rasteriser does not clip them
_MARGIN = 1.01  # of the nearest and farthest vertex to the depth range
_FAR_AWAY_M = 1e4
_IDENTITY = np.eye(4, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """The part of a camera's image that a mesh covers.

    ``u0, v0``: pixel of the top left corner. ``colour`` (h, w, 3) uint8 RGB, background where nothing was hit.
    ``depth`` (h, w) float32 [m along the optical axis], 0 where nothing was hit.
    """

    u0: int
    v0: int
    colour: NDArray[np.uint8]
    depth: NDArray[np.float32]


def render(
    vertices: NDArray[np.floating],
    faces: NDArray[np.int32],
    surface: Surface,
    camera: Camera,
    background: int | NDArray[np.uint8] = 255,
    *,
    cull_back: bool = False,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The mesh seen by ``camera``: colour (H, W, 3) uint8 and depth (H, W) float32 [m], 0 = nothing.

    ``vertices`` (V, 3) [m, world], ``faces`` (F, 3) int32, ``surface`` vertex colours or (uv, texture);
    ``background`` a grey level or an RGB triple; ``cull_back`` leaves out triangles seen from behind (faster).

    Raises:
        ValueError: shapes that do not fit, vertices that are not finite, indices outside the vertices.
    """
    colour = np.empty((camera.height, camera.width, 3), np.uint8)
    colour[:] = background
    depth = np.zeros((camera.height, camera.width), np.float32)
    crop = render_crop(vertices, faces, surface, camera, background, cull_back=cull_back)
    if crop is not None:
        h, w = crop.depth.shape
        colour[crop.v0 : crop.v0 + h, crop.u0 : crop.u0 + w] = crop.colour
        depth[crop.v0 : crop.v0 + h, crop.u0 : crop.u0 + w] = crop.depth
    return colour, depth


def render_crop(
    vertices: NDArray[np.floating],
    faces: NDArray[np.int32],
    surface: Surface,
    camera: Camera,
    background: int | NDArray[np.uint8] = 255,
    *,
    cull_back: bool = False,
) -> Crop | None:
    """Like ``render``, but only the rectangle that the mesh covers; None where it is not in the image."""
    _check(vertices, faces, surface)
    image_points = _image_points(camera, vertices)
    kept_faces, kept = _visible(image_points, np.ascontiguousarray(faces, np.int32), np.float32(NEAR_M), cull_back)
    if len(kept_faces) == 0:
        return None
    image_points = image_points[kept]
    window = _window(camera, image_points)
    if window is None:
        return None
    u0, v0, w, h = window
    colour = np.empty((h, w, 3), np.uint8)
    colour[:] = background
    values, depth = _rasterise(image_points, kept_faces, _attributes(surface, kept), window)
    if isinstance(surface, tuple):
        _paint(values, depth, np.ascontiguousarray(surface[1]), colour)
    else:
        cv2.copyTo(cv2.convertScaleAbs(values), (depth > 0).view(np.uint8), colour)
    return Crop(u0, v0, colour, depth)


def _check(vertices: NDArray[np.floating], faces: NDArray[np.int32], surface: Surface) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"render: vertices {vertices.shape} and faces {faces.shape} are not (V, 3) and (F, 3)")
    per_vertex, columns = (surface[0], 2) if isinstance(surface, tuple) else (surface, 3)
    if per_vertex.shape != (len(vertices), columns):
        raise ValueError(f"render: {per_vertex.shape} colours or texture coordinates for {len(vertices)} vertices")
    if len(vertices) and not np.abs(vertices).max() < _FAR_AWAY_M:
        raise ValueError(f"render: vertices are not finite or farther than {_FAR_AWAY_M:.0f} m")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"render: face indices {faces.min()}..{faces.max()} outside {len(vertices)} vertices")


def _image_points(camera: Camera, vertices: NDArray[np.floating]) -> NDArray[np.float32]:
    """Vertices as homogeneous pixels (V, 3) float32: (u·z, v·z, z)."""
    if camera.distortion.any():  # bent at the vertices only, straight between them
        pixels, z = project(camera, vertices)
        return np.concatenate([pixels * z[:, None], z[:, None]], axis=1).astype(np.float32)
    T_camera_world = inverse(camera.T_world_camera)
    to_image: NDArray[np.float32] = (camera.matrix @ T_camera_world[:3]).astype(np.float32)
    return vertices.astype(np.float32, copy=False) @ to_image[:, :3].T + to_image[:, 3]


def _window(camera: Camera, image_points: NDArray[np.float32]) -> tuple[int, int, int, int] | None:
    """Pixel rectangle (u0, v0, w, h) around the points, cut to the image; None when it is empty."""
    z = image_points[:, 2]
    u, v = image_points[:, 0] / z, image_points[:, 1] / z
    u0, v0 = max(math.floor(u.min()), 0), max(math.floor(v.min()), 0)
    u1, v1 = min(math.ceil(u.max()) + 1, camera.width), min(math.ceil(v.max()) + 1, camera.height)
    return (u0, v0, u1 - u0, v1 - v0) if u0 < u1 and v0 < v1 else None


def _attributes(surface: Surface, kept: NDArray[np.int32]) -> NDArray[np.float32]:
    """What the rasteriser interpolates (N, 3) float32: colours 0..255, or texture pixel coordinates."""
    if not isinstance(surface, tuple):
        return surface[kept].astype(np.float32)
    uv, texture = surface
    pixels = np.zeros((len(kept), 3), np.float32)
    pixels[:, :2] = uv[kept] * np.array(texture.shape[1::-1], np.float32) - np.float32(0.5)
    return pixels


def _rasterise(
    image_points: NDArray[np.float32],
    faces: NDArray[np.int32],
    attributes: NDArray[np.float32],
    window: tuple[int, int, int, int],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Interpolated attributes (h, w, 3) and depth (h, w) [m], 0 = nothing, of the pixel rectangle (u0, v0, w, h)."""
    u0, v0, w, h = window
    half = h / 2  # focal length [pixels] of a 90° field of view
    u_centre, v_centre = u0 + w / 2 - 0.5, v0 + h / 2 - 0.5
    to_gl = np.array([[1 / half, 0, -u_centre / half], [0, -1 / half, v_centre / half], [0, 0, -1]], np.float32)
    z = image_points[:, 2]
    near, far = float(z.min()) / _MARGIN, float(z.max()) * _MARGIN  # tight: the depth buffer holds 1 / z in float32
    settings = cv2.TriangleRasterizeSettings().setShadingType(cv2.RASTERIZE_SHADING_SHADED)
    settings = settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    buffers = np.zeros((h, w, 3), np.float32), np.full((h, w), far, np.float32)
    arguments: Any = (
        (image_points @ to_gl.T)[None], faces[None], attributes[None],
        *buffers, _IDENTITY, np.pi / 2, near, far, settings,
    )  # fmt: skip
    values, depth = cv2.triangleRasterize(*arguments)
    depth[depth >= far * (0.5 + 0.5 / _MARGIN)] = 0
    return np.asarray(values, np.float32), np.asarray(depth, np.float32)


@njit(nogil=True, cache=True, error_model="numpy")
def _visible(points, faces, near_m, cull_back):  # type: ignore[no-untyped-def]
    """Faces in front of the camera (and seen counter-clockwise), renumbered to the vertices in use; those vertices."""
    renumbered = np.full(len(points), -1, np.int32)
    used = np.empty(len(points), np.int32)
    kept = np.empty_like(faces)
    face_count = used_count = 0
    for f in range(len(faces)):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        if not (a[2] >= near_m and b[2] >= near_m and c[2] >= near_m):
            continue
        if cull_back:
            au, av, bu, bv = a[0] / a[2], a[1] / a[2], b[0] / b[2], b[1] / b[2]
            if (bu - au) * (c[1] / c[2] - av) - (bv - av) * (c[0] / c[2] - au) >= 0:
                continue
        for corner in range(3):
            vertex = faces[f, corner]
            if renumbered[vertex] < 0:
                renumbered[vertex] = used_count
                used[used_count] = vertex
                used_count += 1
            kept[face_count, corner] = renumbered[vertex]
        face_count += 1
    return kept[:face_count], used[:used_count]


@njit(nogil=True, cache=True, error_model="numpy")
def _paint(positions, depth, texture, colour):  # type: ignore[no-untyped-def]
    """Bilinear look-up of ``positions`` (h, w, 2 of 3) [texture pixels] into ``colour`` where there is depth."""
    th, tw = texture.shape[:2]
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if depth[v, u] == 0:
                continue
            x = min(max(positions[v, u, 0], np.float32(0)), np.float32(tw - 1))
            y = min(max(positions[v, u, 1], np.float32(0)), np.float32(th - 1))
            x0, y0 = int(x), int(y)
            x1, y1 = min(x0 + 1, tw - 1), min(y0 + 1, th - 1)
            fx, fy = x - np.float32(x0), y - np.float32(y0)
            for k in range(3):
                above = texture[y0, x0, k] * (1 - fx) + texture[y0, x1, k] * fx
                below = texture[y1, x0, k] * (1 - fx) + texture[y1, x1, k] * fx
                colour[v, u, k] = np.uint8(above * (1 - fy) + below * fy + np.float32(0.5))
