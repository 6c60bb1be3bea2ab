"""Ellipsoids on links: angles move them as the link tree's own kinematics do."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_NAMES, human_skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.geometry import quaternion
from sender.fitting.ellipsoid_body import (
    LEGS,
    TORSO,
    WHOLE_BODY,
    arm_links,
    ellipsoid_body,
    link_transforms,
    particle_of,
    quadrics,
)

SKELETON = human_skeleton(1.75)


def random_pose(seed: int) -> np.ndarray:
    """``T_world_link`` (L, 4, 4) of a person with every joint turned by some 20°."""
    turns = Rotation.from_rotvec(0.35 * np.random.default_rng(seed).standard_normal((LINK_COUNT, 3))).as_quat()
    pose = SkeletonPose(np.array([0.1, 0.9, -0.2]), turns[:, [3, 0, 1, 2]], np.ones(LINK_COUNT, np.float32))
    return forward_kinematics(SKELETON, pose).astype(np.float64)


@pytest.mark.parametrize(
    ("names", "dofs", "ellipsoids"),
    [(LEGS, 10, 6), (arm_links("left"), 4, 2), (arm_links("right"), 4, 2), (TORSO, 12, 4), (WHOLE_BODY, 30, 16)],
)
def test_limbs_have_the_published_degrees_of_freedom(names: tuple[str, ...], dofs: int, ellipsoids: int) -> None:
    body = ellipsoid_body(SKELETON, names)
    assert (body.dof_count, len(body.axes), len(body.dof_names())) == (dofs, ellipsoids, dofs)


def test_degrees_of_freedom_are_thigh_3_knee_1_foot_1() -> None:
    leg = ("thigh.x", "thigh.y", "thigh.z", "shin.x", "foot.x")
    assert ellipsoid_body(SKELETON, LEGS).dof_names() == tuple(f"{s}_{d}" for s in ("left", "right") for d in leg)


@given(st.integers(0, 10_000), st.sampled_from([LEGS, arm_links("left"), arm_links("right"), WHOLE_BODY]))
@settings(max_examples=20, deadline=None)
def test_angles_and_transforms_are_inverse(seed: int, names: tuple[str, ...]) -> None:
    body = ellipsoid_body(SKELETON, names)
    particle = 0.6 * np.random.default_rng(seed).uniform(-1, 1, body.dof_count)
    T_parent = random_pose(seed)[LINK_INDEX["pelvis"]]
    T = np.tile(np.eye(4), (len(names), 1, 1))
    T[:, :3] = link_transforms(body, particle[None], T_parent)[0]
    np.testing.assert_allclose(particle_of(body, T, T_parent), particle, atol=1e-6)


@pytest.mark.parametrize("names", [("left_thigh",), ("right_upper_arm",)])
def test_a_free_joint_stands_where_the_link_tree_puts_it(names: tuple[str, ...]) -> None:
    T = random_pose(1)
    link = LINK_INDEX[names[0]]
    parent = T[LINK_INDEX["pelvis" if "thigh" in names[0] else "right_clavicle"]]
    body = ellipsoid_body(SKELETON, names)
    particle = particle_of(body, T[[link]], parent)
    np.testing.assert_allclose(link_transforms(body, particle[None], parent)[0, 0], T[link, :3], atol=1e-5)


def test_a_hinge_takes_its_own_share_of_a_turn() -> None:
    body = ellipsoid_body(SKELETON, ("left_shin",))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xz", [0.7, 0.1]).as_matrix()
    T[:3, 3] = SKELETON.offsets[LINK_INDEX["left_shin"]]
    assert particle_of(body, T[None], np.eye(4)) == pytest.approx([0.7], abs=0.01)


def test_the_root_of_a_torso_moves() -> None:
    body = ellipsoid_body(SKELETON, TORSO)
    particle = np.zeros(12)
    particle[[body.dof_names().index(f"pelvis.move_{axis}") for axis in "xyz"]] = [0.1, 0.9, -0.3]
    T = link_transforms(body, particle[None], np.eye(4))[0]
    np.testing.assert_allclose(T[0, :, 3], [0.1, 0.9, -0.3])


@pytest.mark.parametrize("side", ["left", "right"])
def test_arms_at_zero_are_mirror_images_pointing_down_and_forward(side: str) -> None:
    body = ellipsoid_body(SKELETON, arm_links(side))
    T = link_transforms(body, np.zeros((1, 4)), np.eye(4))[0]
    along = T[1, :, 3] - T[0, :, 3]
    sign = 1 if side == "left" else -1
    np.testing.assert_allclose(along / np.linalg.norm(along), np.array([sign * 0.5, -0.7, 0.5]) / 0.99499, atol=1e-5)


def test_quadrics_map_every_ellipsoid_to_the_unit_ball() -> None:
    body = ellipsoid_body(SKELETON, WHOLE_BODY)
    T_parent = random_pose(2)[0]
    particles = 0.4 * np.random.default_rng(3).standard_normal((2, body.dof_count))
    T, Q = link_transforms(body, particles, T_parent), quadrics(body, particles, T_parent)
    for p, e in ((0, 0), (1, 5), (1, 15)):
        link = T[p, body.ellipsoid_link[e]]
        for axis in range(3):
            tip = body.centres[e] + body.directions[e][:, axis] * body.axes[e, axis]
            world = link[:, :3] @ tip + link[:, 3]
            np.testing.assert_allclose(Q[p, e] @ [*world, 1], np.eye(3)[axis], atol=1e-4)


def test_an_ellipsoid_lies_along_its_bone() -> None:
    body = ellipsoid_body(SKELETON, LEGS)
    shin = [LINK_NAMES[k] for k in body.links].index("right_shin")
    np.testing.assert_allclose(np.abs(body.directions[shin][:, 1]), [0, 1, 0], atol=1e-6)
    assert body.axes[shin, 1] > 3 * body.axes[shin, 0]
    np.testing.assert_allclose(body.scaled(1.2).axes, 1.2 * body.axes)


def test_only_hinges_and_the_twist_of_an_arm_have_limits() -> None:
    body = ellipsoid_body(SKELETON, WHOLE_BODY)
    limited = {name for name, low, high in zip(body.dof_names(), body.low, body.high, strict=True) if low > -np.inf}
    assert limited == {
        f"{side}_{dof}" for side in ("left", "right") for dof in ("shin.x", "foot.x", "upper_arm.x", "forearm.y")
    }
    at = dict(zip(body.dof_names(), zip(body.low, body.high, strict=True), strict=True))
    assert at["left_forearm.y"][0] == pytest.approx(-at["right_forearm.y"][1])  # elbows bend towards each other


def test_a_hand_goes_on_from_the_wrist_to_the_fingertips() -> None:
    body = ellipsoid_body(SKELETON, WHOLE_BODY)
    e = [LINK_NAMES[body.links[row]] for row in body.ellipsoid_link].index("left_hand")
    length = np.linalg.norm(SKELETON.tips[[LINK_INDEX["left_hand"], LINK_INDEX["left_fingers"]]], axis=1).sum()
    assert 2 * body.axes[e, 1] == pytest.approx(length, rel=0.3)
    np.testing.assert_allclose(body.centres[e], [length / 2, 0, 0], atol=1e-6)


def test_quaternions_of_zero_are_proper() -> None:
    assert np.linalg.det(ellipsoid_body(SKELETON, arm_links("right")).zero[0]) == pytest.approx(1)
    assert quaternion.from_matrix(ellipsoid_body(SKELETON, LEGS).zero)[:, 0].tolist() == [1.0] * 6
