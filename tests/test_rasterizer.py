"""The renderer against a second route: ray–plane intersection through ``pixel_rays`` and ``camera_model.project``."""

import numpy as np
import pytest

from common.geometry.camera_model import Camera, pixel_rays, project
from common.geometry.rasterizer import render, render_crop
from common.geometry.rigid_transform import look_at

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
