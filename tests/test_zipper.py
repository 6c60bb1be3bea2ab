"""Zippered views are one surface: nothing twice, nothing lost, seams shared, the texture of who sees best."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from common.body.body_regions import default_region_weights
from common.body.depth_mesher import mesh_view
from common.body.distortion_score import distortion_score
from common.body.rigged_mesh import MESH_STRIDE, RiggedMesh, build_rigged_mesh, merged
from common.body.rigging import Rigging, Segmentation
from common.body.skinning import Skinning, animate, link_motion
from common.body.surface_border import border_of
from common.body.surface_normals import normals_and_incidence
from common.body.view import View
from common.body.view_overlap import SURFACE_EDGE_M, overlap
from common.body.view_squares import ViewSquares, view_squares
from common.body.zipper import Zippered, zippered
from common.geometry.camera_model import Camera
from common.geometry.rasterizer import render_crop
from common.geometry.rigid_transform import look_at
from tests.capsule_person import SKELETON
from tests.capsule_views import arms_down_by, capsule_views, links_of

RADIUS_M = 0.5
RING = ((2.0, 0, 0), (0, 0, 2.0), (-2.0, 0, 0), (0, 0, -2.0))
ALL_ROUND = (*RING, (0, 2.5, 0), (0, -2.5, 0))


def ball() -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    rings, around = 60, 120
    latitude, longitude = np.linspace(-math.pi / 2, math.pi / 2, rings), 2 * math.pi * np.arange(around) / around
    across = np.cos(latitude)[:, None]
    x, z = across * np.cos(longitude), across * np.sin(longitude)
    vertices = RADIUS_M * np.stack([x, np.sin(latitude)[:, None] + 0 * x, z], axis=-1).reshape(-1, 3)
    ring, segment = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    here, beside = ring * around + segment, ring * around + (segment + 1) % around
    faces = [
        np.stack(corners, -1) for corners in ((here, here + around, beside), (beside, here + around, beside + around))
    ]
    return vertices.astype(np.float32), np.concatenate(faces).reshape(-1, 3).astype(np.int32)


def ball_view(eye: tuple[float, float, float], grey: int) -> View:
    vertices, faces = ball()
    up = np.array([0, 0, 1.0]) if eye[1] else None
    camera = Camera("cam", 480, 360, 360.0, 360.0, 239.5, 179.5, look_at(np.array(eye), np.zeros(3), up))
    crop = render_crop(vertices, faces, np.full((len(vertices), 3), grey, np.float32), camera)
    assert crop is not None
    return View(camera, crop.u0, crop.v0, np.rint(crop.depth * 1000).astype(np.uint16), crop.colour)


@cache
def zippered_ball(eyes: tuple[tuple[float, float, float], ...]) -> tuple[Zippered, int]:
    """The ball zippered from views painted in greys of their own, and how many triangles the views had."""
    views = [ball_view(eye, 20 + 30 * index) for index, eye in enumerate(eyes)]
    meshes = [mesh_view(view, MESH_STRIDE) for view in views]
    whole = merged(meshes)
    return zippered(whole, meshes, views, MESH_STRIDE), len(whole.faces)


def uses(one: Zippered) -> tuple[Counter[tuple[int, int]], int]:
    """How many triangles have each edge, and the Euler characteristic V − E + F, places at seams counted once."""
    faces = one.weld[one.mesh.faces]
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    count = Counter(map(tuple, ends.tolist()))
    return count, len(np.unique(faces)) - len(count) + len(faces)


def hits(one: Zippered, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.int64]:
    """How many triangles each ray meets from outside (Möller & Trumbore)."""
    a, b, c = (one.mesh.vertices[one.mesh.faces[:, k]].astype(float) for k in range(3))
    found = []
    for origin, direction in zip(origins, directions, strict=True):
        p = np.cross(direction, c - a)
        determinant = np.einsum("fi,fi->f", p, b - a)
        u = np.einsum("fi,fi->f", origin - a, p) / determinant
        q = np.cross(origin - a, b - a)
        v = q @ direction / determinant
        inside = (determinant > 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1)
        found.append(int(np.count_nonzero(inside)))
    return np.array(found)


def test_a_ball_seen_from_all_round_is_closed() -> None:
    one, before = zippered_ball(ALL_ROUND)
    count, euler = uses(one)
    open_edges = sum(n == 1 for n in count.values())
    assert open_edges < 0.002 * len(count)
    assert sum(n > 2 for n in count.values()) < 0.001 * len(count)
    assert abs(euler - 2) <= 8  # a sphere's is 2; a hole of a few edges takes one
    assert len(one.mesh.faces) < 0.8 * before


@pytest.mark.parametrize(("eyes", "between"), [(RING[:2], (20, 70)), (RING, (0, 360))], ids=["two", "four"])
def test_every_ray_meets_the_surface_once(
    eyes: tuple[tuple[float, float, float], ...], between: tuple[int, int]
) -> None:
    """Where one or both of the views see it: across the seam, too, nothing is there twice and nothing is lost."""
    one, _ = zippered_ball(eyes)
    rng = np.random.default_rng(5)
    azimuth, height = np.deg2rad(rng.uniform(*between, 1500)), rng.uniform(-0.5, 0.5, 1500)
    normals = np.stack([np.cos(azimuth) * np.cos(height), np.sin(height), np.sin(azimuth) * np.cos(height)], axis=1)
    found = hits(one, 2 * normals, -normals)
    assert (found == 1).mean() > 0.985
    assert (found == 0).mean() < 0.004


def test_its_place_is_the_balls() -> None:
    one, _ = zippered_ball(ALL_ROUND)
    off = np.abs(np.linalg.norm(one.mesh.vertices, axis=1) - RADIUS_M)
    assert np.percentile(off, 99) < 0.004


def test_each_part_is_painted_by_the_camera_that_sees_it_best() -> None:
    one, _ = zippered_ball(RING)
    height, width = one.mesh.texture.shape[:2]
    column, row = (one.mesh.uv * [width, height]).astype(int).T
    painted = (one.mesh.texture[row, column, 0].astype(float) - 20) / 30
    middle = one.mesh.vertices @ np.array(RING).T / 2
    best, second = np.sort(middle, axis=1)[:, -1], np.sort(middle, axis=1)[:, -2]
    clear = best - second > 0.1
    assert clear.mean() > 0.5
    assert (np.abs(painted - middle.argmax(axis=1))[clear] < 0.2).mean() > 0.99


def test_vertices_welded_share_a_place_and_stitches_join_views() -> None:
    one, _ = zippered_ball(RING)
    np.testing.assert_allclose(one.mesh.vertices[one.weld], one.mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(one.weld[one.weld], one.weld)
    assert one.faces_stitched > 50
    assert (one.weld != np.arange(len(one.weld))).sum() > 100


def test_one_view_stays_as_it_is() -> None:
    view = ball_view(RING[0], 100)
    mesh = mesh_view(view, MESH_STRIDE)
    one = zippered(merged([mesh]), [mesh], [view], MESH_STRIDE)
    assert len(one.mesh.faces) - one.faces_stitched == len(mesh.faces)
    assert one.faces_stitched < 10  # holes of three edges
    np.testing.assert_array_equal(one.weld, np.arange(len(one.weld)))


def views_overlap(views: list[View]) -> tuple[ViewSquares, NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """What ``overlap`` finds in views of the ball: squares, vertices, which are redundant, and the consensus."""
    meshes = [mesh_view(view, MESH_STRIDE) for view in views]
    whole = merged(meshes)
    eyes = np.array([view.camera.T_world_camera[:3, 3] for view in views], np.float32)
    squares = view_squares(whole.vertices, meshes, views, MESH_STRIDE)
    normals, quality = normals_and_incidence(whole.vertices, whole.faces, eyes, squares.view_of, 3)
    outline = border_of(whole.faces, len(normals))
    redundant, consensus = overlap(whole.vertices, normals, quality, outline, eyes, squares)
    return squares, whole.vertices, redundant, consensus


def test_squares_know_their_vertices() -> None:
    views = [ball_view(eye, 100) for eye in RING[:2]]
    squares, vertices, _, _ = views_overlap(views)
    np.testing.assert_array_equal(squares.at[squares.own], np.arange(len(vertices)))
    own = squares.square[squares.view_of, np.arange(len(vertices))]
    assert (own == squares.own).mean() > 0.99  # outermost ones may be moved out of theirs
    beyond = squares.square[1] == -1  # where the other view, at right angles, is not looking
    assert not beyond[np.linalg.norm(vertices, axis=1) < RADIUS_M + 0.01].any()


def test_of_two_vertices_in_a_place_the_better_seen_one_is_kept() -> None:
    squares, vertices, redundant, _ = views_overlap([ball_view(eye, 100) for eye in RING[:2]])
    seen = vertices[:, [0, 2]] / RADIUS_M  # the cosine to either view's axis
    own, other = seen[np.arange(len(seen)), squares.view_of], seen[np.arange(len(seen)), 1 - squares.view_of]
    between = (seen > 0.35).all(axis=1)  # both views have it, away from their outlines
    assert redundant[between & (own < other - 0.05)].mean() > 0.99
    assert redundant[own > other + 0.05].mean() < 0.01
    assert redundant[other < 0].sum() == 0


def test_views_that_disagree_meet_between() -> None:
    views = [ball_view(eye, 100) for eye in RING[:2]]
    for index, off_mm in enumerate((6, -6)):
        depth = views[index].depth_mm.astype(np.int64)
        views[index] = replace(views[index], depth_mm=np.where(depth > 0, depth + off_mm, 0).astype(np.uint16))
    _, vertices, _, consensus = views_overlap(views)
    middle = (np.abs(vertices[:, 0] - vertices[:, 2]) < 0.05) & (vertices[:, 0] > 0.3)
    before, after = (np.abs(np.linalg.norm(v[middle], axis=1) - RADIUS_M) for v in (vertices, consensus))
    assert before.mean() > 0.003
    assert after.mean() < 0.3 * before.mean()


@cache
def person(angle_rad: float, segmentation: Segmentation = "voronoi", cameras: int = 4) -> RiggedMesh:
    pose = arms_down_by(angle_rad)
    views = capsule_views(pose, cameras)
    return build_rigged_mesh(1, 0, SKELETON, pose, views, Rigging(segmentation, "zippered"))


@pytest.mark.parametrize("cameras", [1, 2, 3, 8])
def test_any_number_of_views_becomes_a_rigged_mesh(cameras: int) -> None:
    mesh = person(0.8, cameras=cameras)
    assert len(mesh.faces_drawn) > 1000
    assert mesh.mesh.faces.max() < len(mesh.mesh.vertices) == len(mesh.vertex_link) == len(mesh.mesh.uv)
    assert np.isfinite(mesh.mesh.vertices).all()
    assert mesh.mesh.uv.min() >= 0
    assert mesh.mesh.uv.max() <= 1


def test_an_outline_says_how_far_out_a_surface_is_that_another_view_sees_straight_on() -> None:
    """Depths of one camera are 6 mm short; they move out where a camera at right angles has its outline."""
    views = [ball_view(eye, 100) for eye in RING]
    short = np.where(views[0].depth_mm > 0, views[0].depth_mm + 6, 0).astype(np.uint16)
    views[0] = replace(views[0], depth_mm=short)
    meshes = [mesh_view(view, MESH_STRIDE) for view in views]
    one = zippered(merged(meshes), meshes, views, MESH_STRIDE)
    x, y, z = one.mesh.vertices.T
    at_the_outline = (x > 0) & (np.abs(y) < 0.05) & (np.abs(z - 0.125) < 0.02)  # of the camera at z = 2 m
    off = np.linalg.norm(one.mesh.vertices[at_the_outline], axis=1) - RADIUS_M
    assert len(off) > 20
    assert (off > -0.004).mean() > 0.1  # moved out: those of the outermost square
    elsewhere = (x > 0) & (np.abs(y) < 0.05) & (np.abs(z) < 0.02)
    assert (np.linalg.norm(one.mesh.vertices[elsewhere], axis=1) - RADIUS_M).max() < -0.005


def test_drawn_triangles_are_surface_only() -> None:
    mesh = person(1.35)
    ends = mesh.mesh.vertices[mesh.faces_drawn]
    assert np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=-1).max() <= SURFACE_EDGE_M
    assert len(mesh.faces_drawn) < len(mesh.mesh.faces)  # bridges over occlusions still count in σ


@pytest.mark.parametrize("segmentation", ["voronoi", "region-growing"])
@pytest.mark.parametrize("skinning", ["rigid", "linear", "spherical"])
def test_seams_do_not_open_when_it_moves(segmentation: Segmentation, skinning: Skinning) -> None:
    mesh = person(0.8, segmentation)
    moved = animate(mesh, link_motion(mesh, links_of(arms_down_by(0.2, 0.5))), skinning)
    place, first = np.unique(mesh.mesh.vertices, axis=0, return_inverse=True)
    low, high = np.full(place.shape, np.inf), np.full(place.shape, -np.inf)
    np.minimum.at(low, first, moved)
    np.maximum.at(high, first, moved)
    assert len(place) < len(moved)
    assert (high - low).max() < 1e-4


def test_score_of_the_zippered_mesh() -> None:
    mesh, weights = person(0.8), default_region_weights()
    assert distortion_score(mesh, links_of(arms_down_by(0.8)), weights) < 1e-4
    assert distortion_score(mesh, links_of(arms_down_by(0.8, turned_rad=2.0)), weights) < 1e-3
    scores = [distortion_score(mesh, links_of(arms_down_by(angle)), weights) for angle in (0.7, 0.5, 0.2)]
    assert 0 < scores[0] < scores[1] < scores[2]
    joined = mesh.mesh.vertices[mesh.joint_edges.vertices]
    assert len(np.unique(np.sort(mesh.joint_edges.vertices, axis=1), axis=0)) == len(joined)
