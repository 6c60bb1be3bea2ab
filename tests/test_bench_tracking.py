"""The measuring side of the tracking bench: errors, lost frames, flips and what a tracker is shown."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from common.body.skeleton import NAMED_JOINT_LINKS
from common.body.skeleton_pose import SkeletonPose, forward_kinematics, rest_pose
from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from scripts.bench_tracking import CONTESTANTS, contestant, means
from scripts.run_bench import Row, kept
from scripts.tracking_conditions import (
    Sight,
    condition,
    noisy,
    performer_for,
    sights,
    surface_points,
    textured_points,
)
from scripts.tracking_run import FLIP_RATE_HZ, Case, Result, Run, flips, is_clean
from sender.capture.skinned_body import PerformerMesh
from sender.fitting.tracker import FitResult
from tests.capsule_person import SKELETON, pose_at

DATA = Path(__file__).parents[1] / "../shared/data"
needs_data = pytest.mark.skipif(not DATA.exists(), reason="bodies and motion capture not there (../shared/data)")
NOTHING = PointCloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))
BALL = np.array([[0, -2, 0], [0, 2, 0]], np.float32)  # R = 2 m


def fitted(pose: SkeletonPose, seen: bool = True) -> FitResult:
    confidence = np.full(len(pose.confidence), float(seen), np.float32)
    return FitResult(SKELETON, SkeletonPose(pose.root_position, pose.rotations, confidence), True, 1, 1.0, 0.0, 1.0)


def joints_of(pose: SkeletonPose) -> np.ndarray:
    return forward_kinematics(SKELETON, pose)[NAMED_JOINT_LINKS][:, :3, 3]


def sight(time_s: float, joints: np.ndarray) -> Sight:
    return Sight(time_s, NOTHING, BALL, joints.astype(np.float32))


def test_e_t_is_the_mean_joint_distance_over_the_radius_of_the_bounding_ball() -> None:
    pose, run = rest_pose(), Run()
    truth = joints_of(pose)
    truth[0] += [0.3, 0, 0.4]  # one joint of 16 is 0.5 m away
    run.add(fitted(pose), 0.004, sight(0.0, truth))
    run.add(fitted(pose), 0.002, sight(0.1, joints_of(pose)))
    metrics = run.metrics()
    assert metrics["e_t_max"] == pytest.approx(0.5 / 16 / 2, rel=1e-5)
    assert metrics["e_t_mean"] == pytest.approx(0.5 / 16 / 2 / 2, rel=1e-5)
    assert metrics["ms_per_frame_p50"] == pytest.approx(3.0)


def test_alignment_takes_away_what_is_constant_in_the_links_frame_and_no_more() -> None:
    fixed, drifting = Run(), Run()
    for frame in range(40):
        pose = pose_at(frame / 10)
        T = forward_kinematics(SKELETON, pose)[NAMED_JOINT_LINKS].astype(float)
        offset = np.einsum("jab,b->ja", T[:, :3, :3], [0.02, 0.01, 0.0])
        fixed.add(fitted(pose), 0.0, sight(frame / 30, T[:, :3, 3] + offset))
        drifting.add(fitted(pose), 0.0, sight(frame / 30, T[:, :3, 3] + offset * frame / 20))
    assert fixed.metrics()["e_t_mean"] == pytest.approx(np.hypot(0.02, 0.01) / 2, rel=1e-4)
    assert fixed.metrics()["e_t_mean_aligned"] < 1e-6
    assert drifting.metrics()["e_t_mean_aligned"] > 0.003


def test_lost_are_frames_too_far_off_guessed_or_without_a_skeleton_but_not_those_before_the_first() -> None:
    pose, run = rest_pose(), Run()
    here = joints_of(pose)
    run.add(None, 0.0, sight(0.0, here))
    run.add(fitted(pose, seen=False), 0.0, sight(0.1, here))
    assert run.metrics()["lost_share"] == 1.0
    run.add(fitted(pose), 0.0, sight(0.2, here))
    run.add(fitted(pose), 0.0, sight(0.3, here + np.array([0, 0.099, 0])))  # 0.0495 R
    run.add(fitted(pose), 0.0, sight(0.4, here + np.array([0, 0.101, 0])))  # 0.0505 R: lost
    run.add(fitted(pose, seen=False), 0.0, sight(0.5, here))  # lost
    run.add(None, 0.0, sight(0.6, here))  # lost
    assert run.metrics()["lost_share"] == pytest.approx(3 / 5)
    assert run.metrics()["time_to_skeleton_s"] == 0.2


def test_lost_is_judged_without_alignment() -> None:
    run = Run()
    for frame in range(10):
        pose = pose_at(frame / 10)
        T = forward_kinematics(SKELETON, pose)[NAMED_JOINT_LINKS].astype(float)
        run.add(fitted(pose), 0.0, sight(frame / 30, T[:, :3, 3] + T[:, :3, 0] * 0.12))
    assert run.metrics()["e_t_mean_aligned"] < 1e-6
    assert run.metrics()["lost_share"] == 1.0


def test_a_joint_that_flips_is_found_at_its_frames_and_fast_motion_is_none() -> None:
    times = np.arange(60) / FLIP_RATE_HZ
    swing = 1.2 * np.sin(2 * np.pi * 2.5 * times)  # at most 19 rad/s: a fast wave
    turned = np.stack([np.zeros_like(swing), swing, np.zeros_like(swing)], axis=1)
    rotations = np.stack([quaternion.from_rotation_vector(turned), quaternion.from_rotation_vector(0.2 * turned)], 1)
    assert not flips(rotations).any()
    half_turn = quaternion.from_rotation_vector(np.array([0.0, 0.0, np.pi]))
    rotations[30:33, 1] = quaternion.multiply(rotations[30:33, 1], half_turn)
    rotations[30:33, 1] *= -1  # the same rotations
    assert np.flatnonzero(flips(rotations)).tolist() == [29, 32]


def test_a_clip_with_a_few_flips_is_clean() -> None:
    assert is_clean(0, 200)
    assert is_clean(19, 1198)
    assert not is_clean(4, 200)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("points-given", (0, 2500, 30.0, 0.0)),
        ("depth1-auto", (1, 2500, 30.0, 0.0)),
        ("share2-given", (0, 200, 30.0, 0.0)),
        ("15fps-unposed", (0, 2500, 15.0, 0.0)),
        ("noise3cm-auto", (0, 2500, 30.0, 0.03)),
        ("scatter3cm-auto", (0, 2500, 30.0, 0.03)),
    ],
)
def test_conditions_by_name(name: str, expected: tuple[int, int, float, float]) -> None:
    seen = condition(name)
    assert (seen.cameras, seen.points, seen.frame_rate_hz, seen.noise_m) == pytest.approx(expected)
    assert name == f"{name.partition('-')[0]}-{seen.start}"


@pytest.mark.parametrize("name", ["points", "points-", "depth-auto", "depth99-auto", "share0-given", "0fps-auto"])
def test_what_is_no_condition_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"condition '{name}'"):
        condition(name)


def test_noise_moves_points_as_said_and_their_normals_come_from_the_noisy_surface() -> None:
    random = np.random.default_rng(0)
    square = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    plane = surface_points(square, faces, np.zeros((4, 3), np.uint8), 10_000, random)
    assert np.ptp(plane.normals[:, 1]) == 0
    for noise_m, tilt_deg in ((0.01, (0.5, 3)), (0.03, (3, 10))):
        cloud = noisy(plane, 2500, noise_m, random)
        assert len(cloud) == 2500
        assert cloud.positions[:, 1].std() == pytest.approx(noise_m, rel=0.1)
        np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
        cosines = (cloud.normals * plane.normals[:2500]).sum(axis=1)
        assert cosines.min() >= 0
        assert tilt_deg[0] < np.degrees(np.median(np.arccos(np.clip(cosines, -1, 1)))) < tilt_deg[1]


def test_scattered_points_move_by_a_distance_of_the_sigma_in_every_direction() -> None:
    random = np.random.default_rng(0)
    still = PointCloud(
        np.zeros((4000, 3), np.float32), np.tile(np.float32([0, 1, 0]), (4000, 1)), np.zeros((4000, 3), np.uint8)
    )
    moved = noisy(still, 4000, 0.03, random, scattered=True).positions
    assert np.sqrt((moved**2).sum(axis=1).mean()) == pytest.approx(0.03, rel=0.05)
    assert moved.std(axis=0) == pytest.approx(np.full(3, 0.03 / np.sqrt(3)), rel=0.08)


def test_points_have_the_colours_of_the_texture() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    texture = np.zeros((10, 10, 3), np.uint8)
    texture[:, 5:] = 200
    mesh = PerformerMesh(
        np.array([[0, 2, 1]], np.int32), np.zeros((3, 3), np.uint8), corners[:, [0, 2]], texture
    )  # fmt: skip
    cloud = textured_points(corners, mesh, 500, np.random.default_rng(0))
    np.testing.assert_array_equal(cloud.colours[:, 0] == 200, cloud.positions[:, 0] >= 0.5)


def test_the_built_in_film_has_the_condition_it_is_asked_for() -> None:
    seen = condition("15fps-given")
    frames = list(sights(performer_for(seen, "builtin", None, None), seen, 0.5))
    assert [frame.time_s for frame in frames] == pytest.approx(np.arange(7) / 15)
    assert {len(frame.cloud) for frame in frames} == {2500}
    unposed = condition("points-unposed")
    performer = performer_for(unposed, "builtin", None, None)
    first = next(iter(sights(performer, unposed, 0.5)))
    assert first.time_s == 0
    np.testing.assert_array_equal(first.joints, performer.named_joints(2.0))


@needs_data
def test_a_clip_that_travels_is_kept_before_the_cameras_and_its_limbs_move_as_before() -> None:
    travelling = performer_for(condition("points-given"), "male_avg", "127_04", DATA)
    kept_there = performer_for(condition("depth4-auto"), "male_avg", "127_04", DATA)
    times = np.arange(2.0, travelling.motion_s, 0.1)
    free = np.array([travelling.named_joints(t) for t in times], float)
    held = np.array([kept_there.named_joints(t) for t in times], float)
    assert np.ptp(free[:, 0, [0, 2]], axis=0).max() > 3.0
    assert np.linalg.norm(held[..., [0, 2]], axis=2).max() < 1.3  # nearest to a camera: 1.4 m
    np.testing.assert_allclose(held - held[:, :1], free - free[:, :1], atol=1e-5)
    np.testing.assert_allclose(held[..., 1], free[..., 1], atol=1e-5)


def results() -> list[Result]:
    rows = []
    for clip, flipped, e_t in (("a", 0, 0.01), ("b", 1, 0.03), ("c", 40, 0.2)):
        metrics = {"e_t_mean": e_t, "e_t_max": 2 * e_t, "lost_share": 0.0}
        rows.append(Result(Case("t", "body", clip, "points-auto", None, None), metrics, flipped, 200, [], []))
    never = Result(Case("t", "body", "d", "points-auto", None, None), {"lost_share": 1.0}, 0, 200, [], [])
    return [*rows, never]


def test_means_are_over_clean_clips_and_over_the_others() -> None:
    rows = {(row["case"], row["metric"]): row["value"] for row in means(results())}
    clean, others = "t/all/clean clips/points-auto", "t/all/clips with flips/points-auto"
    assert rows[clean, "e_t_mean"] == pytest.approx(0.02)
    assert rows[clean, "e_t_max"] == pytest.approx(0.06)
    assert rows[clean, "lost_share"] == pytest.approx(1 / 3)
    assert rows[others, "e_t_mean"] == pytest.approx(0.2)


def test_a_bench_cut_off_keeps_the_cases_it_has_done(tmp_path: Path) -> None:
    def row(case: str, value: float) -> Row:
        return {"case": case, "metric": "m", "value": value, "unit": "1", "reference": None, "source": ""}

    def rows() -> Iterator[Row]:
        yield from (row("a", 1.0), row("a", 2.0), row("b", 3.0))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kept(rows(), "some", tmp_path / "out.json")
    assert json.loads((tmp_path / "out.json").read_text()) == {"bench": "some", "rows": [row("a", 1.0), row("a", 2.0)]}


def test_every_contestant_opens_and_has_seen_nothing() -> None:
    assert {"gauss-newton", "gauss-newton-colours", "articp", "articp-no-global"} <= set(CONTESTANTS)
    for name in CONTESTANTS:
        assert contestant(name).track(NOTHING, 0) is None
