"""Moving a captured mesh to another skeleton: rigidly, by linear and by spherical blend."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from common.body.skeleton import LINK_INDEX, LINK_PARENTS
from common.body.skeleton_pose import SkeletonPose
from common.body.skinning import Skinning, animate, captured_joints, link_motion
from tests.capsule_views import arms_down_by, captured, links_of

MESH = captured(0.8)
OWN = arms_down_by(0.8)
OTHER = arms_down_by(0.2, turned_rad=0.6)


@pytest.mark.parametrize("skinning", get_args(Skinning))
def test_its_own_skeleton_moves_nothing(skinning: Skinning) -> None:
    motion = link_motion(MESH, links_of(OWN))
    np.testing.assert_allclose(motion, np.broadcast_to(np.eye(4)[:3], motion.shape), atol=1e-5)
    np.testing.assert_allclose(animate(MESH, motion, skinning), MESH.mesh.vertices, atol=1e-5)


@pytest.mark.parametrize("skinning", get_args(Skinning))
def test_a_moved_root_moves_the_whole_mesh(skinning: Skinning) -> None:
    step = np.array([0.3, 0.1, -0.2], np.float32)
    moved = SkeletonPose(OWN.root_position + step, OWN.rotations, OWN.confidence)
    vertices = animate(MESH, link_motion(MESH, links_of(moved)), skinning)
    np.testing.assert_allclose(vertices, MESH.mesh.vertices + step, atol=1e-5)


def test_each_vertex_keeps_its_place_in_its_links_frame() -> None:
    T_out = links_of(OTHER).astype(float)
    T_in = links_of(OWN).astype(float)
    vertices = animate(MESH, link_motion(MESH, links_of(OTHER)), "rigid")
    expected = np.empty_like(vertices)
    for link in range(len(T_in)):
        own = MESH.vertex_link == link
        local = (MESH.mesh.vertices[own] - T_in[link, :3, 3]) @ T_in[link, :3, :3]
        expected[own] = local @ T_out[link, :3, :3].T + T_out[link, :3, 3]
    np.testing.assert_allclose(vertices, expected, atol=1e-5)
    hand = MESH.vertex_link == LINK_INDEX["left_hand"]
    assert np.linalg.norm(vertices - MESH.mesh.vertices, axis=1)[hand].min() > 0.1


@pytest.mark.parametrize("skinning", get_args(Skinning))
def test_the_result_is_ready_for_the_page(skinning: Skinning) -> None:
    motion = link_motion(MESH, links_of(OTHER))
    assert motion.dtype == np.float32
    assert motion.shape == (23, 3, 4)
    assert motion.flags.c_contiguous
    assert animate(MESH, motion, skinning).dtype == np.float32


def test_only_a_band_at_the_joints_is_blended_with_the_neighbouring_link() -> None:
    blend = MESH.blend
    assert blend.share.max() <= 127  # its own link always has the larger part
    assert 0.02 < (blend.share > 0).mean() < 0.4
    parents = np.array(LINK_PARENTS)
    upward = parents[MESH.vertex_link] == blend.other
    assert (upward | (parents[blend.other] == MESH.vertex_link)).all()
    np.testing.assert_array_equal(blend.joint, np.where(upward, MESH.vertex_link, blend.other))


@pytest.mark.parametrize("skinning", ["linear", "spherical"])
def test_blending_leaves_the_middle_of_a_segment_rigid(skinning: Skinning) -> None:
    motion = link_motion(MESH, links_of(OTHER))
    blended, rigid = animate(MESH, motion, skinning), animate(MESH, motion, "rigid")
    still = MESH.blend.share == 0
    np.testing.assert_array_equal(blended[still], rigid[still])
    assert np.abs(blended - rigid)[~still].max() > 0.005


def test_spherical_blend_keeps_the_distance_to_the_joint_and_linear_blend_shrinks_it() -> None:
    motion = link_motion(MESH, links_of(arms_down_by(-0.6)))  # 1.4 rad at the shoulder
    arm = np.isin(MESH.blend.joint, [LINK_INDEX["left_upper_arm"], LINK_INDEX["right_upper_arm"]])
    bent = arm & (MESH.blend.share > 90)
    at = captured_joints(MESH)[MESH.blend.joint[bent]]
    own = motion[MESH.vertex_link[bent]]
    joint_now = np.einsum("vij,vj->vi", own[:, :, :3], at) + own[:, :, 3]
    before = np.linalg.norm(MESH.mesh.vertices[bent] - at, axis=1)
    spherical, linear = (
        np.linalg.norm(animate(MESH, motion, skinning)[bent] - joint_now, axis=1)
        for skinning in ("spherical", "linear")
    )
    np.testing.assert_allclose(spherical, before, atol=1e-4)
    assert np.median(linear / before) < 0.95


def test_joints_at_capture() -> None:
    np.testing.assert_allclose(captured_joints(MESH), links_of(OWN)[:, :3, 3], atol=1e-5)
