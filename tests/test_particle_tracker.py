"""The tracker on ellipsoids and particles: follows, finds a lost arm, needs no normals, knows what it does not see."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from common.body.skeleton import LINK_COUNT, LINK_INDEX, NAMED_JOINT_LINKS, SIDES, human_skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics, rest_pose
from common.geometry import quaternion
from common.geometry.point_cloud import PointCloud
from sender.fitting.body_outline import NoPose
from sender.fitting.initial_pose_search import InitialPoseSearch
from sender.fitting.particle_tracker import ParticleSettings, ParticleTracker
from sender.fitting.particle_weights_opencl import OpenClUnavailable, opencl_weights
from sender.fitting.tracker import FitResult
from sender.fitting.whole_body_ellipsoids import whole_body_ellipsoids
from sender.fitting.whole_body_particles import WholeBodyParticles
from tests.capsule_person import pose_at

SKELETON = human_skeleton(1.75)
FRAME_NS = 33_333_333
POINTS = 1500
LEFT_ARM = ("left_upper_arm", "left_forearm", "left_hand", "left_fingers")
LEGS = tuple(f"{side}_{part}" for side in SIDES for part in ("thigh", "shin", "foot", "toes"))


def links_of(names: tuple[str, ...]) -> list[int]:
    return [LINK_INDEX[name] for name in names]


def cloud_of(pose: SkeletonPose, skin: bool, hidden: tuple[str, ...] = (), seed: int = 0) -> PointCloud:
    """Points of a body of ellipsoids: on its outside with normals, or inside without."""
    random = np.random.default_rng(seed)
    body = whole_body_ellipsoids(SKELETON)
    T = forward_kinematics(SKELETON, pose)[body.links].astype(np.float64)
    R = T[:, :3, :3] @ body.directions
    centres = np.einsum("eij,ej->ei", T[:, :3, :3], body.centres) + T[:, :3, 3]
    shown = np.flatnonzero(~np.isin(body.links, links_of(hidden)))
    sizes = body.axes[shown].prod(axis=1) ** (2 / 3 if skin else 1)
    e = random.choice(shown, 4 * POINTS, p=sizes / sizes.sum())
    ball = random.standard_normal((len(e), 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    if not skin:
        ball *= random.random((len(e), 1)) ** (1 / 3)
    points = np.einsum("nij,nj->ni", R[e], ball * body.axes[e]) + centres[e]
    local = np.einsum("enji,enj->eni", np.repeat(R[shown, None], len(e), 1), points[None] - centres[shown, None])
    covered = ((local / body.axes[shown, None]) ** 2).sum(axis=2) < 0.98
    covered[np.searchsorted(shown, e), np.arange(len(e))] = False
    free = np.flatnonzero(~covered.any(axis=0) if skin else np.ones(len(e), bool))[:POINTS]
    normals = np.einsum("nij,nj->ni", R[e], ball / body.axes[e])
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True) if skin else np.zeros_like(points)
    return PointCloud(
        points[free].astype(np.float32), normals[free].astype(np.float32), np.zeros((len(free), 3), np.uint8)
    )


def followed(tracker: ParticleTracker, skin: bool, frames: int, **cloud: Any) -> tuple[FitResult, list[float]]:
    """The last result, and the mean joint error of every frame [m]."""
    errors = []
    for frame in range(frames):
        truth = pose_at(frame / 30)
        points = cloud_of(truth, skin, seed=frame, **cloud)
        result = (
            tracker.start_from(SKELETON, truth, points, 0) if frame == 0 else tracker.track(points, frame * FRAME_NS)
        )
        assert result is not None
        errors.append(error_of(result, truth))
    return result, errors


def error_of(result: FitResult, truth: SkeletonPose, links: Any = NAMED_JOINT_LINKS) -> float:
    joints = (forward_kinematics(SKELETON, pose)[links, :3, 3] for pose in (result.pose, truth))
    return float(np.linalg.norm(np.subtract(*joints), axis=1).mean())


@pytest.mark.parametrize(("skin", "limit_m"), [(True, 0.015), (False, 0.025)])
def test_follows_points_on_the_skin_and_points_inside(skin: bool, limit_m: float) -> None:
    result, errors = followed(ParticleTracker(ParticleSettings()), skin, 20)
    assert max(errors) < limit_m
    limbs = links_of(tuple(f"{side}_{part}" for side in SIDES for part in ("upper_arm", "forearm", "thigh", "shin")))
    assert result.pose.confidence[limbs].min() > 0.5
    assert result.converged


def test_an_arm_that_nothing_shows_is_not_sure() -> None:
    tracker = ParticleTracker(ParticleSettings())
    seen, _ = followed(tracker, True, 4)
    hidden = tracker.track(cloud_of(pose_at(4 / 30), True, LEFT_ARM), 4 * FRAME_NS)
    assert hidden is not None
    others = links_of((*(f"{side}_{part}" for side in SIDES for part in ("thigh", "shin")), "right_upper_arm"))
    assert hidden.pose.confidence[links_of(LEFT_ARM)].max() < 0.3 < seen.pose.confidence[links_of(LEFT_ARM)].min()
    assert hidden.pose.confidence[others].min() > 0.5


def lifted_arm(pose: SkeletonPose, degrees: float) -> SkeletonPose:
    rotations = pose.rotations.copy()
    turn = quaternion.from_rotation_vector(np.array([0, 0, np.radians(degrees)]))
    link = LINK_INDEX["left_upper_arm"]
    rotations[link] = quaternion.multiply(rotations[link].astype(np.float64), turn)
    return SkeletonPose(pose.root_position, rotations, pose.confidence)


def error_after_a_jump() -> float:
    """Of the left arm, 12 frames after it jumped by 150° [m]."""
    tracker = ParticleTracker(ParticleSettings())
    hanging, raised = lifted_arm(rest_pose(np.array([0, 0.95, 0])), -75), lifted_arm(rest_pose([0, 0.95, 0]), 75)
    for frame in range(4):
        cloud = cloud_of(hanging, True, seed=frame)
        result = tracker.track(cloud, frame * FRAME_NS) if frame else tracker.start_from(SKELETON, hanging, cloud, 0)
    for frame in range(4, 16):
        result = tracker.track(cloud_of(raised, True, seed=frame), frame * FRAME_NS)
    assert result is not None
    return error_of(result, raised, links_of(("left_forearm", "left_hand")))


def test_particles_find_an_arm_that_jumped(monkeypatch: pytest.MonkeyPatch) -> None:
    assert error_after_a_jump() < 0.05
    monkeypatch.setattr(WholeBodyParticles, "search", lambda self, cloud, pose, *_: pose)
    assert error_after_a_jump() > 0.15, "the jump is too small to need particles"


def test_a_seated_person_is_followed_without_legs() -> None:
    truth = pose_at(0)
    confidence = truth.confidence.copy()
    confidence[links_of(LEGS)] = 0
    seated = SkeletonPose(truth.root_position, truth.rotations, confidence)
    random = np.random.default_rng(0)
    chair = (truth.root_position + random.uniform((-0.3, -0.6, -0.3), (0.3, -0.15, 0.3), (400, 3))).astype(np.float32)
    tracker = ParticleTracker(ParticleSettings())
    for frame in range(8):
        person = cloud_of(pose_at(frame / 30), False, LEGS, seed=frame)
        cloud = PointCloud(
            np.concatenate([person.positions, chair]),
            np.zeros((len(person) + 400, 3), np.float32),
            np.zeros((len(person) + 400, 3), np.uint8),
        )
        result = tracker.track(cloud, frame * FRAME_NS) if frame else tracker.start_from(SKELETON, seated, cloud, 0)
    assert result is not None
    upper = np.setdiff1d(NAMED_JOINT_LINKS, links_of(LEGS))
    assert error_of(result, pose_at(7 / 30), upper) < 0.04
    assert not result.pose.confidence[links_of(LEGS)].any()
    assert result.pose.confidence[links_of(("left_forearm", "right_forearm"))].min() > 0.3


@pytest.mark.parametrize("skin", [True, False])
def test_starts_by_itself(skin: bool) -> None:
    standing = rest_pose(np.array([0, 0.95, 0], np.float32))
    tracker = ParticleTracker(ParticleSettings())
    tracker.track(cloud_of(standing, skin), 0)  # ellipsoids have no faces: front and back look nearly alike
    result = tracker.track(cloud_of(standing, skin, seed=1), int(1.6e9))
    assert result is not None, tracker.status
    assert error_of_joints(result, standing) < 0.08


def test_who_stays_doubtful_is_followed_on_a_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    doubtful = NoPose("never sure")
    monkeypatch.setattr(InitialPoseSearch, "step", lambda self, cloud, capture_ns: doubtful)
    tracker = ParticleTracker(ParticleSettings())
    cloud = cloud_of(rest_pose(np.array([0, 0.95, 0], np.float32)), True)
    assert tracker.track(cloud, 0) is None
    assert tracker.status.endswith("never sure")
    assert tracker.track(cloud, int(1.4e9)) is None
    assert tracker.track(cloud, int(1.6e9)) is not None


def error_of_joints(result: FitResult, truth: SkeletonPose) -> float:
    """With the sizes that the tracker found for itself."""
    found = forward_kinematics(result.skeleton, result.pose)[NAMED_JOINT_LINKS, :3, 3]
    return float(np.linalg.norm(found - forward_kinematics(SKELETON, truth)[NAMED_JOINT_LINKS, :3, 3], axis=1).mean())


def test_an_empty_room_gives_no_confidence_and_a_strange_one_a_new_start() -> None:
    tracker = ParticleTracker(ParticleSettings(lost_s=0.2))
    assert tracker.track(cloud_of(pose_at(0), True), 0) is None or tracker.status == "tracking"
    _, errors = followed(tracker, True, 3)
    nobody = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    unseen = tracker.track(nobody, 3 * FRAME_NS)
    assert unseen is not None
    assert unseen.confidence == 0
    assert not unseen.pose.confidence.any()
    box = np.random.default_rng(0).uniform((3, 0, 3), (4, 1, 4), (500, 3)).astype(np.float32)
    elsewhere = replace(nobody, positions=box, normals=np.zeros_like(box), colours=np.zeros((500, 3), np.uint8))
    statuses = [(tracker.track(elsewhere, frame * FRAME_NS), tracker.status)[1] for frame in range(4, 14)]
    assert any("lost" in status for status in statuses)
    assert tracker.status.startswith("looking")
    assert errors[-1] < 0.02


def test_opencl_weights_lead_the_same_way() -> None:
    pytest.importorskip("pyopencl", reason="the gpu extra is not installed")
    try:
        weights = opencl_weights()
    except OpenClUnavailable as error:
        pytest.skip(str(error))
    ours, _ = followed(ParticleTracker(ParticleSettings(), weights), True, 3)
    theirs, _ = followed(ParticleTracker(ParticleSettings()), True, 3)
    assert np.abs(ours.pose.rotations - theirs.pose.rotations).max() < 1e-3
    assert ours.pose.confidence.shape == (LINK_COUNT,)
