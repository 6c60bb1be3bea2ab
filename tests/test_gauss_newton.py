"""The Gauss–Newton solver on a capsule person with known angles, and the tracker on the built-in performer."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common.body.skeleton import LINK_COUNT, LINK_INDEX, NAMED_JOINT_LINKS
from common.body.skeleton_pose import SkeletonPose, forward_kinematics, joint_positions, named_joint_positions
from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from scripts.fidelity import bounding_ball_radius
from scripts.tracking_conditions import surface_points
from sender.capture.performer import Performer, open_performer
from sender.fitting.articulated_gauss_newton import PoseState, Schedule, forward
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.body_model import BodyModel
from sender.fitting.gauss_newton_tracker import GaussNewtonSettings, GaussNewtonTracker
from sender.fitting.joint_limits import joint_table, rotation_exp, rotation_log, swing_twist_angles, turned_on
from sender.fitting.limb_search import limbs, search_limb
from sender.fitting.start_joints import skeleton_from_joints
from tests.capsule_person import SKELETON, capsule_person, pose_at

TABLE = joint_table()
PLAN = Schedule(8, 0.20, 0.06, 0.1, 1.0, 1.0)
FRAME_NS = 33_333_333
NOTHING = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))


def capsule_cloud(pose: SkeletonPose, count: int = 2000, seed: int = 0) -> PointCloud:
    mesh = capsule_person(0, pose).mesh
    colours = np.zeros((len(mesh.vertices), 3), np.uint8)
    return surface_points(mesh.vertices, mesh.faces, colours, count, np.random.default_rng(seed))


def state_of(pose: SkeletonPose) -> PoseState:
    return PoseState(pose.root_position.astype(np.float64), quaternion.to_matrix(pose.rotations.astype(np.float64)))


@cache
def capsule_body() -> BodyModel:
    body = BodyModel(SKELETON)
    for seed in range(4):
        body.add(capsule_cloud(pose_at(0.0), 3000, seed), forward_kinematics(SKELETON, pose_at(0.0)))
    return body


def joint_error_m(state: PoseState, truth: SkeletonPose) -> float:
    _, joints = forward(state.root, state.local, SKELETON.offsets.astype(np.float64), TABLE.parents)
    away = joints - joint_positions(SKELETON, truth)
    return float(np.linalg.norm(away[NAMED_JOINT_LINKS], axis=1).mean())


def random_matrix(seed: int) -> np.ndarray:
    return np.asarray(Rotation.random(random_state=seed).as_matrix())


# --- rotations and limits ---------------------------------------------------------------------------------------------


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_rotation_log_and_exp_are_inverse(seed: int) -> None:
    M, v, back = random_matrix(seed), np.empty(3), np.empty((3, 3))
    rotation_log(M, v)
    rotation_exp(v, back)
    np.testing.assert_allclose(back, M, atol=1e-6)
    np.testing.assert_allclose(v, Rotation.from_matrix(M).as_rotvec(), atol=1e-6)


@given(st.integers(0, 2), st.floats(-2.5, 2.5), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
@settings(max_examples=30, deadline=None)
def test_swing_and_twist_are_taken_apart(axis: int, twist: float, a: float, b: float) -> None:
    swing = np.zeros(3)
    swing[(axis + 1) % 3], swing[(axis + 2) % 3] = a, b
    M = (Rotation.from_rotvec(swing) * Rotation.from_rotvec(np.eye(3)[axis] * twist)).as_matrix()
    angles = np.empty(3)
    swing_twist_angles(M, axis, angles)
    np.testing.assert_allclose(angles, swing + np.eye(3)[axis] * twist, atol=1e-6)


def test_right_side_is_the_mirror_image_of_the_left() -> None:
    left, right = LINK_INDEX["left_forearm"], LINK_INDEX["right_forearm"]
    assert TABLE.low[left, 0] == TABLE.low[right, 0]
    np.testing.assert_allclose(TABLE.low[left, 1:], -TABLE.high[right, 1:])
    np.testing.assert_array_equal(np.bincount(TABLE.dof_link, minlength=LINK_COUNT)[[left, right]], 3)


def test_kernel_kinematics_agree_with_the_skeletons_own() -> None:
    pose = pose_at(1.3)
    R, t = forward(*state_of(pose), SKELETON.offsets.astype(np.float64), TABLE.parents)
    T = forward_kinematics(SKELETON, pose)
    np.testing.assert_allclose(R, T[:, :3, :3], atol=1e-5)
    np.testing.assert_allclose(t, T[:, :3, 3], atol=1e-5)


# --- one fit ----------------------------------------------------------------------------------------------------------


def test_fit_finds_a_pose_a_tenth_of_a_second_away() -> None:
    fitter = BodyFitter(capsule_body(), TABLE)
    truth = pose_at(0.4)
    start = state_of(pose_at(0.3))
    fit = fitter.fit(capsule_cloud(truth), start, start, PLAN)
    assert joint_error_m(start, truth) > 0.01
    assert joint_error_m(fit.pose, truth) < 0.006
    assert fit.inliers > 0.95
    assert fit.rms_m < 0.02
    assert fit.score < fitter.judge(capsule_cloud(truth), start).score


def test_fit_leaves_out_flying_points() -> None:
    truth, random = pose_at(0.4), np.random.default_rng(3)
    cloud = capsule_cloud(truth)
    noise = PointCloud(
        random.uniform(-1, 1, (600, 3)).astype(np.float32) + np.float32([0, 0.9, 0]),
        quaternion.normalized(random.normal(size=(600, 3))).astype(np.float32),
        np.zeros((600, 3), np.uint8),
    )
    mixed = PointCloud(
        *(np.concatenate([getattr(c, f) for c in (cloud, noise)]) for f in ("positions", "normals", "colours"))
    )
    start = state_of(pose_at(0.3))
    fit = BodyFitter(capsule_body(), TABLE).fit(mixed, start, start, PLAN)
    assert joint_error_m(fit.pose, truth) < 0.012
    assert fit.inliers < 0.9


def test_links_without_points_stay_and_are_not_explained() -> None:
    truth = pose_at(0.4)
    cloud = capsule_cloud(truth)
    upper = cloud.positions[:, 1] > 1.0
    start = state_of(pose_at(0.3))
    fit = BodyFitter(capsule_body(), TABLE).fit(
        PointCloud(cloud.positions[upper], cloud.normals[upper], cloud.colours[upper]), start, start, PLAN
    )
    foot = LINK_INDEX["left_foot"]
    assert fit.explained[foot] == 0
    assert Rotation.from_matrix(fit.pose.local[foot].T @ start.local[foot]).magnitude() < 0.1


def test_knees_do_not_bend_forwards() -> None:
    fitter = BodyFitter(capsule_body(), TABLE)
    state = state_of(pose_at(0.0))
    shin = LINK_INDEX["left_shin"]
    state.local[shin] = Rotation.from_rotvec([-1.2, 0, 0]).as_matrix()
    free = state
    for _ in range(6):
        free = fitter.fit(NOTHING, free, free, PLAN).pose
    angle = Rotation.from_matrix(free.local[shin]).as_rotvec()[0]
    assert angle > TABLE.low[shin, 0] - 0.05


def test_empty_cloud_has_the_worst_score() -> None:
    state = state_of(pose_at(0.0))
    fit = BodyFitter(capsule_body(), TABLE).judge(NOTHING, state)
    assert (fit.score, fit.inliers, fit.rms_m) == (1.0, 0.0, 0.0)


def test_lost_arm_is_found_again() -> None:
    truth = pose_at(0.0)
    cloud, fitter = capsule_cloud(truth), BodyFitter(capsule_body(), TABLE)
    lost = state_of(truth)
    lost.local[LINK_INDEX["left_upper_arm"]] = Rotation.from_rotvec([0, 0, 1.2]).as_matrix()
    lost.local[LINK_INDEX["left_forearm"]] = Rotation.from_rotvec([0, -2.2, 0]).as_matrix()
    arm = next(limb for limb in limbs(TABLE) if limb.links[0] == LINK_INDEX["left_upper_arm"])
    found = search_limb(arm, fitter.judge(cloud, lost), cloud, fitter, ())
    assert joint_error_m(lost, truth) > 0.03
    assert joint_error_m(fitter.fit(cloud, found, found, PLAN).pose, truth) < 0.01


# --- the tracker ------------------------------------------------------------------------------------------------------


@cache
def performer() -> Performer:
    return open_performer("builtin")


@cache
def cloud_at(frame: int, count: int = 1500) -> PointCloud:
    mesh = performer().mesh
    surface = performer().surface(frame / 30)
    return surface_points(surface, mesh.faces, mesh.vertex_colours, count, np.random.default_rng(frame))


def error_at(frame: int, tracker: GaussNewtonTracker, capture_ns: int) -> float:
    """e_t of the tracker's answer to one frame."""
    fit = tracker.track(cloud_at(frame), capture_ns)
    assert fit is not None
    joints = performer().named_joints(frame / 30)
    away = np.linalg.norm(named_joint_positions(fit.skeleton, fit.pose) - joints, axis=1).mean()
    return float(away / bounding_ball_radius(performer().surface(frame / 30)))


def started() -> GaussNewtonTracker:
    """A tracker that was given the first pose and has learned the surface."""
    tracker = GaussNewtonTracker(GaussNewtonSettings(building_s=0.3))
    skeleton, pose = skeleton_from_joints(performer().named_joints(0).astype(np.float64), 1.75)
    tracker.start_from(skeleton, pose, cloud_at(0), 0)
    for frame in range(1, 40):
        tracker.track(cloud_at(frame), frame * FRAME_NS)
    return tracker


@cache
def saved_body() -> bytes:
    body = started().body
    assert body is not None
    return body.to_bytes()


def test_tracker_starts_by_itself_and_follows() -> None:
    tracker = GaussNewtonTracker(GaussNewtonSettings(building_s=0.3))
    errors = [error_at(frame, tracker, frame * FRAME_NS) for frame in range(0, 120)]
    assert tracker.status == "tracking"
    assert max(errors) < 0.045
    assert np.mean(errors) < 0.03


def test_tracker_is_deterministic() -> None:
    def poses() -> list[np.ndarray]:
        tracker = GaussNewtonTracker(GaussNewtonSettings(), BodyModel.from_bytes(saved_body()))
        fits = [tracker.track(cloud_at(frame), frame * FRAME_NS) for frame in range(60, 66)]
        return [fit.pose.rotations for fit in fits if fit is not None]

    first, second = poses(), poses()
    assert len(first) == len(second) > 0
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("first_frame", [75, 130, 300])
def test_known_body_is_found_in_mid_motion(first_frame: int) -> None:
    tracker = GaussNewtonTracker(GaussNewtonSettings(), BodyModel.from_bytes(saved_body()))
    for frame in range(first_frame, first_frame + 6):
        tracker.track(cloud_at(frame), frame * FRAME_NS)
    assert error_at(first_frame + 6, tracker, (first_frame + 6) * FRAME_NS) < 0.02
    assert tracker.status == "tracking"


def test_frames_may_be_missing() -> None:
    tracker = started()
    errors = [error_at(frame, tracker, frame * FRAME_NS) for frame in range(42, 80, 3)]
    assert max(errors) < 0.03


def test_nobody_there_gives_none_and_later_the_last_pose() -> None:
    tracker = GaussNewtonTracker(GaussNewtonSettings())
    assert tracker.track(NOTHING, 0) is None
    assert "0 points" in tracker.status
    tracker = started()
    before = tracker.track(cloud_at(40), 40 * FRAME_NS)
    after = tracker.track(NOTHING, 41 * FRAME_NS)
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.pose.rotations, before.pose.rotations)
    assert after.confidence == 0
    assert not after.converged
    assert after.pose.confidence.max() == 0


@settings(max_examples=5, deadline=None)
@given(count=st.integers(0, 120), seed=st.integers(0, 100))
def test_tiny_clouds_never_raise(count: int, seed: int) -> None:
    cloud = cloud_at(40)
    rows = np.random.default_rng(seed).integers(0, len(cloud), count)
    few = PointCloud(cloud.positions[rows], cloud.normals[rows], cloud.colours[rows])
    GaussNewtonTracker(GaussNewtonSettings()).track(few, 0)
    fit = GaussNewtonTracker(GaussNewtonSettings(), BodyModel.from_bytes(saved_body())).track(few, 0)
    assert fit is None or fit.confidence < 0.7


def test_person_who_left_is_given_up_and_found_again() -> None:
    tracker = started()
    cloud = cloud_at(40)
    gone = PointCloud(cloud.positions + np.float32([3, 0, 0]), -cloud.normals, cloud.colours)
    for frame in range(41, 80):
        fit = tracker.track(gone, frame * FRAME_NS)
    assert fit is not None
    assert fit.confidence == 0
    assert "looking" in tracker.status
    for frame in range(90, 96):
        tracker.track(cloud_at(frame), frame * FRAME_NS)
    assert error_at(96, tracker, 96 * FRAME_NS) < 0.02


def test_unseen_limb_loses_its_confidence() -> None:
    tracker = started()
    cloud = cloud_at(40)
    for frame in range(40, 46):
        kept = cloud_at(frame).positions[:, 1] > 0.8
        cloud = cloud_at(frame)
        fit = tracker.track(
            PointCloud(cloud.positions[kept], cloud.normals[kept], cloud.colours[kept]), frame * FRAME_NS
        )
    assert fit is not None
    assert fit.pose.confidence[LINK_INDEX["left_shin"]] == 0
    assert fit.pose.confidence[LINK_INDEX["left_toes"]] == 0
    assert fit.pose.confidence[LINK_INDEX["upper_spine"]] > 0.8


def test_links_turn_on_without_their_twist() -> None:
    table = joint_table()
    before, now = np.tile(np.eye(3), (2, LINK_COUNT, 1, 1))
    link = LINK_INDEX["left_forearm"]  # twists about x
    now[link] = Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix()
    on = turned_on(before, now, np.array([1.0, 0.0]), table.twist_axis)
    np.testing.assert_allclose(Rotation.from_matrix(on[0, link]).as_rotvec(), [0.0, 0.4, 0.0], atol=1e-9)
    np.testing.assert_allclose(on[1], now, atol=1e-9)
    now[link] = Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    np.testing.assert_allclose(turned_on(before, now, np.array([1.0]), table.twist_axis)[0], now, atol=1e-9)
