"""Depth meshes: where the vertices are, how they are joined, and what smoothing leaves alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from common.body.depth_mesher import OUTLINE_PIXELS, mesh_view, smooth_depth
from common.body.view import View
from common.geometry.camera_model import Camera, project
from common.geometry.rigid_transform import look_at
from common.geometry.triangle_mesh import TriangleMesh
from tests.capsule_views import arms_down_by, capsule_views

POSE = look_at(np.array([1.0, 1.5, 2.0]), np.array([0.0, 1.0, 0.0])).astype(np.float64)
CAMERA = Camera("test", 64, 48, 60.0, 61.0, 30.5, 25.0, POSE)
BENT = Camera("bent", 64, 48, 60.0, 61.0, 30.5, 25.0, POSE, np.array([0.1, -0.05, 0.002, -0.001, 0.0]))


def view_of(depth_mm: NDArray[np.uint16], camera: Camera = CAMERA) -> View:
    colour = np.random.default_rng(0).integers(0, 256, (*depth_mm.shape, 3), np.uint8)
    return View(camera, 10, 5, depth_mm, colour)


def block(rows: int = 12, columns: int = 15, depth_mm: int = 2000) -> NDArray[np.uint16]:
    """A rectangle of the person with a border of nothing."""
    depth = np.zeros((rows + 2, columns + 2), np.uint16)
    depth[1:-1, 1:-1] = depth_mm
    return depth


def facing(mesh: TriangleMesh, camera: Camera) -> NDArray[np.bool_]:
    """Whether each triangle's front is towards the camera."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.einsum("fk,fk->f", np.cross(b - a, c - a), camera.T_world_camera[:3, 3] - a) > 0


def texels(mesh: TriangleMesh) -> NDArray[np.float32]:
    """Where in the texture the vertices are, in pixels (V, 2)."""
    return mesh.uv * np.array(mesh.texture.shape[1::-1], np.float32) - np.float32(0.5)


@pytest.mark.parametrize("camera", [CAMERA, BENT], ids=lambda c: c.name)
def test_vertices_project_onto_their_pixels_at_their_depth(camera: Camera) -> None:
    depth = block()
    depth[3:6, 4:9] = 1500
    view = view_of(depth, camera)
    mesh = mesh_view(view)
    rows, columns = np.nonzero(depth)
    pixels, depths_m = project(camera, mesh.vertices)
    outline = OUTLINE_PIXELS * np.sign(rows - 6.5) * ((rows == 1) | (rows == 12))
    np.testing.assert_allclose(pixels[:, 1], rows + outline + view.v0, atol=2e-3)
    outline = OUTLINE_PIXELS * np.sign(columns - 8) * ((columns == 1) | (columns == 15))
    np.testing.assert_allclose(pixels[:, 0], columns + outline + view.u0, atol=2e-3)
    np.testing.assert_allclose(depths_m, depth[rows, columns] / 1000, atol=1e-4)
    assert (mesh.vertices.dtype, mesh.faces.dtype, mesh.uv.dtype) == (np.float32, np.int32, np.float32)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_each_vertex_has_the_colour_of_where_it_is_seen(stride: int) -> None:
    view = view_of(block())
    mesh = mesh_view(view, stride)
    pixels, _ = project(CAMERA, mesh.vertices)
    np.testing.assert_allclose(texels(mesh), pixels - [view.u0, view.v0], atol=2e-3)
    assert mesh.texture is view.colour


def test_the_texture_is_not_left_where_the_person_touches_its_border() -> None:
    view = view_of(np.full((12, 15), 2000, np.uint16))
    at = texels(mesh_view(view, 2))
    np.testing.assert_allclose([at.min(axis=0), at.max(axis=0)], [[0, 0], [14, 11]], atol=1e-5)


def test_triangles_face_the_camera() -> None:
    for view in capsule_views(arms_down_by(0.8)):
        mesh = mesh_view(view)
        assert len(mesh.faces) > 1000
        assert facing(mesh, view.camera).all()


def test_a_rectangle_is_covered_by_two_triangles_a_cell() -> None:
    mesh = mesh_view(view_of(block(12, 15)))
    assert (len(mesh.vertices), len(mesh.faces)) == (12 * 15, 2 * 11 * 14)


def test_occlusion_appears_as_stretched_triangles() -> None:
    depth = block()
    depth[:, 8:][depth[:, 8:] > 0] = 2600
    mesh = mesh_view(view_of(depth))
    z = project(CAMERA, mesh.vertices)[1][mesh.faces]
    spanning = z.max(axis=1) - z.min(axis=1) > 0.5
    assert np.count_nonzero(spanning) == 2 * 11  # one column of cells, not torn


@pytest.mark.parametrize("missing", [(1, 1), (1, 2), (2, 1), (2, 2)])
def test_three_pixels_of_a_cell_make_one_triangle(missing: tuple[int, int]) -> None:
    depth = block(2, 2)
    depth[missing] = 0
    view = view_of(depth)
    mesh = mesh_view(view)
    assert sorted(mesh.faces[0]) == [0, 1, 2]
    assert len(mesh.faces) == 1
    assert facing(mesh, view.camera).all()


def test_two_pixels_make_none() -> None:
    assert len(mesh_view(view_of(block(1, 2))).faces) == 0


def test_a_cell_is_cut_along_its_flatter_diagonal() -> None:
    depth = block(2, 2)
    depth[1, 1] = 2900  # the corner that sticks out is in one triangle only
    mesh = mesh_view(view_of(depth))
    assert np.count_nonzero(mesh.faces == 0) == 1


def test_stride_takes_one_pixel_of_each_square() -> None:
    view = view_of(np.full((12, 15), 2000, np.uint16))
    mesh = mesh_view(view, stride=2)
    assert (len(mesh.vertices), len(mesh.faces)) == (6 * 8, 2 * 5 * 7)
    inside = texels(mesh)[8 + 1 : 8 + 4]
    np.testing.assert_allclose(inside, [[2, 2], [4, 2], [6, 2]], atol=1e-4)


@pytest.mark.parametrize("stride", [2, 3])
@pytest.mark.parametrize("shift", [0, 1, 2])
def test_a_coarse_grid_keeps_the_outline(shift: int, stride: int) -> None:
    depth = np.zeros((30, 40), np.uint16)
    depth[4 + shift : 21 + shift, 5 + shift : 25 + shift] = 2000
    depth[10 + shift : 14 + shift, 25 + shift : 35 + shift] = 2000  # an arm of four pixels
    rows, columns = np.nonzero(depth)
    mesh = mesh_view(view_of(depth), stride)
    at = texels(mesh)
    out = OUTLINE_PIXELS
    np.testing.assert_allclose(at.min(axis=0), [columns.min() - out, rows.min() - out], atol=1e-3)
    np.testing.assert_allclose(at.max(axis=0), [columns.max() + out, rows.max() + out], atol=1e-3)
    arm = at[at[:, 0] > 25 + shift]
    np.testing.assert_allclose([arm[:, 1].min(), arm[:, 1].max()], [10 + shift - out, 13 + shift + out], atol=1e-3)


def test_empty_view_gives_an_empty_mesh() -> None:
    mesh = mesh_view(view_of(np.zeros((4, 4), np.uint16)))
    assert (mesh.vertices.shape, mesh.faces.shape, mesh.uv.shape) == ((0, 3), (0, 3), (0, 2))


def test_stride_below_one_is_refused() -> None:
    with pytest.raises(ValueError, match="stride 0"):
        mesh_view(view_of(block()), stride=0)


def test_smoothing_averages_noise_and_keeps_the_mask() -> None:
    noise = np.random.default_rng(1).normal(0, 8, (60, 40))
    depth = np.zeros((64, 44), np.uint16)
    depth[2:-2, 2:-2] = np.rint(2000 + noise)
    smooth = smooth_depth(depth, 2, 50.0)
    np.testing.assert_array_equal(smooth > 0, depth > 0)
    inside = smooth[4:-4, 4:-4]
    assert inside.std() < 8 / 3
    assert abs(inside.mean() - 2000) < 0.5


def test_smoothing_does_not_join_surfaces() -> None:
    depth = block()
    depth[:, 8:][depth[:, 8:] > 0] = 2060  # beyond the range of 5 cm
    np.testing.assert_array_equal(smooth_depth(depth, 2, 50.0), depth)


def test_smoothing_leaves_a_slope_where_it_is_also_at_its_rim() -> None:
    depth = block(20, 20)
    ramp = 2000 + 8 * np.arange(20)
    depth[1:-1, 1:-1] = ramp
    np.testing.assert_allclose(smooth_depth(depth, 2, 50.0), depth, atol=1e-3)
