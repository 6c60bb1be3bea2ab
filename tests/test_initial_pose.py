"""The automatic start: where it puts the joints of people it knows nothing about, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, LINK_NAMES, NAMED_JOINTS
from common.body.skeleton_pose import joint_positions, named_joint_positions
from common.body.view import View
from common.geometry import quaternion
from common.geometry.camera_model import Camera
from common.geometry.point_cloud import PointCloud
from common.geometry.rasterizer import render
from common.geometry.rigid_transform import look_at
from sender.capture.builtin_body import builtin_body
from sender.capture.frame_set import DepthFrame
from sender.capture.skinned_body import SkinnedBody, load_body, named_joint_indices
from sender.capture.utd_mhad import UtdMhadSequence
from sender.fitting.initial_pose import InitialPose, NoPose, find_initial_pose
from sender.reconstruction.background import BackgroundModel
from sender.reconstruction.foreground_points import PointSampler

Floats = NDArray[np.float64]
DATA = Path(__file__).parents[1] / "../shared/data"
needs_bodies = pytest.mark.skipif(not (DATA / "bodies").exists(), reason="bodies not there (../shared/data)")
needs_recordings = pytest.mark.skipif(not (DATA / "rgbd").exists(), reason="recordings not there (../shared/data)")
JOINTS = [name for name, _ in NAMED_JOINTS]


def _rig(count: int) -> list[Camera]:
    around = 2 * np.pi * np.arange(count) / count
    eyes = [np.array([2.5 * np.sin(a), 1.3, 2.5 * np.cos(a)]) for a in around]
    poses = [look_at(eye, np.array([0, 0.9, 0])).astype(np.float64) for eye in eyes]
    return [Camera(f"cam{i + 1}", 640, 480, 525, 525, 320, 240, pose) for i, pose in enumerate(poses)]


def _posed(body: SkinnedBody, arms_rad: float | None) -> tuple[Floats, Floats]:
    """Surface (V, 3) and named joints (16, 3) [m] at rest (A-pose) or with the upper arms at ``arms_rad`` from the
    trunk."""
    local = np.tile(quaternion.IDENTITY, (len(body.parents), 1))
    for side, sign in (("Left", 1), ("Right", -1)):
        shoulder = body.joint(f"{side}Arm")
        arm = body.heads[body.joint(f"{side}ForeArm")] - body.heads[shoulder]
        if arms_rad is not None:
            target = np.array([sign * np.sin(arms_rad), -np.cos(arms_rad), 0.0])
            local[shoulder] = quaternion.shortest_arc(arm, target)
    T_world_joint = body.joint_transforms(local, body.heads[0])
    return body.surface(T_world_joint).astype(np.float64), T_world_joint[named_joint_indices(body), :, 3]


def _turned(points: Floats, heading_rad: float) -> Floats:
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    return points @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T


def _captured(body: SkinnedBody, surface: Floats, cameras: list[Camera], noise_per_m: float = 1.2e-3) -> PointCloud:
    """What the cameras' reconstruction makes of the surface, with depth noise growing with z²."""
    rng = np.random.default_rng(0)
    views: list[View] = []
    for index, camera in enumerate(cameras):
        colour, depth = render(surface.astype(np.float32), body.mesh.faces, body.mesh.vertex_colours, camera)
        noisy = depth + noise_per_m * depth**2 * rng.standard_normal(depth.shape, np.float32)
        frame = DepthFrame(index, 0, 0, np.rint(np.where(depth > 0, noisy, 0) * 1000).astype(np.uint16), colour)
        view = BackgroundModel(camera, None).foreground(frame)
        assert view is not None
        views.append(view)
    return PointSampler(cameras).points(views)


def _found(cloud: PointCloud, floor_y: float | None = 0.0) -> InitialPose:
    found = find_initial_pose(cloud, floor_y)
    assert isinstance(found, InitialPose), found
    return found


def _errors(found: InitialPose, truth: Floats) -> Floats:
    return np.linalg.norm(named_joint_positions(found.skeleton, found.pose) - truth, axis=1)


@pytest.fixture(scope="module")
def body() -> SkinnedBody:
    return builtin_body()


@pytest.mark.parametrize("heading_rad", np.arange(8) * np.pi / 4 + 0.1)
def test_a_pose_in_every_heading(body: SkinnedBody, heading_rad: float) -> None:
    """A swapped left and right, or a person taken from behind, would be off by the width of the body."""
    surface, truth = _posed(body, None)
    found = _found(_captured(body, _turned(surface, heading_rad), _rig(4)))
    errors = _errors(found, _turned(truth, heading_rad))
    assert errors.mean() < 0.03
    assert errors.max() < 0.09
    assert found.whole_body
    assert found.quality > 0.9
    assert found.rms_m < 0.015
    toes = joint_positions(found.skeleton, found.pose)[[LINK_INDEX["left_toes"], LINK_INDEX["right_toes"]]].mean(axis=0)
    assert _turned((toes - found.pose.root_position)[None].astype(float), -heading_rad)[0, 2] > 0.03  # before the hips


@pytest.mark.parametrize("arms_rad", [0.2, 1.5], ids=["hanging", "T-pose"])
@pytest.mark.parametrize("cameras", [1, 4])
def test_other_arms_and_a_single_camera(body: SkinnedBody, arms_rad: float, cameras: int) -> None:
    surface, truth = _posed(body, arms_rad)
    found = _found(_captured(body, _turned(surface, 0.3), _rig(cameras)))
    assert _errors(found, _turned(truth, 0.3)).mean() < (0.035 if cameras == 1 else 0.03)


@needs_bodies
@pytest.mark.parametrize("name", ["female_slim", "male_avg"])
def test_bodies_of_other_shapes(name: str) -> None:
    person = load_body(DATA / "bodies" / f"{name}.npz")
    surface, truth = _posed(person, None)
    for heading_rad in (0.7, 3.9):
        found = _found(_captured(person, _turned(surface, heading_rad), _rig(4)))
        assert _errors(found, _turned(truth, heading_rad)).mean() < 0.03


@pytest.mark.parametrize("scale", [0.84, 1.1])
def test_sizes_follow_the_person(body: SkinnedBody, scale: float) -> None:
    surface, truth = (scale * part for part in _posed(body, None))
    found = _found(_captured(body, surface, _rig(4)))
    assert _errors(found, truth).mean() < 0.035
    truth_of = dict(zip(JOINTS, truth, strict=True))
    for child, parent, link in (
        ("left_knee", "left_hip", "left_shin"),
        ("right_elbow", "right_shoulder", "right_forearm"),
    ):
        length = np.linalg.norm(truth_of[child] - truth_of[parent])
        assert np.linalg.norm(found.skeleton.offsets[LINK_INDEX[link]]) == pytest.approx(length, rel=0.12)


def test_both_sides_get_the_same_sizes(body: SkinnedBody) -> None:
    found = _found(_captured(body, _posed(body, None)[0], _rig(4)))
    left = [i for i, name in enumerate(LINK_NAMES) if name.startswith("left")]
    right = [LINK_INDEX[LINK_NAMES[i].replace("left", "right")] for i in left]
    np.testing.assert_allclose(found.skeleton.offsets[left] * [-1, 1, 1], found.skeleton.offsets[right], atol=1e-6)
    np.testing.assert_array_equal(found.skeleton.radii[left], found.skeleton.radii[right])


def test_unknown_floor_is_taken_from_the_soles(body: SkinnedBody) -> None:
    surface, truth = _posed(body, None)
    lift = np.array([0.4, 0.37, -0.2])
    cloud = _captured(body, surface, _rig(4))
    lifted = replace(cloud, positions=(cloud.positions + lift).astype(np.float32))
    assert _errors(_found(lifted, None), truth + lift).mean() < 0.03


def test_outline_beyond_the_cloud(body: SkinnedBody) -> None:
    """Clouds end some 3 cm above the floor; feet and legs must not be lifted by that."""
    surface, truth = _posed(body, None)
    cloud = _captured(body, surface, _rig(4))
    assert cloud.positions[:, 1].min() > surface[:, 1].min() + 0.015
    found = _found(cloud, None)
    up = (named_joint_positions(found.skeleton, found.pose) - truth)[:, 1]
    assert abs(up[[JOINTS.index("left_ankle"), JOINTS.index("right_ankle")]].mean()) < 0.015


def test_upper_body_says_that_it_sees_no_legs(body: SkinnedBody) -> None:
    surface, truth = _posed(body, 0.4)
    cloud = _captured(body, surface, _rig(1))
    kept = cloud.positions[:, 1] > 0.98
    upper = PointCloud(cloud.positions[kept], cloud.normals[kept], cloud.colours[kept])
    found = _found(upper, None)
    assert not found.whole_body
    legs = [i for i, name in enumerate(LINK_NAMES) if name.endswith(("thigh", "shin", "foot", "toes"))]
    assert (found.pose.confidence[legs] == 0).all()
    assert found.pose.confidence[LINK_INDEX["head"]] == 1
    upper_joints = [i for i, name in enumerate(JOINTS) if name.endswith(("chest", "neck", "head", "shoulder", "elbow"))]
    assert _errors(found, truth)[upper_joints].mean() < 0.06


def test_refusals_say_why() -> None:
    rng = np.random.default_rng(3)

    def cloud_of(positions: Floats, normals: Floats | None = None) -> PointCloud:
        away = positions - positions.mean(axis=0) if normals is None else normals
        away = away / np.linalg.norm(away, axis=1, keepdims=True)
        return PointCloud(
            positions.astype(np.float32), away.astype(np.float32), np.zeros((len(positions), 3), np.uint8)
        )

    few = find_initial_pose(cloud_of(rng.normal(size=(50, 3))))
    assert few == NoPose("50 points, at least 200 are needed")
    low = find_initial_pose(cloud_of(rng.uniform(0, 0.2, (500, 3))))
    assert isinstance(low, NoPose)
    assert "not one person" in low.reason
    around = rng.normal(size=(2000, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    ball = find_initial_pose(cloud_of(around * 0.9 + [0, 0.9, 0], around), 0.0)
    assert isinstance(ball, NoPose)
    assert "human shape" in ball.reason


@needs_recordings
@pytest.mark.parametrize("name", ["a1_s1_t1", "a6_s2_t1", "a22_s4_t1"])
def test_people_of_a_real_recording(name: str) -> None:
    """Against the sensor's own estimate, which is no truth: its joints lie within a hand's length of ours."""
    sequence = UtdMhadSequence(DATA / "rgbd/utd_mhad/Depth" / f"{name}_depth.mat")
    view = BackgroundModel(sequence.cameras[0], None).foreground(DepthFrame(0, 0, 0, sequence.load(0, 0)[0], None))
    assert view is not None
    found = _found(PointSampler(sequence.cameras).points([view]))
    ours = named_joint_positions(found.skeleton, found.pose)
    sdk = sequence.joints(0)
    pairs = {"neck": 1, "left_shoulder": 4, "left_elbow": 5, "left_wrist": 6, "right_shoulder": 8, "right_elbow": 9,
             "right_wrist": 10, "left_knee": 13, "left_ankle": 14, "right_knee": 17, "right_ankle": 18}  # fmt: skip
    distances = [float(np.linalg.norm(ours[JOINTS.index(joint)] - sdk[index])) for joint, index in pairs.items()]
    assert np.mean(distances) < 0.10
    assert max(distances) < 0.20
