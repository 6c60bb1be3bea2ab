"""Points go into their links' cylinders and come back where they were, whatever the pose."""

from __future__ import annotations

import numpy as np
import pytest

from common.body.cylindrical_map import (
    RADIUS_STEP_M,
    LinkMaps,
    closed,
    project_points,
    resampled,
    unproject,
    unproject_to_links,
)
from common.body.map_layout import map_layout
from common.body.skeleton import LINK_COUNT, LINK_INDEX
from common.body.skeleton_pose import forward_kinematics
from common.geometry import quaternion
from common.geometry.rigid_transform import rigid_transform
from tests.capsule_person import pose_at
from tests.posed_cloud import BODY, posed_cloud

LAYOUT = map_layout(BODY, 10_000, 100.0)
T_WORLD_LINK = forward_kinematics(BODY, pose_at(0.3))


def project_one(point: np.ndarray, link: int) -> LinkMaps:
    return project_points(LAYOUT, T_WORLD_LINK, np.array([link], np.uint8), point[None].astype(np.float32),
                          np.array([[10, 20, 30]], np.uint8))  # fmt: skip


def all_full(height: int, width: int, places: np.ndarray, radius: int = 30) -> LinkMaps:
    full = np.zeros((height, width), np.bool_)
    for top, left, rows, columns in places:
        full[top : top + rows, left : left + columns] = True
    colour = np.where(full[..., None], np.array([90, 60, 30], np.uint8), np.uint8(0))
    return LinkMaps(full, colour, np.where(full, np.uint8(radius), np.uint8(0)))


def test_a_point_comes_back_within_the_stated_error() -> None:
    rng = np.random.default_rng(1)
    for n in range(400):
        link = n % LINK_COUNT
        length, cap = LAYOUT.sizes[link]
        radius = rng.uniform(0.3, 2.5) * BODY.radii[link]
        local = np.array([0, 0, rng.uniform(-0.05, length + 0.05)]) + radius * np.append(_unit(rng.normal(size=2)), 0)
        point = T_WORLD_LINK[link, :3, :3] @ LAYOUT.cylinders[link].T @ local + T_WORLD_LINK[link, :3, 3]
        maps = project_one(point, link)
        assert np.count_nonzero(maps.full) == 1
        (back,), _, _ = unproject(LAYOUT, maps, T_WORLD_LINK)
        beyond = max(-local[2], local[2] - length, 0)
        distance = np.hypot(radius, beyond)
        across = LAYOUT.cell_m / 2 * max(radius, distance) / BODY.radii[link]
        along = LAYOUT.cell_m / 2 * (distance / cap if beyond else max(1, radius / cap))  # at a cap's edge either
        allowed = np.hypot(across, along) + RADIUS_STEP_M / 2 + 1e-5
        assert np.linalg.norm(back - point) <= allowed, (link, local)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def test_moving_links_and_points_together_changes_no_map() -> None:
    maps = all_full(LAYOUT.height, LAYOUT.width, LAYOUT.places)  # middles of cells: rounding cannot move them over
    positions, _, colours = unproject(LAYOUT, maps, T_WORLD_LINK)
    links = _links_of(maps)
    colours = np.random.default_rng(0).integers(0, 255, colours.shape).astype(np.uint8)
    here = project_points(LAYOUT, T_WORLD_LINK, links, positions, colours)
    moved_links, moved = T_WORLD_LINK.copy(), positions.copy()
    for link in range(LINK_COUNT):  # each its own way
        turn = quaternion.to_matrix(quaternion.from_rotation_vector(np.array([0.3 * link, 1.0, -0.2 * link])))
        T = rigid_transform(turn, np.array([0.1 * link, -0.4, 0.2]))
        moved_links[link] = T @ T_WORLD_LINK[link]
        mine = links == link
        moved[mine] = positions[mine] @ T[:3, :3].T + T[:3, 3]
    there = project_points(LAYOUT, moved_links, links, moved, colours)
    np.testing.assert_array_equal(here.full, there.full)
    np.testing.assert_array_equal(here.colour, there.colour)
    np.testing.assert_allclose(here.radius, there.radius, atol=1)


def _links_of(maps: LinkMaps) -> np.ndarray:
    """The link of each point ``unproject`` gives of ``maps``."""
    links = []
    for link, (top, left, rows, columns) in enumerate(LAYOUT.places):
        only = LinkMaps(np.zeros_like(maps.full), maps.colour, maps.radius)
        only.full[top : top + rows, left : left + columns] = True
        links += [link] * len(unproject(LAYOUT, only, T_WORLD_LINK)[0])
    return np.array(links, np.uint8)


@pytest.mark.parametrize("name", ["head", "left_fingers", "right_foot", "left_toes"])
def test_a_point_beyond_the_end_is_not_lost(name: str) -> None:
    link = LINK_INDEX[name]
    tip = BODY.tips[link] * (1 + 0.06 / np.linalg.norm(BODY.tips[link]))  # 6 cm on, right on the axis
    point = T_WORLD_LINK[link, :3, :3] @ tip + T_WORLD_LINK[link, :3, 3] + np.array([1e-3, 0, 1e-3])
    (v,), _ = np.nonzero(project_one(point, link).full)
    top, _, rows, _ = LAYOUT.places[link]
    assert v == top + rows - 1  # at the pole of the far cap
    shape = LAYOUT.height, LAYOUT.width
    full = LinkMaps(np.zeros(shape, np.bool_), np.zeros((*shape, 3), np.uint8), np.full(shape, 30, np.uint8))
    full.full[v, LAYOUT.places[link, 1] :][: LAYOUT.places[link, 3]] = True
    back, _, _ = unproject(LAYOUT, full, T_WORLD_LINK)
    assert np.linalg.norm(back - point, axis=1).min() < LAYOUT.cell_m * 0.06 / LAYOUT.sizes[link, 1]
    assert len(back) <= 8  # not one for each of a ring of slivers


def test_a_cell_keeps_the_mean_of_its_outermost_points() -> None:
    link = LINK_INDEX["left_thigh"]
    R, origin = T_WORLD_LINK[link, :3, :3] @ LAYOUT.cylinders[link].T, T_WORLD_LINK[link, :3, 3]
    local = np.array([[0.10, 0.001, 0.2], [0.104, 0.001, 0.2], [0.05, 0.0005, 0.2]])  # the last: a surface behind
    positions = (local @ R.T + origin).astype(np.float32)
    colours = np.array([[10, 0, 0], [20, 0, 0], [200, 0, 0]], np.uint8)
    maps = project_points(LAYOUT, T_WORLD_LINK, np.full(3, link, np.uint8), positions, colours)
    assert np.count_nonzero(maps.full) == 1
    assert maps.colour[maps.full].tolist() == [[15, 0, 0]]
    assert maps.radius[maps.full].tolist() == [51]


def test_a_gap_is_closed_across_the_seam_and_a_lone_point_does_not_grow() -> None:
    maps = all_full(LAYOUT.height, LAYOUT.width, LAYOUT.places)
    top, left, rows, _ = LAYOUT.places[LINK_INDEX["left_shin"]]
    maps.full[top + rows // 2, left] = False
    again = closed(LAYOUT, maps)
    assert again.full[top + rows // 2, left]
    assert again.colour[top + rows // 2, left].tolist() == [90, 60, 30]
    lone = LinkMaps(np.zeros_like(maps.full), maps.colour, maps.radius)
    lone.full[top + rows // 2, left] = True
    assert np.count_nonzero(closed(LAYOUT, lone).full) == 1


def test_a_coarse_map_interpolated_to_the_full_grid_is_the_same_surface() -> None:
    coarse = map_layout(BODY, 10_000, 20.0)
    finer = resampled(coarse, all_full(coarse.height, coarse.width, coarse.places, 33), LAYOUT)
    expected = all_full(LAYOUT.height, LAYOUT.width, LAYOUT.places, 33)
    np.testing.assert_array_equal(finer.full, expected.full)
    np.testing.assert_array_equal(finer.radius, expected.radius)
    np.testing.assert_array_equal(finer.colour, expected.colour)


def test_interpolation_follows_a_slope() -> None:
    coarse = map_layout(BODY, 10_000, 25.0)
    maps = all_full(coarse.height, coarse.width, coarse.places)
    top, left, rows, columns = coarse.places[0]
    maps.radius[top : top + rows, left : left + columns] = 4 * np.arange(rows, dtype=np.uint8)[:, None]
    finer = resampled(coarse, maps, LAYOUT)
    ftop, fleft, frows, _ = LAYOUT.places[0]
    got = finer.radius[ftop : ftop + frows, fleft].astype(float)
    expected = 4 * ((np.arange(frows) + 0.5) * rows / frows - 0.5).clip(0, rows - 1)
    np.testing.assert_allclose(got, expected, atol=0.51)


def test_a_cloud_through_its_maps_stays_near_itself_and_keeps_its_colours() -> None:
    cloud, links = posed_cloud(pose_at(0.3))
    maps = project_points(LAYOUT, T_WORLD_LINK, links, cloud.positions, cloud.colours)
    positions, normals, colours = unproject(LAYOUT, closed(LAYOUT, maps), T_WORLD_LINK)
    distance = np.linalg.norm(positions[:, None] - cloud.positions[None, ::3], axis=2)
    nearest = distance.argmin(axis=1)
    assert np.median(distance.min(axis=1)) < 0.012
    difference = np.abs(colours.astype(int) - cloud.colours[::3][nearest])
    assert np.median(difference, axis=0).max() <= 6
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)


def test_points_on_their_links_are_the_same_points() -> None:
    cloud, links = posed_cloud()
    maps = project_points(LAYOUT, T_WORLD_LINK, links, cloud.positions, cloud.colours)
    positions, _, colours = unproject(LAYOUT, maps, T_WORLD_LINK)
    points = unproject_to_links(LAYOUT, maps)
    np.testing.assert_allclose(points.posed(T_WORLD_LINK), positions, atol=2e-6)
    np.testing.assert_allclose(points.posed(T_WORLD_LINK[:, :3]), positions, atol=2e-6)
    np.testing.assert_array_equal(points.colours, colours)
    assert set(points.links.tolist()) == set(links.tolist())
