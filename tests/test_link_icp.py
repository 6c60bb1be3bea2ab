"""Clustered k-d trees against brute force, and ICP of one link: known motions, fixed joints, Theorem 5.1."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from sender.fitting.clustered_kdtree import (
    STACK,
    ClusterBins,
    ClusteredKdTree,
    build_clustered_tree,
    colour_cells,
    nearest,
    normal_cells,
)
from sender.fitting.link_icp import IcpStop, best_motion, fit_link, partner_distances

BINS = ClusterBins()
ONE = ClusterBins(1, 1, 1, 1)
LONG = IcpStop(tau_m=0.0, stall_m=0.0, iterations=25)
bins_of_any_kind = st.builds(ClusterBins, st.integers(1, 8), st.integers(1, 12), st.integers(1, 4), st.integers(1, 8))


def random_cloud(seed: int, count: int) -> PointCloud:
    random = np.random.default_rng(seed)
    return PointCloud(
        random.normal(size=(count, 3)).astype(np.float32) * np.float32(0.3),
        quaternion.normalized(random.normal(size=(count, 3))).astype(np.float32),
        random.integers(0, 256, (count, 3)).astype(np.uint8),
    )


def ellipsoid(seed: int, count: int) -> PointCloud:
    """Points on a limb-like body beside the origin, which is its joint."""
    random, radii = np.random.default_rng(seed), np.array([0.05, 0.15, 0.08])
    unit = quaternion.normalized(random.normal(size=(count, 3)))
    normals = quaternion.normalized(unit / radii)
    positions = unit * radii + [0.0, -0.15, 0.0]
    return PointCloud(positions.astype(np.float32), normals.astype(np.float32), np.zeros((count, 3), np.uint8))


def clusters(cloud: PointCloud, bins: ClusterBins) -> np.ndarray:
    normal = normal_cells(cloud.normals.astype(np.float64), bins.latitudes, bins.longitudes)
    return np.asarray(normal * bins.colour_cells + colour_cells(cloud.colours, bins))


def find(
    tree: ClusteredKdTree, cluster: int, p: np.ndarray, best: int = -1, least: float = np.inf
) -> tuple[int, float]:
    return nearest(tree, cluster, p, best, least, np.empty((STACK, 2), np.int64), np.empty(STACK))


# --- the clustered tree -----------------------------------------------------------------------------------------------


@given(st.integers(0, 10_000), st.integers(0, 400), bins_of_any_kind)
@settings(max_examples=40, deadline=None)
def test_nearest_is_what_brute_force_finds_in_the_neighbouring_clusters(
    seed: int, count: int, bins: ClusterBins
) -> None:
    cloud, asking = random_cloud(seed, count), random_cloud(seed + 1, 10)
    tree, of_point = build_clustered_tree(cloud, bins), clusters(cloud, bins)
    np.testing.assert_array_equal(np.sort(tree.rows), np.arange(count))
    for p, cluster in zip(asking.positions.astype(np.float64), clusters(asking, bins), strict=True):
        own = tree.neighbours[tree.first_neighbour[cluster] : tree.first_neighbour[cluster + 1]]
        squared = np.where(np.isin(of_point, own), ((cloud.positions - p) ** 2).sum(axis=1), np.inf)
        row, found = find(tree, int(cluster), p)
        assert found == pytest.approx(squared.min(initial=np.inf), rel=1e-6)
        assert (row < 0) == np.isinf(found)
        if row >= 0:
            assert squared[tree.rows[row]] == pytest.approx(found, rel=1e-6)
            assert find(tree, int(cluster), p, row, found) == (row, found)
            assert find(tree, int(cluster), p, -1, found * 0.99)[0] == -1


def test_without_bins_all_points_are_one_tree() -> None:
    cloud = random_cloud(0, 500)
    tree = build_clustered_tree(cloud, ONE)
    p = np.array([0.1, -0.2, 0.05])
    assert find(tree, 0, p)[1] == pytest.approx(((cloud.positions - p) ** 2).sum(axis=1).min(), rel=1e-6)


@given(st.integers(0, 10_000), bins_of_any_kind)
@settings(max_examples=40, deadline=None)
def test_like_points_are_in_neighbouring_clusters(seed: int, bins: ClusterBins) -> None:
    """No seam at the date line, the poles, red or grey: a hair's breadth away is always next door."""
    cloud = random_cloud(seed, 200)
    random = np.random.default_rng(seed)
    normals = quaternion.normalized(cloud.normals + random.normal(size=(200, 3)) * 0.01).astype(np.float32)
    colours = np.clip(cloud.colours.astype(int) + random.integers(-1, 2, (200, 3)), 0, 255).astype(np.uint8)
    bright = cloud.colours.max(axis=1) > 60  # between dark and not dark, hue and saturation jump
    beside = PointCloud(cloud.positions, normals, np.where(bright[:, None], colours, cloud.colours))
    tree = build_clustered_tree(cloud, bins)
    for own, other in zip(clusters(beside, bins), clusters(cloud, bins), strict=True):
        assert other in tree.neighbours[tree.first_neighbour[own] : tree.first_neighbour[own + 1]]


def test_opposite_normals_and_colours_are_not_partners() -> None:
    for normal, colour in (([0, 0, -1], [200, 30, 30]), ([0, 0, 1], [30, 200, 200])):
        here = PointCloud(np.zeros((1, 3), np.float32), np.float32([[0, 0, 1]]), np.uint8([[200, 30, 30]]))
        there = PointCloud(np.zeros((1, 3), np.float32), np.float32([normal]), np.uint8([colour]))
        assert find(build_clustered_tree(there, BINS), int(clusters(here, BINS)[0]), np.zeros(3)) == (-1, np.inf)


def test_bins_have_bounds() -> None:
    with pytest.raises(ValueError, match="hues: 0"):
        ClusterBins(hues=0)
    with pytest.raises(ValueError, match="latitudes: 99"):
        ClusterBins(latitudes=99)


# --- ICP --------------------------------------------------------------------------------------------------------------


@given(st.integers(0, 1000), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
@settings(max_examples=20, deadline=None)
def test_link_turns_about_its_joint(seed: int, x: float, y: float, z: float) -> None:
    link, joint = ellipsoid(seed, 400), np.array([0.4, 1.2, -0.3])
    truth = Rotation.from_rotvec([x, y, z])
    cloud = PointCloud(
        (truth.apply(link.positions) + joint).astype(np.float32), truth.apply(link.normals).astype(np.float32),
        link.colours,
    )  # fmt: skip
    fit = fit_link(link.positions + joint, link.normals.astype(np.float64), np.zeros(400, np.int64), joint,
                   build_clustered_tree(cloud, BINS), IcpStop(1e-5, 1e-7, 200))  # fmt: skip
    np.testing.assert_allclose(fit.rotation @ joint + fit.shift, joint, atol=1e-12)
    assert (Rotation.from_matrix(fit.rotation) * truth.inv()).magnitude() < 0.06
    moved = link.positions @ fit.rotation.T + fit.rotation @ joint + fit.shift
    assert np.sqrt(np.mean(np.sum((moved - cloud.positions) ** 2, axis=1))) < 0.008
    assert fit.pairs == 400


def test_free_link_also_moves() -> None:
    link = ellipsoid(3, 400)
    truth, shift = Rotation.from_rotvec([0.1, 0.0, 0.15]), np.array([0.03, -0.02, 0.04])
    cloud = PointCloud(
        (truth.apply(link.positions) + shift).astype(np.float32), truth.apply(link.normals).astype(np.float32),
        link.colours,
    )  # fmt: skip
    fit = fit_link(link.positions.astype(np.float64), link.normals.astype(np.float64), np.zeros(400, np.int64), None,
                   build_clustered_tree(cloud, BINS), IcpStop(1e-5, 1e-7, 200))  # fmt: skip
    np.testing.assert_allclose(fit.rotation, truth.as_matrix(), atol=0.01)
    np.testing.assert_allclose(fit.shift, shift, atol=0.003)


def test_icp_ends_at_tau_and_at_a_stall() -> None:
    link = ellipsoid(1, 300)
    tree = build_clustered_tree(ellipsoid(2, 300), BINS)
    at = link.positions.astype(np.float64), link.normals.astype(np.float64), np.zeros(300, np.int64), np.zeros(3), tree
    assert len(fit_link(*at, IcpStop(tau_m=1.0)).errors) == 1
    assert len(fit_link(*at, IcpStop(tau_m=0.0, stall_m=1.0)).errors) == 2
    assert len(fit_link(*at, IcpStop(tau_m=0.0, stall_m=-1.0, iterations=7)).errors) == 7


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_pairs_move_nothing(count: int) -> None:
    link = ellipsoid(1, 300)
    tree = build_clustered_tree(random_cloud(0, count), ONE)
    for points in (link.positions[:3], link.positions[:0]):
        n = len(points)
        fit = fit_link(points.astype(float), link.normals[:n].astype(float), np.zeros(n, np.int64), None, tree, LONG)
        np.testing.assert_array_equal(fit.rotation, np.eye(3))
        np.testing.assert_array_equal(fit.shift, 0.0)
        assert len(fit.errors) == 0


def test_partner_distances_are_cut_off() -> None:
    cloud = ellipsoid(1, 300)
    tree, none = build_clustered_tree(cloud, BINS), np.zeros(300, np.int64)
    points, normals = cloud.positions.astype(np.float64), cloud.normals.astype(np.float64)
    np.testing.assert_array_equal(partner_distances(points, normals, none, tree, 0.01), 0.0)
    assert np.isinf(partner_distances(points + 5.0, normals, none, tree, 0.01)).all()


# --- Theorem 5.1 ------------------------------------------------------------------------------------------------------


def errors_of(seed: int, renewed: bool) -> np.ndarray:
    """Eq. 1 over 12 iterations of ICP between unlike clouds with random normals. ``renewed``: each point's cluster is
    taken anew from its turned normal in each iteration, which the theorem forbids."""
    cloud, link = random_cloud(seed, 150), random_cloud(seed + 1, 40)
    tree = build_clustered_tree(cloud, BINS)
    points, normals = link.positions.astype(np.float64) + 0.2, link.normals.astype(np.float64)
    colours = colour_cells(link.colours, BINS)
    cells, errors = clusters(link, BINS), []
    for _ in range(12):
        if renewed:
            cells = normal_cells(normals, BINS.latitudes, BINS.longitudes) * BINS.colour_cells + colours
        found = [find(tree, int(cell), p) for cell, p in zip(cells, points, strict=True)]
        partner, squared = np.array([row for row, _ in found]), np.array([s for _, s in found])
        errors.append(squared[partner >= 0].mean())
        rotation, shift = best_motion(points, tree.points, partner, np.zeros(3), False)
        points, normals = points @ rotation.T + shift, np.ascontiguousarray(normals @ rotation.T)
    return np.array(errors)


@given(seed=st.integers(0, 100_000), jointed=st.booleans(), bins=bins_of_any_kind)
@settings(max_examples=60, deadline=None)
def test_error_never_rises(seed: int, jointed: bool, bins: ClusterBins) -> None:
    cloud, link = random_cloud(seed, 150), random_cloud(seed + 1, 40)
    fit = fit_link(link.positions.astype(np.float64) + 0.2, link.normals.astype(np.float64),
                   colour_cells(link.colours, bins), np.full(3, 0.1) if jointed else None,
                   build_clustered_tree(cloud, bins), LONG)  # fmt: skip
    assert (np.diff(fit.errors) <= 1e-12).all()


def test_error_rises_when_clusters_change_between_iterations() -> None:
    """What the theorem rests on: the very same ICP with clusters taken anew each time goes uphill now and then."""
    assert all((np.diff(errors_of(seed, renewed=False)) <= 1e-12).all() for seed in range(8))
    assert any((np.diff(errors_of(seed, renewed=True)) > 1e-6).any() for seed in range(8))
