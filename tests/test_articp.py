"""ARTICP on a capsule person: motions go down the tree, second moments tell a wrong link, the tracker says how sure."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_PARENTS, NAMED_JOINT_LINKS
from common.body.skeleton_pose import SkeletonPose, forward_kinematics, joint_positions, named_joint_positions
from common.geometry.point_cloud import PointCloud
from scripts.tracking_conditions import surface_points
from sender.fitting.articp import CARRIER, DESCENDANTS, LinkPoints, LinkState, articp, carriers_of, segmented
from sender.fitting.articp_tracker import ARTICP_ABLATIONS, ArticpSettings, ArticpTracker
from sender.fitting.clustered_kdtree import ClusterBins, build_clustered_tree
from sender.fitting.global_fitting import GlobalFitting, LinkMoments, fit_globally, global_errors, link_moments
from sender.fitting.link_icp import IcpStop
from sender.fitting.open_tracker import open_tracker
from tests.capsule_person import SKELETON, capsule_person, pose_at

BINS, STOP, FRAME_NS = ClusterBins(), IcpStop(), 33_333_333
SHIN, FOREARM = LINK_INDEX["left_shin"], LINK_INDEX["left_forearm"]
THIGH, UPPER_ARM = LINK_INDEX["left_thigh"], LINK_INDEX["left_upper_arm"]


def capsule_cloud(pose: SkeletonPose, count: int = 2000, seed: int = 0) -> PointCloud:
    mesh = capsule_person(0, pose).mesh
    colours = np.zeros((len(mesh.vertices), 3), np.uint8)
    return surface_points(mesh.vertices, mesh.faces, colours, count, np.random.default_rng(seed))


def state_of(pose: SkeletonPose) -> LinkState:
    T = forward_kinematics(SKELETON, pose).astype(np.float64)
    return LinkState(T[:, :3, :3], np.ascontiguousarray(T[:, :3, 3]))


def turned(state: LinkState, link: int, turn: Rotation) -> LinkState:
    """The pose with a link and all after it turned about its joint, in the world."""
    moved, M, joint = DESCENDANTS[link], turn.as_matrix(), state.joints[link]
    rotations, joints = state.rotations.copy(), state.joints.copy()
    rotations[moved] = M @ rotations[moved]
    joints[moved] = (joints[moved] - joint) @ M.T + joint
    return LinkState(rotations, joints)


@cache
def model() -> tuple[LinkPoints, LinkMoments]:
    found = segmented(capsule_cloud(pose_at(0.0), 3000, 9), SKELETON, state_of(pose_at(0.0)), BINS)
    return found, link_moments(found)


def has_points() -> np.ndarray:
    return np.asarray(np.diff(model()[0].first) > 0)


def bones_m(state: LinkState) -> np.ndarray:
    """Each joint seen from its parent's link (L - 1, 3) [m]: constant while links stay joined."""
    parents = np.array(LINK_PARENTS[1:])
    return np.einsum("lji,lj->li", state.rotations[parents], state.joints[1:] - state.joints[parents])


def joint_error_m(state: LinkState, truth: SkeletonPose) -> float:
    away = state.joints - joint_positions(SKELETON, truth)
    return float(np.linalg.norm(away[NAMED_JOINT_LINKS], axis=1).mean())


# --- Algorithm 5.1 ----------------------------------------------------------------------------------------------------


def test_model_is_the_cloud_by_link() -> None:
    points, _ = model()
    assert points.first[-1] == len(points.points) == 3000
    assert set(np.flatnonzero(np.diff(points.first))) <= set(CARRIER)
    cloud = capsule_cloud(pose_at(0.0), 3000, 9)
    posed, normals = points.posed(state_of(pose_at(0.0)))
    by_place = np.lexsort(posed.round(4).T), np.lexsort(cloud.positions.round(4).T)
    np.testing.assert_allclose(posed[by_place[0]], cloud.positions[by_place[1]], atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)


def test_descendants_follow() -> None:
    """Only the thigh is fitted; shin, foot and toes keep their place on it."""
    state = state_of(pose_at(0.0))
    swung = turned(state, THIGH, Rotation.from_rotvec([0.25, 0.0, 0.0]))
    only = np.zeros(LINK_COUNT, bool)
    only[THIGH] = True
    posed, normals = model()[0].posed(swung)
    cloud = PointCloud(posed.astype(np.float32), normals.astype(np.float32), np.zeros(posed.shape, np.uint8))
    found, _ = articp(model()[0], state, build_clustered_tree(cloud, BINS), only, STOP, True)
    for link in ("left_thigh", "left_shin", "left_foot", "left_toes"):
        np.testing.assert_allclose(found.joints[LINK_INDEX[link]], swung.joints[LINK_INDEX[link]], atol=0.02)
        np.testing.assert_allclose(found.rotations[LINK_INDEX[link]], swung.rotations[LINK_INDEX[link]], atol=0.05)
    np.testing.assert_allclose(bones_m(found), bones_m(state), atol=1e-9)
    others = ~DESCENDANTS[THIGH]
    np.testing.assert_array_equal(found.joints[others], state.joints[others])


def test_pose_is_followed_and_links_stay_joined() -> None:
    truth, state = pose_at(0.1), state_of(pose_at(0.0))
    found, iterations = articp(model()[0], state, build_clustered_tree(capsule_cloud(truth), BINS), has_points(), STOP,
                               True)  # fmt: skip
    assert joint_error_m(state, truth) > 0.02
    assert joint_error_m(found, truth) < 0.01
    assert iterations > has_points().sum()
    np.testing.assert_allclose(bones_m(found), bones_m(state), atol=1e-9)


def test_free_links_come_apart() -> None:
    state = state_of(pose_at(0.0))
    tree = build_clustered_tree(capsule_cloud(pose_at(0.1)), BINS)
    found, _ = articp(model()[0], state, tree, has_points(), STOP, False)
    assert np.abs(bones_m(found) - bones_m(state)).max() > 0.005


# --- global fitting ---------------------------------------------------------------------------------------------------


def errors_at(cloud: PointCloud, state: LinkState) -> np.ndarray:
    return global_errors(model()[1], cloud.positions, carriers_of(cloud.positions, SKELETON, state), state)


def test_second_moments_tell_the_wrong_link() -> None:
    truth = state_of(pose_at(0.0))
    cloud = capsule_cloud(pose_at(0.0))
    wrong = turned(truth, FOREARM, Rotation.from_rotvec([0.0, 0.9, 0.0]))
    assert errors_at(cloud, truth).max() < GlobalFitting().acceptable
    errors = errors_at(cloud, wrong)
    assert errors[FOREARM] > 2 * GlobalFitting().acceptable
    legs = [LINK_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in ("thigh", "shin", "foot")]
    assert errors[legs].max() < 0.3


@pytest.mark.parametrize("turn", [[1.5, 0.0, 0.0], [0.0, 0.0, -1.5], [0.0, 0.0, -1.0]])
def test_global_step_repairs_a_wrong_link(turn: list[float]) -> None:
    """A shin caught on other links' points: a minimum that ICP on the whole cloud does not leave."""
    truth, cloud = pose_at(0.0), capsule_cloud(pose_at(0.0))
    wrong = turned(state_of(truth), SHIN, Rotation.from_rotvec(turn))
    stuck, _ = articp(model()[0], wrong, build_clustered_tree(cloud, BINS), has_points(), STOP, True)
    fit = fit_globally(*model(), SKELETON, cloud, stuck, BINS, STOP, True, GlobalFitting())
    assert joint_error_m(stuck, truth) > 0.03
    assert joint_error_m(fit.state, truth) < 0.005
    assert fit.errors.sum() < errors_at(cloud, stuck).sum()
    np.testing.assert_allclose(bones_m(fit.state), bones_m(stuck), atol=1e-9)


def test_global_step_never_makes_it_worse() -> None:
    """An arm behind the back is beyond it: the pose comes back as it was, or better."""
    cloud = capsule_cloud(pose_at(0.0))
    for angle in (-2.0, 1.5, 2.0):
        wrong = turned(state_of(pose_at(0.0)), UPPER_ARM, Rotation.from_rotvec([0.0, angle, 0.0]))
        fit = fit_globally(*model(), SKELETON, cloud, wrong, BINS, STOP, True, GlobalFitting())
        assert fit.errors.sum() <= errors_at(cloud, wrong).sum()


def test_acceptable_pose_is_left_alone() -> None:
    state = state_of(pose_at(0.0))
    fit = fit_globally(*model(), SKELETON, capsule_cloud(pose_at(0.0)), state, BINS, STOP, True, GlobalFitting())
    assert fit.state is state
    assert fit.iterations == 0


# --- the tracker ------------------------------------------------------------------------------------------------------


@cache
def cloud_at(frame: int) -> PointCloud:
    return capsule_cloud(pose_at(frame / 30), 1500, frame)


def started(settings: ArticpSettings | None = None) -> ArticpTracker:
    tracker = ArticpTracker(settings or ArticpSettings())
    tracker.start_from(SKELETON, pose_at(0.0), cloud_at(0), 0)
    return tracker


def error_m(tracker: ArticpTracker, frame: int) -> float:
    fit = tracker.track(cloud_at(frame), frame * FRAME_NS)
    assert fit is not None
    joints = joint_positions(SKELETON, pose_at(frame / 30))[NAMED_JOINT_LINKS]
    return float(np.linalg.norm(named_joint_positions(fit.skeleton, fit.pose) - joints, axis=1).mean())


def nothing(count: int = 0) -> PointCloud:
    return PointCloud(np.ones((count, 3), np.float32), np.ones((count, 3), np.float32), np.ones((count, 3), np.uint8))


@pytest.mark.parametrize(("share", "limit_m"), [(1.0, 0.012), (0.25, 0.02)])
def test_tracker_follows(share: float, limit_m: float) -> None:
    tracker = started(ArticpSettings(model_share=share))
    assert max(error_m(tracker, frame) for frame in range(1, 25)) < limit_m
    assert tracker.status == "tracking"
    assert tracker.body is None


def test_good_fit_is_trusted() -> None:
    fit = started().track(cloud_at(1), FRAME_NS)
    assert fit is not None
    assert fit.converged
    assert fit.confidence > 0.95
    assert fit.inliers > 0.95
    assert fit.pose.confidence.min() > 0.8
    assert 0 < fit.rms_m < 0.05
    assert fit.iterations > 10


def test_unseen_limb_loses_its_confidence() -> None:
    tracker, cloud = started(), cloud_at(1)
    upper = cloud.positions[:, 1] > 0.75
    fit = tracker.track(PointCloud(cloud.positions[upper], cloud.normals[upper], cloud.colours[upper]), FRAME_NS)
    assert fit is not None
    assert fit.pose.confidence[LINK_INDEX["left_toes"]] < 0.2
    assert fit.pose.confidence[SHIN] < 0.3
    assert fit.pose.confidence[LINK_INDEX["upper_spine"]] > 0.9


def test_tracker_starts_by_itself() -> None:
    tracker = open_tracker("articp")
    fit = tracker.track(capsule_cloud(pose_at(0.0), 2500), 0)
    assert fit is not None
    assert tracker.status == "tracking"
    assert fit.skeleton is not SKELETON


def test_tracker_is_deterministic() -> None:
    first, second = (started(ArticpSettings(model_share=0.5)).track(cloud_at(2), FRAME_NS) for _ in range(2))
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.pose.rotations, second.pose.rotations)


def test_nobody_there_gives_none_and_later_the_last_pose() -> None:
    assert ArticpTracker(ArticpSettings()).track(nothing(), 0) is None
    tracker = started()
    before = tracker.track(cloud_at(1), FRAME_NS)
    for count in (0, 1, 39):
        after = tracker.track(nothing(count), 2 * FRAME_NS)
        assert before is not None
        assert after is not None
        np.testing.assert_array_equal(after.pose.rotations, before.pose.rotations)
        assert (after.confidence, after.converged, after.pose.confidence.max()) == (0.0, False, 0.0)
        assert f"{count} points" in tracker.status


def test_person_who_left_is_given_up_and_another_found() -> None:
    """What stands there instead is a heap of points on the floor; later the person is back."""
    tracker, random = started(), np.random.default_rng(0)
    heap = PointCloud(
        random.uniform(-0.4, 0.4, (1500, 3)).astype(np.float32) * np.float32([1, 0.1, 1]),
        np.tile(np.float32([0, 1, 0]), (1500, 1)), np.zeros((1500, 3), np.uint8),
    )  # fmt: skip
    for frame in range(1, 40):
        fit = tracker.track(heap, frame * FRAME_NS)
        assert fit is not None
        assert not fit.converged
    assert "looking for a person" in tracker.status
    fit = tracker.track(capsule_cloud(pose_at(0.0), 2500), 40 * FRAME_NS)
    assert tracker.status == "tracking"
    assert fit is not None
    assert fit.converged


@pytest.mark.parametrize("away_m", [10.0, 1e5])
def test_far_away_clouds_do_not_raise(away_m: float) -> None:
    tracker, cloud = started(), cloud_at(1)
    far = PointCloud(cloud.positions + np.float32(away_m), cloud.normals, cloud.colours)
    for frame in range(1, 4):
        fit = tracker.track(far, frame * FRAME_NS)
        assert fit is not None
        assert np.isfinite(fit.pose.rotations).all()
    point = PointCloud(np.zeros((100, 3), np.float32), np.zeros((100, 3), np.float32), np.zeros((100, 3), np.uint8))
    fit = started().track(point, FRAME_NS)
    assert fit is not None
    assert not fit.converged


def test_ablations_leave_out_what_their_names_say() -> None:
    errors = {}
    for name, build in ARTICP_ABLATIONS.items():
        tracker = build(None)
        tracker.start_from(SKELETON, pose_at(0.0), cloud_at(0), 0)
        fit = tracker.track(cloud_at(2), 2 * FRAME_NS)
        assert fit is not None
        errors[name] = np.abs(fit.skeleton.offsets - SKELETON.offsets).max()
    assert errors["articp-no-global"] == 0
    assert errors["articp-no-articulation"] > 0.002
    assert errors["articp-no-constraints"] > 0.002


def test_start_without_points_waits_for_some() -> None:
    tracker = ArticpTracker(ArticpSettings())
    fit = tracker.start_from(SKELETON, pose_at(0.0), nothing(1), 0)
    assert (fit.confidence, fit.converged) == (0.0, False)
    assert tracker.status == "1 points: nobody to start from"
    assert tracker.track(nothing(500), FRAME_NS) is None
    assert "looking for a person" in tracker.status


def test_pause_is_not_a_loss() -> None:
    tracker = started()
    fit = tracker.track(cloud_at(1), 10 * 30 * FRAME_NS)
    assert fit is not None
    assert fit.converged


def test_model_share_is_a_share() -> None:
    with pytest.raises(ValueError, match="model_share"):
        ArticpSettings(model_share=0.0)
