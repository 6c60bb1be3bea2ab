"""DISPOSE Eq. (1)–(2) against a plain second computation, and the properties the paper states."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from common.body.body_regions import (
    REGION_COUNT,
    REGION_INDEX,
    REGION_LINKS,
    REGION_NAMES,
    default_region_weights,
)
from common.body.distortion_score import (
    START_THRESHOLD,
    SessionThreshold,
    distortion_score,
    distortion_scores,
    region_scores,
)
from common.body.joint_edges import joint_edges
from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton_pose import SkeletonPose
from common.body.skinning import animate, link_motion
from common.body.vertex_regions import vertex_regions
from tests.capsule_person import SKELETON
from tests.capsule_views import arms_down_by, captured, links_of

WEIGHTS = default_region_weights()
EQUAL = np.ones(REGION_COUNT, np.float32)


def regions_of(mesh: RiggedMesh) -> np.ndarray:
    return vertex_regions(mesh.mesh.vertices, mesh.vertex_link, SKELETON, mesh.T_link_world)


def captured_whole(angle_rad: float) -> RiggedMesh:
    """A mesh with all its joint edges, of which others have a sample."""
    mesh = captured(angle_rad)
    edges = joint_edges(mesh.mesh.vertices, mesh.mesh.faces, regions_of(mesh), mesh.T_link_world, most=10**9)
    return dataclasses.replace(mesh, joint_edges=edges)


def by_the_book(mesh: RiggedMesh, pose: SkeletonPose) -> np.ndarray:
    """Animate everything, take every edge of every triangle, Eq. (1) per region; NaN for regions without edges."""
    before, after = mesh.mesh.vertices, animate(mesh, link_motion(mesh, links_of(pose)), "rigid")
    pairs = {
        (min(a, b), max(a, b))
        for face in mesh.mesh.faces.tolist()
        for a, b in zip(face, face[1:] + face[:1], strict=True)
    }
    ends = np.array(sorted(pairs))
    length = np.linalg.norm(before[ends[:, 0]] - before[ends[:, 1]], axis=1)
    change = np.abs(np.linalg.norm(after[ends[:, 0]] - after[ends[:, 1]], axis=1) - length)
    regions = regions_of(mesh)[ends]
    scores = np.full(REGION_COUNT, np.nan)
    for region in range(REGION_COUNT):
        links = REGION_LINKS[regions]
        deformable = (regions == region).any(axis=1) & (links[:, 0] != links[:, 1])
        if deformable.any():
            scores[region] = change[deformable].sum() / length[deformable].sum()
    return scores


@pytest.mark.parametrize("weights", [EQUAL, WEIGHTS], ids=["equal", "default"])
@pytest.mark.parametrize("angle_rad", [0.2, 1.3])
def test_it_is_the_papers_equation(angle_rad: float, weights: np.ndarray) -> None:
    mesh, target = captured_whole(0.8), arms_down_by(angle_rad, turned_rad=0.4)
    expected = np.nanmean(weights * by_the_book(mesh, target))
    assert expected > 0.01
    assert distortion_score(mesh, links_of(target), weights) == pytest.approx(expected, rel=2e-3)


def test_each_regions_score_is_told_by_name() -> None:
    mesh, target = captured_whole(0.8), arms_down_by(0.2)
    scores, expected = region_scores(mesh, links_of(target)), by_the_book(mesh, target)
    assert scores.shape == (len(REGION_NAMES),)
    np.testing.assert_allclose(scores, expected, rtol=2e-3, atol=1e-4)
    moved = [REGION_INDEX["left_clavicle"], REGION_INDEX["right_upper_arm"]]
    assert scores[moved].min() > 10 * scores[REGION_INDEX["left_shin"]]
    assert np.nanmean(WEIGHTS * scores) == pytest.approx(distortion_score(mesh, links_of(target), WEIGHTS), rel=1e-4)


@pytest.mark.parametrize("angle_rad", [0.2, 0.5, 1.3])
def test_a_sample_of_the_edges_gives_nearly_the_same(angle_rad: float) -> None:
    whole, target = captured_whole(0.8), links_of(arms_down_by(angle_rad, turned_rad=0.4))
    assert len(captured(0.8).joint_edges) < 0.7 * len(whole.joint_edges)
    expected = distortion_score(whole, target, WEIGHTS)
    assert distortion_score(captured(0.8), target, WEIGHTS) == pytest.approx(expected, rel=0.05)


def test_a_region_nobody_saw_has_no_score() -> None:
    mesh = captured(0.8)
    seen = regions_of(mesh)
    kept = ~(seen[mesh.mesh.faces] == REGION_INDEX["head"]).any(axis=1)
    beheaded = dataclasses.replace(mesh.mesh, faces=mesh.mesh.faces[kept])
    scrap = dataclasses.replace(
        mesh, joint_edges=joint_edges(beheaded.vertices, beheaded.faces, seen, mesh.T_link_world)
    )
    scores = region_scores(scrap, links_of(arms_down_by(0.2)))
    assert np.isnan(scores[REGION_INDEX["head"]])
    assert np.isfinite(scores[REGION_INDEX["left_forearm"]])


def test_its_own_skeleton_costs_nothing() -> None:
    assert distortion_score(captured(0.8), links_of(arms_down_by(0.8)), WEIGHTS) < 1e-4


def test_moving_and_turning_the_whole_person_costs_nothing() -> None:
    assert distortion_score(captured(0.8), links_of(arms_down_by(0.8, turned_rad=2.0)), WEIGHTS) < 1e-3


def test_it_grows_with_the_motion() -> None:
    scores = [distortion_score(captured(0.4), links_of(arms_down_by(a)), WEIGHTS) for a in (0.4, 0.6, 0.9, 1.3)]
    assert scores == sorted(scores)
    assert scores[-1] > 3 * scores[1] > 0


def test_it_is_not_commutative() -> None:
    """Arms at the sides are joined to the body; spread arms are not: only one way something tears."""
    down, out = 1.4, 0.3
    from_down = distortion_score(captured(down, cameras=1), links_of(arms_down_by(out)), WEIGHTS)
    from_out = distortion_score(captured(out, cameras=1), links_of(arms_down_by(down)), WEIGHTS)
    assert from_down > 1.5 * from_out


def test_a_batch_scores_like_one_by_one() -> None:
    mesh = captured(0.8)
    targets = np.stack([links_of(arms_down_by(a)) for a in (0.1, 0.8, 1.2)])
    batch = distortion_scores(mesh.joint_edges, targets, WEIGHTS)
    np.testing.assert_allclose(batch, [distortion_score(mesh, T, WEIGHTS) for T in targets], rtol=1e-6)
    assert batch.dtype == np.float32
    assert len(distortion_scores(mesh.joint_edges, targets[:0], WEIGHTS)) == 0


def test_a_regions_weight_counts() -> None:
    target = links_of(arms_down_by(1.3))
    without = EQUAL.copy()
    without[[REGION_INDEX["left_upper_arm"], REGION_INDEX["right_upper_arm"]]] = 0
    assert distortion_score(captured(0.4), target, without) < 0.9 * distortion_score(captured(0.4), target, EQUAL)


def test_a_mesh_without_joint_edges_cannot_be_judged() -> None:
    mesh = captured(0.8)
    one_link = np.zeros_like(mesh.vertex_link)  # region 0 is link 0
    scrap = dataclasses.replace(
        mesh,
        vertex_link=one_link,
        joint_edges=joint_edges(mesh.mesh.vertices, mesh.mesh.faces, one_link, mesh.T_link_world),
    )
    assert distortion_score(scrap, links_of(arms_down_by(0.8)), WEIGHTS) == float("inf")


def test_threshold_starts_at_the_papers_and_follows_the_session() -> None:
    threshold = SessionThreshold(memory_frames=10)
    assert threshold.value == START_THRESHOLD
    for sigma in (1.0, 2.0, 3.0):
        threshold.follow(sigma)
    assert threshold.value == pytest.approx(2.0)
    for _ in range(100):
        threshold.follow(0.5)
    assert threshold.value == pytest.approx(0.5, rel=0.01)
    threshold.follow(float("inf"))
    assert np.isfinite(threshold.value)
