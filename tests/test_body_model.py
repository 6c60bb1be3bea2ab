"""The person's model: closest-point grids, accumulation in link frames, and the saved form."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from common.body.skeleton import LINK_COUNT, LINK_INDEX, human_skeleton
from common.body.skeleton_pose import bone_segments, forward_kinematics, rest_pose
from common.geometry.point_cloud import PointCloud
from sender.fitting import link_cells
from sender.fitting.body_model import BodyModel, nearest_bones
from sender.fitting.closest_point_grid import MAX_CELLS, build_link_grid
from sender.fitting.surface_matching import all_near, match_points, tints

SKELETON = human_skeleton(1.7)
T_REST = forward_kinematics(SKELETON, rest_pose(np.array([0.0, 0.9, 0.0])))


def tube(count: int, radius: float, length: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) and normals of a tube along x."""
    random = np.random.default_rng(seed)
    angle = random.uniform(0, 2 * np.pi, count)
    normals = np.stack([np.zeros(count), np.cos(angle), np.sin(angle)], axis=1)
    points = normals * radius + np.outer(random.uniform(0, length, count), [1.0, 0, 0])
    return points.astype(np.float32), normals.astype(np.float32)


def forearm_cloud(seed: int = 0, noise_m: float = 0.0, count: int = 400) -> PointCloud:
    """The left forearm of the rest pose as a tube, in the world."""
    points, normals = tube(count, 0.035, 0.22, seed)
    points = points + normals * np.random.default_rng(seed + 1).normal(0, noise_m, (count, 1)).astype(np.float32)
    world = points + T_REST[LINK_INDEX["left_forearm"], :3, 3]
    return PointCloud(world.astype(np.float32), normals, np.full((count, 3), 90, np.uint8))


def body_of(*clouds: PointCloud) -> BodyModel:
    body = BodyModel(SKELETON)
    for cloud in clouds:
        body.add(cloud, T_REST)
    return body


def test_grid_answers_with_the_nearest_point_facing_the_same_way() -> None:
    points, normals = tube(500, 0.05, 0.3)
    grid = build_link_grid(points, normals, 0.015, 0.06)
    cells = np.indices(grid.nearest.shape[1:]).reshape(3, -1).T
    centres = grid.origin + (cells + 0.5) * grid.cell_m
    for side, axis, sign in ((2, 1, 1), (3, 1, -1), (4, 2, 1)):
        facing = points[sign * normals[:, axis] > 0.25]
        true_m, _ = cKDTree(facing).query(centres)
        rows = grid.nearest[side].ravel()
        found_m = np.linalg.norm(centres - points[rows], axis=1)
        assert (sign * normals[rows, axis] > 0.25).all()
        np.testing.assert_allclose(found_m, true_m, atol=1e-5)
    assert (grid.nearest[0] == -1).all()  # nothing on the tube faces along it


def test_large_links_get_coarser_cells_instead_of_more() -> None:
    points, normals = tube(300, 0.4, 1.0)
    grid = build_link_grid(points, normals, 0.015, 0.06)
    assert grid.nearest[0].size < 1.3 * MAX_CELLS
    assert grid.cell_m > 0.015


def test_grid_refuses_more_points_than_its_indices_hold() -> None:
    with pytest.raises(ValueError, match="at most 32767"):
        build_link_grid(np.zeros((40_000, 3)), np.zeros((40_000, 3)), 0.015, 0.06)


def test_nearest_bone_is_measured_in_radii() -> None:
    starts, ends = bone_segments(SKELETON, T_REST)
    middles = (0.5 * (starts + ends)).astype(np.float32)
    links = [LINK_INDEX[name] for name in ("left_forearm", "right_shin", "head", "left_upper_arm")]
    first, second, near, ratio = nearest_bones(middles[links], starts, ends, SKELETON.radii)
    assert first.tolist() == links
    assert (second != first).all()
    assert (ratio > 1).all()
    assert near.max() < 1e-3


def test_points_are_kept_in_the_frame_of_their_link() -> None:
    surface = body_of(forearm_cloud()).surface()
    link = LINK_INDEX["left_forearm"]
    first = surface.first_point[link]
    last = surface.first_point[link + 1] if link + 1 < LINK_COUNT else len(surface.points)
    own = surface.points[first:last]
    assert len(own) > 100
    np.testing.assert_allclose(np.linalg.norm(own[:, 1:], axis=1), 0.035, atol=0.004)
    assert surface.low[LINK_INDEX["head"], 0] > surface.high[LINK_INDEX["head"], 0]  # nothing seen of it


def test_links_learn_in_turns() -> None:
    at_once, in_turns = body_of(forearm_cloud()), body_of()
    others = (LINK_INDEX["left_forearm"] + 1) % 3
    in_turns.add(forearm_cloud(), T_REST, others, 3)
    assert in_turns.point_count < 0.2 * at_once.point_count
    for turn in {0, 1, 2} - {others}:
        in_turns.add(forearm_cloud(), T_REST, turn, 3)
    np.testing.assert_array_equal(in_turns.surface().points, at_once.surface().points)


def thickness_m(body: BodyModel) -> float:
    """How far points lie from the forearm's tube at most, away from its ends."""
    points = body.surface().points
    return float(np.abs(np.linalg.norm(points[:, 1:], axis=1) - 0.035)[np.abs(points[:, 0] - 0.11) < 0.05].max())


def test_points_seen_once_among_many_frames_are_noise() -> None:
    flying = forearm_cloud(1, 0.03, 12)
    assert thickness_m(body_of(flying)) > 0.025
    assert thickness_m(body_of(flying, *(forearm_cloud(seed, 0.001, 2000) for seed in range(0, 20, 2)))) < 0.01


def half_of(cloud: PointCloud, upper: bool) -> PointCloud:
    kept = (cloud.normals[:, 1] > 0) == upper
    return PointCloud(cloud.positions[kept], cloud.normals[kept], cloud.colours[kept])


def test_a_side_that_turns_up_late_becomes_surface_once_it_was_seen_again() -> None:
    body = body_of(*(half_of(forearm_cloud(seed), True) for seed in range(8)))
    certain = np.ones(LINK_COUNT, bool)
    late = half_of(forearm_cloud(20, count=900), False)
    body.surface()
    body.add_unseen(late, T_REST, certain)
    assert body.surface().normals[:, 1].min() > -0.5  # seen once: may be noise
    body.add_unseen(late, T_REST, certain)
    assert body.surface().normals[:, 1].min() < -0.9


def test_nothing_is_learned_for_uncertain_links_or_from_far_away() -> None:
    body = body_of(forearm_cloud())
    count = body.point_count
    late = forearm_cloud(20)
    body.add_unseen(late, T_REST, np.zeros(LINK_COUNT, bool))
    far = PointCloud(late.positions + np.float32([0, 0.3, 0.0]), late.normals, late.colours)
    body.add_unseen(far, T_REST, np.ones(LINK_COUNT, bool))
    assert body.point_count == count


def test_thick_shells_are_thinned_towards_their_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    def scatter_m() -> float:
        thick = body_of(*(forearm_cloud(seed, 0.015, 2000) for seed in range(0, 16, 2)))
        return float(np.abs(np.linalg.norm(thick.surface().points[:, 1:], axis=1) - 0.035).mean())

    thinned_m = scatter_m()
    monkeypatch.setattr(link_cells, "THICK_M", np.inf)
    assert thinned_m < 0.8 * scatter_m()


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_cells, "MAX_POINTS_PER_LINK", 150)
    body = body_of(*(forearm_cloud(seed, 0.01, 1500) for seed in range(4)))
    assert body.point_count <= 150 * LINK_COUNT
    assert max(len(cells.keys) for cells in body._cells) == 150


def test_grids_follow_a_few_links_at_a_time() -> None:
    body = body_of(forearm_cloud())
    before = body.surface()
    body.add(forearm_cloud(7), T_REST)
    assert body.surface(0) is before  # nothing renewed, nothing changed
    while (now := body.surface(1)) is before:
        pass
    assert len(now.points) >= len(before.points)
    links, rows, d2 = np.empty(10, np.int64), np.empty(10, np.int64), np.empty(10)
    near = all_near(10, np.array([LINK_INDEX["left_forearm"]]), LINK_COUNT)
    cloud = forearm_cloud(7)
    R, t = T_REST[:, :3, :3].astype(np.float64), T_REST[:, :3, 3].astype(np.float64)
    match_points(cloud.positions[:10], cloud.normals[:10], tints(cloud.colours[:10]), *near, R, t, now, links, rows, d2)
    assert (np.sqrt(d2) < 0.025).all()


def owner_of(body: BodyModel, point: PointCloud) -> int:
    """Link whose surface ``point`` is matched with."""
    links, rows, d2 = np.empty(1, np.int64), np.empty(1, np.int64), np.empty(1)
    near = all_near(1, np.array([LINK_INDEX["left_forearm"], LINK_INDEX["right_forearm"]]), LINK_COUNT)
    R, t = T_REST[:, :3, :3].astype(np.float64), T_REST[:, :3, 3].astype(np.float64)
    surface = body.surface()
    match_points(point.positions, point.normals, tints(point.colours), *near, R, t, surface, links, rows, d2)
    return int(links[0])


@pytest.mark.parametrize("exposure", [0.6, 1.0])
def test_a_point_between_two_links_goes_to_the_one_of_its_colour_however_bright(exposure: float) -> None:
    up, skin, cloth = np.float32([[0, 0, 1]]), (210, 150, 120), (40, 60, 160)
    point = np.float32([[0, 0.9, 0]])
    for match_colours, expected in ((True, "right_forearm"), (False, "left_forearm")):
        body = BodyModel(SKELETON, match_colours)
        for side, colour, away in (("left", skin, 0.012), ("right", cloth, 0.018)):
            one = PointCloud(point + np.float32([0, away, 0]), up, np.array([colour], np.uint8))
            body.add_assigned(one, T_REST, np.array([LINK_INDEX[f"{side}_forearm"]]))
        seen = PointCloud(point, up, (np.array([cloth]) * exposure).astype(np.uint8))
        assert owner_of(body, seen) == LINK_INDEX[expected]


def test_saved_and_loaded_body_has_the_same_surface() -> None:
    body = body_of(forearm_cloud(0), forearm_cloud(3))
    loaded = BodyModel.from_bytes(body.to_bytes())
    np.testing.assert_array_equal(loaded.skeleton.offsets, body.skeleton.offsets)
    np.testing.assert_allclose(loaded.surface().points, body.surface().points, atol=1e-5)
    assert loaded.to_bytes() == BodyModel.from_bytes(loaded.to_bytes()).to_bytes()


def repacked(**changes: np.ndarray) -> bytes:
    """A saved body with some arrays replaced."""
    with np.load(io.BytesIO(body_of(forearm_cloud()).to_bytes())) as stored:
        arrays = {name: stored[name] for name in stored.files} | changes
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"version": np.int32(9)}, "version 9"),
        ({"counts": np.zeros(3, np.int32)}, "do not fit 23 links"),
        ({"counts": np.full(LINK_COUNT, 10**6)}, "do not fit 23 links"),
        ({"sums": np.zeros((2, 10))}, "do not match their counts"),
        ({"offsets": np.full((LINK_COUNT, 3), np.nan)}, "offsets"),
        ({"radii": np.zeros(LINK_COUNT)}, "radii"),
        ({"tips": np.array("text")}, "body model"),
    ],
)
def test_implausible_contents_are_refused_with_the_reason(changes: dict[str, np.ndarray], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        BodyModel.from_bytes(repacked(**changes))


def test_objects_are_never_unpickled() -> None:
    with pytest.raises(ValueError, match=r"pickle|readable"):
        BodyModel.from_bytes(repacked(counts=np.array([{}], dtype=object)))


SAVED = body_of(forearm_cloud()).to_bytes()


@settings(max_examples=60, deadline=None)
@given(
    cut=st.integers(0, len(SAVED) - 1), flips=st.lists(st.tuples(st.integers(0, len(SAVED) - 1), st.integers(1, 255)))
)
def test_broken_bytes_raise_only_value_error(cut: int, flips: list[tuple[int, int]]) -> None:
    data = bytearray(SAVED)
    for position, mask in flips:
        data[position] ^= mask
    for broken in (bytes(data), bytes(data[:cut])):
        try:
            BodyModel.from_bytes(broken)
        except ValueError:
            continue
