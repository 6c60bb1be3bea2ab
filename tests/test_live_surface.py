"""A mesh follows newer maps of its links where these show the same surface elsewhere or in another colour."""

from __future__ import annotations

import numpy as np

from common.body.cylindrical_map import RADIUS_STEP_M, LinkMaps, closed, project_points
from common.body.live_surface import NO_OFFSET, live_surface
from common.body.map_layout import map_layout
from common.body.skeleton import LINK_INDEX
from common.body.skeleton_pose import forward_kinematics
from tests.capsule_person import pose_at
from tests.posed_cloud import BODY, posed_cloud

LAYOUT = map_layout(BODY, 2000, 50.0)
T_WORLD_LINK = forward_kinematics(BODY, pose_at(0.3))
CLOUD, LINKS = posed_cloud(pose_at(0.3), 8000)
GREY = np.full_like(CLOUD.colours, 100)


def maps_of(positions: np.ndarray, colours: np.ndarray) -> LinkMaps:
    return closed(LAYOUT, project_points(LAYOUT, T_WORLD_LINK, LINKS, positions, colours))


def outward_of_axis(link: int) -> np.ndarray:
    """Unit directions away from the bone of the link's points."""
    R, origin = T_WORLD_LINK[link, :3, :3], T_WORLD_LINK[link, :3, 3]
    local = (CLOUD.positions[link == LINKS] - origin) @ R @ LAYOUT.cylinders[link].T
    local[:, 2] = 0
    return (local / np.linalg.norm(local, axis=1, keepdims=True)) @ LAYOUT.cylinders[link] @ R.T


def follow(maps: LinkMaps, colours: np.ndarray = GREY, strength: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    surface = live_surface(1, LAYOUT, maps, T_WORLD_LINK, LINKS, CLOUD.positions, colours)
    return surface.follow(T_WORLD_LINK, LINKS, CLOUD.positions, strength)


def test_maps_of_the_mesh_itself_change_nothing() -> None:
    moved, offsets = follow(maps_of(CLOUD.positions, GREY))
    np.testing.assert_allclose(moved, CLOUD.positions, atol=RADIUS_STEP_M)
    assert (offsets == NO_OFFSET).all()


def test_a_shirt_that_is_farther_out_takes_the_vertices_along() -> None:
    link = LINK_INDEX["upper_spine"]
    mine = link == LINKS
    outward = outward_of_axis(link)
    newer = CLOUD.positions.copy()
    newer[mine] += 0.02 * outward.astype(np.float32)
    moved, _ = follow(maps_of(newer, GREY))
    went_m = np.einsum("nk,nk->n", moved[mine] - CLOUD.positions[mine], outward)
    assert 0.014 < np.median(went_m) < 0.021  # 2 cm but for what counts as noise
    np.testing.assert_allclose(moved[~mine], CLOUD.positions[~mine], atol=1e-4)


def test_a_face_that_turns_red_does_so_on_the_mesh_and_nowhere_else() -> None:
    mine = LINK_INDEX["head"] == LINKS
    red = GREY.copy()
    red[mine] = [160, 100, 60]
    _, offsets = follow(maps_of(CLOUD.positions, red))
    got = np.median(offsets[mine].astype(int) - NO_OFFSET, axis=0)
    assert 50 <= got[0] <= 60
    assert got[1] == 0
    assert -40 <= got[2] <= -30
    assert (offsets[~mine] == NO_OFFSET).all()


def test_of_less_strength_is_the_part() -> None:
    mine = LINK_INDEX["head"] == LINKS
    red, newer = GREY.copy(), CLOUD.positions.copy()
    red[mine] = [160, 100, 60]
    newer[mine] += 0.02 * outward_of_axis(LINK_INDEX["head"]).astype(np.float32)
    maps = maps_of(newer, red)
    (whole, red_offsets), (half, pink_offsets) = follow(maps), follow(maps, strength=0.5)
    np.testing.assert_allclose(half, (whole + CLOUD.positions) / 2, atol=1e-4)
    np.testing.assert_allclose(pink_offsets - 128.0, (red_offsets - 128.0) / 2, atol=1)
    unmoved, no_offsets = follow(maps, strength=0.0)
    np.testing.assert_array_equal(unmoved, CLOUD.positions)
    assert (no_offsets == NO_OFFSET).all()


def test_it_stays_on_the_surface_when_the_links_move_on() -> None:
    link = LINK_INDEX["left_forearm"]
    mine = link == LINKS
    newer = CLOUD.positions.copy()
    newer[mine] += 0.02 * outward_of_axis(link).astype(np.float32)
    surface = live_surface(1, LAYOUT, maps_of(newer, GREY), T_WORLD_LINK, LINKS, CLOUD.positions, GREY)
    here, _ = surface.follow(T_WORLD_LINK, LINKS, CLOUD.positions)
    later = forward_kinematics(BODY, pose_at(1.7))
    moved_on, _ = posed_cloud(pose_at(1.7), 8000)
    there, _ = surface.follow(later, LINKS, moved_on.positions)
    went_m = np.linalg.norm(here - CLOUD.positions, axis=1)
    np.testing.assert_allclose(np.linalg.norm(there - moved_on.positions, axis=1), went_m, atol=5e-4)
    assert np.median(went_m[mine]) > 0.014


def test_another_surface_is_not_followed() -> None:
    link = LINK_INDEX["left_thigh"]
    mine = link == LINKS
    newer = CLOUD.positions.copy()
    newer[mine] += 0.12 * outward_of_axis(link).astype(np.float32)  # a hand before it, say
    moved, _ = follow(maps_of(newer, GREY))
    np.testing.assert_array_equal(moved[mine], CLOUD.positions[mine])


def test_where_maps_are_empty_the_mesh_stays() -> None:
    empty = maps_of(CLOUD.positions, GREY)
    empty.full[:] = False
    moved, offsets = follow(empty)
    np.testing.assert_array_equal(moved, CLOUD.positions)
    assert (offsets == NO_OFFSET).all()
