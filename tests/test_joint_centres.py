"""Joint centres learned from motion, on a capsule person whose knee was put in the wrong place."""

import numpy as np

from common.body.skeleton import LINK_INDEX, Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.geometry import quaternion
from sender.fitting.articulated_gauss_newton import PoseState, Schedule
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.body_model import BodyModel
from sender.fitting.joint_centres import LARGEST_STEP_M, JointCentres
from sender.fitting.joint_limits import joint_table
from tests.capsule_person import SKELETON, pose_at
from tests.test_gauss_newton import capsule_cloud, state_of

TABLE = joint_table()
KNEE = LINK_INDEX["left_shin"]
WRONG_M = 0.03
PLAN = Schedule(4, 0.08, 0.06, 0.1, 1.0, 1.0)


def knee_bent(angle: float) -> SkeletonPose:
    pose = pose_at(0.0)
    rotations = pose.rotations.copy()
    rotations[KNEE] = quaternion.from_rotation_vector(np.array([angle, 0.0, 0.0]))
    return SkeletonPose(pose.root_position, rotations, pose.confidence)


def body_with_wrong_knee() -> BodyModel:
    """Learned in one posture, in which a knee may lie anywhere along the leg."""
    offsets, tips = SKELETON.offsets.copy(), SKELETON.tips.copy()
    offsets[KNEE, 1] += WRONG_M
    offsets[LINK_INDEX["left_foot"], 1] -= WRONG_M
    tips[LINK_INDEX["left_thigh"]], tips[KNEE] = offsets[KNEE], offsets[LINK_INDEX["left_foot"]]
    body = BodyModel(Skeleton(offsets, tips, SKELETON.radii))
    straight = knee_bent(0.0)
    for seed in range(3):
        body.add(capsule_cloud(straight, 3000, seed), forward_kinematics(body.skeleton, straight))
    return body


def observed(body: BodyModel, centres: JointCentres, angles: np.ndarray) -> None:
    state: PoseState = state_of(knee_bent(float(angles[0])))
    for frame, angle in enumerate(angles):
        fitter = BodyFitter(body, TABLE)
        cloud = capsule_cloud(knee_bent(float(angle)), 1200, frame)
        state = fitter.fit(cloud, state, state, PLAN).pose
        centres.observe(cloud, state, fitter)


def test_a_wrong_knee_moves_to_where_the_leg_bends() -> None:
    body, centres = body_with_wrong_knee(), JointCentres(0.04)
    body.surface()
    for _ in range(8):
        observed(body, centres, np.linspace(0.1, 1.3, 7))
        step = centres.correction(0.001)
        if step is not None:
            assert np.abs(step).max() <= LARGEST_STEP_M + 1e-9
            body.move_joints(*step)
    assert abs(body.skeleton.offsets[KNEE, 1] - SKELETON.offsets[KNEE, 1]) < 0.6 * WRONG_M
    np.testing.assert_array_equal(body.skeleton.tips[LINK_INDEX["left_thigh"]], body.skeleton.offsets[KNEE])


def test_a_leg_that_does_not_bend_moves_nothing() -> None:
    body, centres = body_with_wrong_knee(), JointCentres(0.04)
    body.surface()
    observed(body, centres, np.zeros(7))
    assert centres.observed == 7
    step = centres.correction(0.0)
    assert step is not None
    assert np.abs(step[0][KNEE]).max() < 0.2 * WRONG_M


def test_nothing_to_correct_is_none() -> None:
    assert JointCentres(0.04).correction(0.001) is None


def test_moved_joints_keep_the_surface_in_the_world() -> None:
    body, straight = body_with_wrong_knee(), knee_bent(0.0)
    before = body.surface()
    in_parent, in_link = np.zeros((2, len(SKELETON.offsets), 3))
    in_parent[KNEE] = in_link[KNEE] = [0.0, -WRONG_M, 0.0]
    T_before = forward_kinematics(body.skeleton, straight)
    body.move_joints(in_parent, in_link)
    T_after, after = forward_kinematics(body.skeleton, straight), body.surface(0)
    np.testing.assert_allclose(body.skeleton.offsets, SKELETON.offsets, atol=1e-6)
    for link in (KNEE, LINK_INDEX["left_thigh"]):
        rows = slice(before.first_point[link], before.first_point[link + 1])
        world = [
            surface.points[rows] @ T[link, :3, :3].T + T[link, :3, 3]
            for surface, T in ((before, T_before), (after, T_after))
        ]
        np.testing.assert_allclose(world[0], world[1], atol=1e-5)
