"""The software renderer against Open3D's ray casting: an independent way to the same depth and the same triangle."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from common.body.skinning import animate
from common.geometry.camera_model import Camera, pixel_rays
from common.geometry.rasterizer import render
from common.geometry.rigid_transform import look_at
from tests.capsule_person import capsule_person, shown_frame

open3d = pytest.importorskip("open3d", reason="no Open3D here (pip install open3d-cpu)", exc_type=ImportError)

FRONT = look_at(np.array([0.3, 1.3, 2.6]), np.array([0.0, 0.95, 0.0]))
ABOVE = look_at(np.array([-1.2, 2.6, 1.0]), np.array([0.0, 1.0, 0.0]))
CAMERAS = [
    Camera("centred", 320, 240, 280.0, 280.0, 159.5, 119.5, FRONT),
    Camera("off centre", 241, 320, 300.0, 260.0, 90.3, 170.8, ABOVE),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
def test_depth_and_triangle_are_those_that_rays_hit(camera: Camera) -> None:
    person = capsule_person(1)
    motion = shown_frame(person, 0.8).motion
    assert motion is not None
    vertices, faces = animate(person, motion), person.faces_drawn
    colour, depth = render(vertices[faces].reshape(-1, 3), triangles(faces), numbered(faces), camera)
    ours = np.where(depth > 0, colour.astype(int) @ [1, 256, 65536], -1)
    theirs, distance = cast(vertices, faces, camera)

    assert (theirs >= 0).sum() > 5000
    assert ((ours >= 0) == (theirs >= 0)).mean() > 0.9999  # a ray through an edge may be counted either way
    both = (ours >= 0) & (theirs >= 0)
    np.testing.assert_allclose(depth[both], distance[both], atol=1e-4)
    same = ours[both] == theirs[both]
    assert same.mean() > 0.998
    # Elsewhere two triangles meet at the pixel's centre: the same place on the surface.
    np.testing.assert_allclose(depth[both][~same], distance[both][~same], atol=1e-5)


def triangles(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """As many, each with corners of its own."""
    return np.arange(faces.size, dtype=np.int32).reshape(-1, 3)


def numbered(faces: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Corner colours that tell the triangle's number."""
    number = np.repeat(np.arange(len(faces)), 3)
    return np.stack([number % 256, number // 256 % 256, number // 65536], axis=1).astype(np.uint8)


def cast(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Triangle (H, W), -1 = none, and its distance along the optical axis [m], by one ray through each pixel."""
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(faces.astype(np.uint32)))
    directions = pixel_rays(camera) @ camera.T_world_camera[:3, :3].T
    origin = np.broadcast_to(camera.T_world_camera[:3, 3], directions.shape)
    hits = scene.cast_rays(open3d.core.Tensor(np.concatenate([origin, directions], axis=-1).astype(np.float32)))
    distance = hits["t_hit"].numpy()  # in rays of depth 1
    return np.where(np.isfinite(distance), hits["primitive_ids"].numpy().astype(np.int64), -1), distance
