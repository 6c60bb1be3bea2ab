"""Several people and ghosts in one hull: balls of which every camera knows the cones of sight."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.point_cloud import PointCloud
from sender.reconstruction.hull_people import PersonFollower, connected_volumes, realness
from sender.reconstruction.hull_points import surface_points, volume_points
from sender.reconstruction.visual_hull import VisualHull
from tests.ball_silhouettes import Ball, camera_at, silhouettes

CAMERAS = [camera_at("front", (0.0, 0.0, 3.5)), camera_at("side", (3.5, 0.0, 0.0))]
LEFT, RIGHT = (0.5, 0.0, 0.5), (-0.5, 0.0, -0.5)  # seen crosswise, two cameras see two ghosts too


def column(x: float, z: float, radius_m: float = 0.18) -> list[Ball]:
    """A person, roughly: balls one above the other."""
    return [((x, y, z), radius_m) for y in np.linspace(-0.5, 0.5, 7)]


def hull_of(*columns: list[Ball], cameras: list = CAMERAS) -> VisualHull:
    return VisualHull(silhouettes(cameras, *(ball for balls in columns for ball in balls)))


def middle_of(cloud: PointCloud, chosen: np.ndarray) -> np.ndarray:
    return cloud.positions[chosen].mean(axis=0)


def around(count: int) -> list:
    return [
        camera_at(f"cam{i}", (3.5 * np.sin(a), 0.0, 3.5 * np.cos(a)))
        for i, a in enumerate(np.arange(count) * 2 * np.pi / count + 0.2)
    ]


@pytest.mark.parametrize("points", [surface_points, volume_points])
def test_separate_bodies_are_separate_volumes(points):
    cloud = points(hull_of(column(0.6, 0.6), column(-0.6, -0.5), cameras=around(6)), 4000)
    volumes = connected_volumes(cloud.positions)
    assert volumes.max() == 1
    sides = [np.sign(cloud.positions[volumes == index, 0]) for index in (0, 1)]
    assert all((side == side[0]).all() for side in sides)


def test_a_ghost_has_no_pixels_of_its_own():
    more = [*CAMERAS, camera_at("corner", (3.2, 0.0, 1.4))]
    people = column(0.5, 0.5), column(-0.5, -0.5)
    cloud = volume_points(hull_of(*people), 4000)
    volumes = connected_volumes(cloud.positions)
    assert volumes.max() == 3  # two people and two ghosts
    real = realness(cloud.positions, volumes, CAMERAS)
    seen_again = volume_points(hull_of(*people, cameras=more), 4000)
    again = connected_volumes(seen_again.positions)
    better = realness(seen_again.positions, again, more)
    for points, names, worths, least in ((cloud, volumes, real, 0.0), (seen_again, again, better, 0.5)):
        for index, worth in enumerate(worths):
            x, _, z = points.positions[names == index].mean(axis=0)
            assert worth < 0.2 if x * z < 0 else worth >= least


def test_the_follower_keeps_to_the_pose_and_says_how_sure_it_is():
    cloud = surface_points(hull_of(column(0.6, 0.6), column(-0.6, -0.5), cameras=around(6)), 4000)
    for x, z in ((0.6, 0.6), (-0.6, -0.5)):
        joints = np.array([centre for centre, _ in column(x, z)])
        found = PersonFollower().find(cloud, around(6), joints, 1 / 30)
        np.testing.assert_allclose(middle_of(cloud, found.chosen)[[0, 2]], [x, z], atol=0.1)
        assert found.certainty > 0.9
        assert found.volumes == 2
    far = PersonFollower().find(cloud, around(6), np.array([[9.0, 0.0, 9.0]]), 1 / 30)
    assert not far.chosen.any()
    assert far.certainty == 0


def test_two_bodies_that_touch_make_it_unsure_and_only_the_near_one_is_given():
    cloud = surface_points(hull_of(column(0.2, 0.0), column(-0.3, 0.0, 0.3), cameras=around(6)), 4000)
    assert connected_volumes(cloud.positions).max() == 0
    joints = np.array([centre for centre, _ in column(0.2, 0.0)])
    found = PersonFollower().find(cloud, around(6), joints, 1 / 30)
    assert 0.2 < found.certainty < 0.8
    assert cloud.positions[found.chosen, 0].min() > -0.2 > cloud.positions[:, 0].min()


def test_without_a_pose_it_stays_with_the_one_it_began_with():
    follower = PersonFollower()
    first = surface_points(hull_of(column(0.5, 0.5, 0.25), column(-0.6, -0.5), cameras=around(6)), 4000)
    begun = middle_of(first, follower.find(first, around(6), None, 1 / 30).chosen)
    assert begun[0] > 0.3  # the larger
    second = surface_points(hull_of(column(0.5, 0.3), column(-0.6, -0.5, 0.25), cameras=around(6)), 4000)
    assert middle_of(second, follower.find(second, around(6), None, 1 / 30).chosen)[0] > 0.3


def test_no_points_are_nobody():
    empty = np.zeros((0, 3), np.float32)
    found = PersonFollower().find(PointCloud(empty, empty, empty.astype(np.uint8)), CAMERAS, None, 0.0)
    assert (found.certainty, found.volumes, len(found.chosen)) == (0.0, 0, 0)
