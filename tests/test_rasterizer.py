"""The renderer against second routes: ray–plane intersection, ``camera_model.project`` and OpenCV's rasteriser."""

from typing import Any

import cv2
import numpy as np
import pytest

from common.geometry.camera_model import Camera, pixel_rays, project
from common.geometry.rasterizer import render, render_crop
from common.geometry.rigid_transform import inverse, look_at

OFF_CENTRE = Camera("off", 160, 120, 150.0, 140.0, 97.3, 41.8, look_at([0.6, 1.5, 2.5], [0.1, 0.9, 0.0]))
QUAD = np.array([[-0.6, 0.3, 0.2], [0.7, 0.3, -0.3], [0.7, 1.6, -0.1], [-0.6, 1.6, 0.4]], np.float32)  # planar
QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
RED = np.full((4, 3), (200, 30, 30), np.uint8)


def plane_hits(camera: Camera, corners: np.ndarray) -> np.ndarray:
    """World point (H, W, 3) where each pixel's ray meets the plane of the corners."""
    rays = pixel_rays(camera) @ camera.T_world_camera[:3, :3].T
    eye = camera.T_world_camera[:3, 3]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    depth = ((corners[0] - eye) @ normal) / (rays @ normal)
    return eye + depth[..., None] * rays


def opencv_picture(
    vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Colour float32 and depth by ``cv2.triangleRasterize``, for a camera centred in its image."""
    seen = vertices @ inverse(camera.T_world_camera)[:3, :3].T + inverse(camera.T_world_camera)[:3, 3]
    gl = (seen * (1, -1, -1)).astype(np.float32)
    settings = cv2.TriangleRasterizeSettings().setShadingType(cv2.RASTERIZE_SHADING_SHADED)
    settings = settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    size = camera.height, camera.width
    arguments: Any = (
        gl[None], faces[None], colours.astype(np.float32)[None], np.zeros((*size, 3), np.float32),
        np.full(size, 10, np.float32), np.eye(4, dtype=np.float32), 2 * np.arctan(camera.height / 2 / camera.fy),
        0.5, 10.0, settings,
    )  # fmt: skip
    colour, depth = cv2.triangleRasterize(*arguments)
    return np.asarray(colour), np.where(depth > 9.9, 0, depth)


def bumpy_ball(rings: int = 24, sectors: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and random smooth colours of a closed dented surface of about a metre."""
    down, around = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, sectors), indexing="ij")
    radius = 0.5 + 0.12 * np.sin(4 * around) * np.sin(3 * down)
    x, y, z = np.sin(down) * np.sin(around), np.cos(down), np.sin(down) * np.cos(around)
    vertices = (radius[..., None] * np.stack([x, y, z], axis=-1) + (0.1, 0.9, 0)).reshape(-1, 3)
    corner = np.arange(rings * sectors).reshape(rings, sectors)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    colours = 127 + 120 * np.stack([np.sin(3 * x + y), np.sin(5 * y), np.cos(4 * z)], axis=-1).reshape(-1, 3)
    return vertices.astype(np.float32), faces.astype(np.int32), colours.astype(np.uint8)


def test_picture_is_that_of_opencv_but_for_a_pixel_at_outlines() -> None:
    camera = Camera(
        "centred", 160, 120, 140.0, 140.0, 79.5, 59.5, look_at(np.array([0.6, 1.5, 2.0]), np.array([0.1, 0.9, 0.0]))
    )
    ball = bumpy_ball()
    colour, depth = render(*ball, camera)
    other_colour, other_depth = opencv_picture(*ball, camera)
    pixel = np.ones((3, 3), np.uint8)
    ours, theirs = ((d > 0).astype(np.uint8) for d in (depth, other_depth))
    assert ours.sum() > 4000
    assert (ours <= cv2.dilate(theirs, pixel)).all()
    assert (theirs <= cv2.dilate(ours, pixel)).all()
    low, high = cv2.erode(other_depth, pixel), cv2.dilate(other_depth, pixel)
    smooth = (low > 0) & (high - low < 0.1)  # no outline of a dent before another
    assert smooth.sum() > 0.7 * ours.sum()
    assert np.abs(depth - other_depth)[smooth].max() < 1e-3
    assert np.abs(colour - other_colour)[smooth].max() <= 2


def test_triangles_side_by_side_leave_no_gap_even_with_corners_on_pixel_centres() -> None:
    camera = Camera("front", 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))
    rng = np.random.default_rng(4)
    u, v = np.meshgrid(np.arange(-2, 67.0, 1.5), np.arange(-2, 51.0, 1.5))
    shifted = rng.random(u.shape) < 0.5  # the others stay on whole and half pixels
    u, v = u + shifted * rng.uniform(-0.3, 0.3, u.shape), v + shifted * rng.uniform(-0.3, 0.3, u.shape)
    z = rng.uniform(1.5, 2.5, u.shape)
    vertices = np.stack([(u - 32) / 50 * z, (v - 24) / 50 * z, z], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = np.arange(u.size).reshape(u.shape)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]).astype(np.int32)
    _, depth = render(vertices, faces, np.zeros(vertices.shape, np.uint8), camera)
    assert (depth > 0).all()


def test_picture_is_painted_over_in_place() -> None:
    picture = np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8)
    before = picture.copy()
    colour, depth = render(QUAD, QUAD_FACES, RED, OFF_CENTRE)
    crop = render_crop(QUAD, QUAD_FACES, RED, OFF_CENTRE, onto=picture)
    assert crop is not None
    assert np.shares_memory(crop.colour, picture)
    np.testing.assert_array_equal(picture[depth > 0], colour[depth > 0])
    np.testing.assert_array_equal(picture[depth == 0], before[depth == 0])
    for wrong in (picture[:-1], picture[:, ::-1]):
        with pytest.raises(ValueError, match="picture"):
            render_crop(QUAD, QUAD_FACES, RED, OFF_CENTRE, onto=wrong)


def test_depth_is_that_of_the_pixel_ray_for_an_off_centre_camera() -> None:
    _, depth = render(QUAD, QUAD_FACES, RED, OFF_CENTRE)
    hits = plane_hits(OFF_CENTRE, QUAD)
    expected = project(OFF_CENTRE, hits.reshape(-1, 3))[1].reshape(depth.shape)
    seen = depth > 0
    assert seen.sum() > 2000
    np.testing.assert_allclose(depth[seen], expected[seen], atol=1e-4)


def test_outline_lies_where_project_puts_the_corners() -> None:
    _, depth = render(QUAD, QUAD_FACES, RED, OFF_CENTRE)
    v, u = np.nonzero(depth)
    corners, _ = project(OFF_CENTRE, QUAD)
    assert np.abs([u.min() - corners[:, 0].min(), u.max() - corners[:, 0].max()]).max() <= 1
    assert np.abs([v.min() - corners[:, 1].min(), v.max() - corners[:, 1].max()]).max() <= 1


def test_texture_coordinates_start_top_left_and_are_perspective_correct() -> None:
    rows, columns = np.mgrid[0:256, 0:256]
    texture = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).astype(np.uint8)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # corner 3 is the picture's top left
    colour, depth = render(QUAD, QUAD_FACES, (uv, texture), OFF_CENTRE)
    hits = plane_hits(OFF_CENTRE, QUAD)
    seen = depth > 0
    across = (hits[..., 0] + 0.6) / 1.3 * 256 - 0.5
    down = (1.6 - hits[..., 1]) / 1.3 * 256 - 0.5
    assert np.abs(colour[seen, 0] - across[seen].clip(0, 255)).max() < 1.5
    assert np.abs(colour[seen, 1] - down[seen].clip(0, 255)).max() < 1.5


def test_texture_coordinates_that_are_not_numbers_show_the_edge() -> None:
    texture = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    colour, depth = render(QUAD, QUAD_FACES, (np.full((4, 2), np.nan, np.float32), texture), OFF_CENTRE)
    assert (colour[depth > 0] == texture[0, 0]).all()


def test_nearer_surface_wins_and_background_fills_the_rest() -> None:
    near = QUAD * 0.2 + np.array([0.2, 0.8, 1.0], np.float32)
    vertices, faces = np.concatenate([near, QUAD]), np.concatenate([QUAD_FACES, QUAD_FACES + 4])
    colours = np.concatenate([np.full((4, 3), (0, 0, 255), np.uint8), RED])
    colour, depth = render(vertices, faces, colours, OFF_CENTRE, background=77)
    u, v = project(OFF_CENTRE, near.mean(axis=0, keepdims=True))[0][0].round().astype(int)
    assert tuple(colour[v, u]) == (0, 0, 255)
    assert depth[v, u] < 2
    assert (colour[depth == 0] == 77).all()
    assert set(map(tuple, colour[depth > 0])) == {(0, 0, 255), (200, 30, 30)}


def test_crop_is_the_same_picture_as_the_whole_image() -> None:
    colour, depth = render(QUAD, QUAD_FACES, RED, OFF_CENTRE)
    crop = render_crop(QUAD, QUAD_FACES, RED, OFF_CENTRE)
    assert crop is not None
    h, w = crop.depth.shape
    assert (w, h) != (OFF_CENTRE.width, OFF_CENTRE.height)
    np.testing.assert_array_equal(crop.depth, depth[crop.v0 : crop.v0 + h, crop.u0 : crop.u0 + w])
    np.testing.assert_array_equal(crop.colour, colour[crop.v0 : crop.v0 + h, crop.u0 : crop.u0 + w])
    assert np.count_nonzero(depth) == np.count_nonzero(crop.depth)


@pytest.mark.parametrize(("culled", "faces"), [(False, QUAD_FACES), (True, QUAD_FACES[:, ::-1])])
def test_culling_leaves_out_faces_seen_clockwise_only(culled: bool, faces: np.ndarray) -> None:
    _, depth = render(QUAD, faces, RED, OFF_CENTRE, cull_back=True)
    assert (depth > 0).any() != culled


def test_distorted_camera_bends_vertices_as_project_does() -> None:
    k = np.array([-0.2, 0.05, 0.001, -0.002, 0.0])
    camera = Camera("bent", 160, 120, 150.0, 140.0, 97.3, 41.8, OFF_CENTRE.T_world_camera, k)
    assert np.abs(project(camera, QUAD)[0] - project(OFF_CENTRE, QUAD)[0]).max() > 1
    small = np.concatenate([c + 0.02 * (QUAD - QUAD.mean(axis=0)) for c in QUAD[:3] * 0.8]).astype(np.float32)
    for corner in range(3):
        faces = QUAD_FACES + 4 * corner
        _, depth = render(small, faces, np.tile(RED, (3, 1)), camera)
        v, u = np.nonzero(depth)
        expected = project(camera, small[4 * corner : 4 * corner + 4])[0].mean(axis=0)
        assert np.hypot(u.mean() - expected[0], v.mean() - expected[1]) < 1


def test_triangles_reaching_behind_the_camera_are_left_out() -> None:
    behind = QUAD.copy()
    behind[1] = OFF_CENTRE.T_world_camera[:3, 3] - 0.5 * OFF_CENTRE.T_world_camera[:3, 2]
    _, left_out = render(behind, QUAD_FACES[:1], RED, OFF_CENTRE)
    _, both = render(behind, QUAD_FACES, RED, OFF_CENTRE)
    _, second_alone = render(QUAD, QUAD_FACES[1:], RED, OFF_CENTRE)
    assert (left_out == 0).all()
    np.testing.assert_allclose(both, second_alone, atol=1e-4)


def test_nothing_to_see_is_background() -> None:
    for vertices, faces in (
        (QUAD + np.array([0, 0, 50], np.float32), QUAD_FACES),  # behind
        (QUAD + np.array([90, 0, 0], np.float32), QUAD_FACES),  # beside the image
        (QUAD, QUAD_FACES[:0]),
    ):
        colour, depth = render(vertices, faces, RED, OFF_CENTRE)
        assert (depth == 0).all()
        assert (colour == 255).all()
    empty = np.zeros((0, 3))
    assert render_crop(empty, QUAD_FACES[:0], empty.astype(np.uint8), OFF_CENTRE) is None


def test_malformed_meshes_are_refused_by_name() -> None:
    broken = QUAD.copy()
    broken[2, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        render(broken, QUAD_FACES, RED, OFF_CENTRE)
    with pytest.raises(ValueError, match="outside 4 vertices"):
        render(QUAD, QUAD_FACES + 1, RED, OFF_CENTRE)
    with pytest.raises(ValueError, match="colours or texture"):
        render(QUAD, QUAD_FACES, RED[:3], OFF_CENTRE)
