"""Points near links, and their closest compatible surface: against plain searches over everything."""

import numpy as np

from common.body.skeleton import LINK_COUNT, LINK_INDEX, human_skeleton
from common.body.skeleton_pose import forward_kinematics, rest_pose
from common.geometry.point_cloud import PointCloud
from sender.fitting.body_model import BodyModel
from sender.fitting.surface_matching import NORMAL_GATE, match_points, near_links, tints

SKELETON = human_skeleton(1.7)
T_REST = forward_kinematics(SKELETON, rest_pose(np.array([0.0, 0.9, 0.0])))
R, T = T_REST[:, :3, :3].astype(np.float64), T_REST[:, :3, 3].astype(np.float64)
ARMS = [LINK_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in ("upper_arm", "forearm")]
GATE_M = 0.05


def ball(count: int, centre: np.ndarray, radius_m: float, seed: int) -> PointCloud:
    """Points of a sphere, facing outwards."""
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    positions = (centre + radius_m * normals).astype(np.float32)
    return PointCloud(positions, normals, np.full((count, 3), 90, np.uint8))


def body_with_arms() -> BodyModel:
    body = BodyModel(SKELETON)
    for seed, link in enumerate(ARMS):
        cloud = ball(900, T[link], 0.08, seed)
        body.add_assigned(cloud, T_REST, np.full(len(cloud), link))
    return body


SURFACE = body_with_arms().surface()
SEEN = PointCloud(
    *(
        np.concatenate(parts)
        for parts in zip(
            *(
                (cloud.positions, cloud.normals, cloud.colours)
                for cloud in (ball(150, T[link] + [0.02, 0.01, 0.0], 0.09, 20 + link) for link in ARMS)
            ),
            strict=True,
        )
    )
)


def in_link(link: int) -> np.ndarray:
    return (SEEN.positions - T[link]) @ R[link]


def test_a_link_has_the_points_in_its_grown_box_and_no_other() -> None:
    first, members = near_links(SEEN.positions, R, T, SURFACE, GATE_M)
    assert len(members) == first[-1] > 0
    for link in range(LINK_COUNT):
        own = in_link(link)
        inside = ((own > SURFACE.low[link] - GATE_M) & (own < SURFACE.high[link] + GATE_M)).all(axis=1)
        expected = np.flatnonzero(inside) if link in ARMS else np.empty(0, int)
        np.testing.assert_array_equal(members[first[link] : first[link + 1]], expected)


def test_a_match_is_the_closest_surface_but_for_the_size_of_a_cell() -> None:
    link, row, d2 = np.empty(len(SEEN), np.int64), np.empty(len(SEEN), np.int64), np.empty(len(SEEN))
    first, members = near_links(SEEN.positions, R, T, SURFACE, GATE_M)
    match_points(SEEN.positions, SEEN.normals, tints(SEEN.colours), first, members, R, T, SURFACE, link, row, d2)
    ends = [*SURFACE.first_point[1:], len(SURFACE.points)]
    least = np.full(len(SEEN), np.inf)
    for one in ARMS:
        own, facing = in_link(one), SEEN.normals @ R[one]
        rows = slice(SURFACE.first_point[one], ends[one])
        apart = np.linalg.norm(own[:, None] - SURFACE.points[None, rows], axis=2)
        apart[facing @ SURFACE.normals[rows].T < NORMAL_GATE] = np.inf
        least = np.minimum(least, apart.min(axis=1))
    assert (link >= 0).all()
    found = np.sqrt(d2)
    assert (found > least - 1e-4).all()
    assert np.percentile(found - least, 95) < 0.01
    for n in range(0, len(SEEN), 37):  # what is told of a match is true of it
        point = (SEEN.positions[n] - T[link[n]]) @ R[link[n]]
        assert abs(np.linalg.norm(point - SURFACE.points[row[n]]) - found[n]) < 1e-4
