"""The modified visual hull against balls, whose cones of sight are known exactly."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sender.reconstruction.hull_points import surface_points, volume_points
from sender.reconstruction.silhouette import Silhouette
from sender.reconstruction.visual_hull import NOBODY, HullLines, VisualHull
from tests.ball_silhouettes import camera_at, in_cones, silhouette, silhouettes, three_cameras

BALL = ((0.0, 0.0, 0.0), 0.3)
DISTANCE_M = 3.0
PIXEL_M = DISTANCE_M / (0.8 * 320)


def around(count: int) -> list:
    angles = 2 * np.pi * np.arange(count) / count
    return [camera_at(f"cam{i}", (DISTANCE_M * np.sin(a), 0.0, DISTANCE_M * np.cos(a))) for i, a in enumerate(angles)]


def ends(lines: HullLines, row: int) -> np.ndarray:
    """Depths (M, 2) of the intervals on one line."""
    return lines.depths[lines.line == row]


def nearest_to_axis(lines: HullLines) -> int:
    direction = -lines.origin / np.linalg.norm(lines.origin)
    return int(np.argmax(lines.directions @ direction / np.linalg.norm(lines.directions, axis=1)))


def test_the_line_through_a_balls_middle_is_cut_where_the_other_cones_end():
    lines = VisualHull(silhouettes(three_cameras(), BALL)).lines(0, 4000)
    (interval,) = ends(lines, nearest_to_axis(lines))
    half_m = DISTANCE_M * np.tan(np.arcsin(BALL[1] / DISTANCE_M))
    np.testing.assert_allclose(interval, [DISTANCE_M - half_m, DISTANCE_M + half_m], atol=PIXEL_M)


def test_what_is_kept_is_what_every_cone_holds():
    cameras = three_cameras()
    lines = VisualHull(silhouettes(cameras, BALL)).lines(0, 2000)
    depths = np.linspace(DISTANCE_M - 0.5, DISTANCE_M + 0.5, 401)
    points = lines.origin + lines.directions[:, None] * depths[:, None]
    inside = np.all([in_cones(points.reshape(-1, 3), camera, [BALL]) for camera in cameras], axis=0)
    expected_m = inside.reshape(len(lines.directions), -1).sum(axis=1) * (depths[1] - depths[0])
    kept_m = np.zeros(len(lines.directions))
    np.add.at(kept_m, lines.line, lines.depths[:, 1] - lines.depths[:, 0])
    assert np.abs(kept_m - expected_m).mean() < PIXEL_M
    assert kept_m.sum() == pytest.approx(expected_m.sum(), rel=0.02)


def test_a_line_through_two_bodies_keeps_two_intervals_and_the_gap_between():
    front, back = ((0.0, 0.0, 0.6), 0.2), ((0.0, 0.0, -0.6), 0.25)
    lines = VisualHull(silhouettes(three_cameras(), front, back)).lines(0, 2000)
    found = ends(lines, nearest_to_axis(lines))
    assert len(found) == 2
    for (centre, radius_m), interval in zip((front, back), found, strict=True):
        middle = DISTANCE_M - centre[2]
        np.testing.assert_allclose(interval, [middle - radius_m, middle + radius_m], atol=2 * PIXEL_M)
    points = volume_points(VisualHull(silhouettes(three_cameras(), front, back)), 2000).positions
    assert not (np.abs(points[:, 2]) < 0.3).any()


def test_points_in_the_volume_are_as_many_as_asked_evenly_along_the_lines_and_in_every_cone():
    cameras = around(5)
    cloud = volume_points(VisualHull(silhouettes(cameras, BALL)), 3000)
    assert len(cloud) == 3000
    assert (cloud.normals == 0).all()
    for camera in cameras:
        assert in_cones(cloud.positions.astype(float), camera, [BALL], slack_px=1.0).all()
    shares = [np.mean(cloud.positions[:, axis] > 0) for axis in range(3)]
    np.testing.assert_allclose(shares, 0.5, atol=0.04)


def test_points_on_the_surface_have_its_normals():
    cameras = [*around(8), camera_at("above", (0.0, 3.0, 0.0)), camera_at("below", (0.0, -3.0, 0.0))]
    cloud = surface_points(VisualHull(silhouettes(cameras, BALL)), 2000)
    assert 1500 < len(cloud) <= 2000
    radii = np.linalg.norm(cloud.positions, axis=1)
    assert (radii > BALL[1] - PIXEL_M).all()  # a hull holds the body
    assert np.median(radii) < BALL[1] + 2 * PIXEL_M
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-5)
    outwards = (cloud.normals * cloud.positions).sum(axis=1) / radii
    assert np.quantile(outwards, 0.02) > 0.8
    assert np.median(outwards) > 0.97


def test_the_order_of_the_cameras_does_not_matter():
    views = silhouettes(around(6), ((0.1, 0.2, 0.1), 0.3), ((-0.5, 0.0, 0.2), 0.15))
    for other in (views[::-1], views[2:] + views[:2]):
        for points in (volume_points, surface_points):
            once, again = (points(VisualHull(some), 1000).positions for some in (views, other))
            order, other_order = (np.lexsort(cloud.round(4).T) for cloud in (once, again))
            np.testing.assert_allclose(once[order], again[other_order], atol=1e-5)


def test_more_cameras_leave_less():
    lengths = [VisualHull(silhouettes(around(8)[:: 8 // n], BALL)).lines(0, 1000).lengths_m().sum() for n in (2, 4, 8)]
    assert np.isinf(lengths[0]) or lengths[0] > lengths[1]
    assert lengths[1] > lengths[2]


def test_every_end_names_the_silhouette_that_made_it():
    views = silhouettes(three_cameras(), BALL)
    lines = VisualHull(views).lines(0, 500)
    assert set(np.unique(lines.made_by)) <= {1, 2}
    wide = VisualHull([views[0], dataclasses.replace(views[1], mask=np.full_like(views[1].mask, 255))])
    assert (wide.lines(0, 500).made_by == NOBODY).all()  # ends only where the camera's sight does


def test_a_camera_cuts_only_what_it_sees():
    cameras = around(4)
    away = camera_at("away", (0.0, 0.0, DISTANCE_M))
    away = dataclasses.replace(away, T_world_camera=away.T_world_camera @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    blind = Silhouette(away, np.zeros((240, 320), np.uint8))
    views = silhouettes(cameras, BALL)
    kept = volume_points(VisualHull([*views, blind]), 500).positions
    np.testing.assert_allclose(kept, volume_points(VisualHull(views), 500).positions, atol=1e-6)
    half = dataclasses.replace(cameras[1], width=160)  # sees the left half of what it saw
    narrow = Silhouette(half, np.ascontiguousarray(views[1].mask[:, :160]))
    less = VisualHull([views[0], narrow, *views[2:]]).lines(0, 500).lengths_m().sum()
    without = VisualHull([views[0], *views[2:]]).lines(0, 500).lengths_m().sum()
    assert VisualHull(views).lines(0, 500).lengths_m().sum() <= less < without


def test_an_empty_silhouette_empties_the_hull():
    cameras = three_cameras()
    views = [silhouette(cameras[0], BALL), silhouette(cameras[1]), silhouette(cameras[2], BALL)]
    for order in (views, views[::-1], silhouettes(cameras)):
        assert len(volume_points(VisualHull(order), 100)) == 0
        assert len(surface_points(VisualHull(order), 100)) == 0


def test_a_camera_inside_the_body_sees_it_everywhere_and_does_no_harm():
    cameras = [*around(4), camera_at("inside", (0.1, 0.0, 0.1))]
    views = silhouettes(cameras[:4], BALL)
    everywhere = Silhouette(cameras[4], np.full((240, 320), 255, np.uint8))
    for hull in (VisualHull([*views, everywhere]), VisualHull([everywhere, *views])):
        cloud = surface_points(hull, 400)
        assert len(cloud) > 0
        assert np.isfinite(cloud.positions).all()
        for camera in cameras[:4]:
            assert in_cones(cloud.positions.astype(float), camera, [BALL], slack_px=1.5).mean() > 0.99


def test_one_silhouette_is_no_hull():
    with pytest.raises(ValueError, match="1 silhouettes"):
        VisualHull(silhouettes(around(1), BALL))


def test_cameras_of_different_sizes_share_one_hull():
    cameras = around(4)
    cameras[1] = camera_at("small", (DISTANCE_M, 0.0, 0.0), 160, 120)
    cloud = volume_points(VisualHull(silhouettes(cameras, BALL)), 500)
    for camera in cameras:
        assert in_cones(cloud.positions.astype(float), camera, [BALL], slack_px=1.0).all()


def test_more_intervals_than_fit_on_a_line_are_left_out_from_behind():
    cameras = three_cameras()
    comb = np.zeros((240, 320), np.uint8)
    comb[:, ::4] = comb[:, 1::4] = 255  # eighty stripes
    full = np.full((240, 320), 255, np.uint8)
    views = [Silhouette(cameras[0], full), Silhouette(cameras[1], comb), Silhouette(cameras[2], full)]
    lines = VisualHull(views).lines(0, 300)
    assert np.bincount(lines.line).max() == 16
    assert (np.diff(lines.depths, axis=1) > 0).all()
