"""Moving a captured mesh rigidly with its links."""

from __future__ import annotations

import numpy as np

from common.body.skeleton import LINK_INDEX
from common.body.skeleton_pose import SkeletonPose
from common.body.skinning import animate_rigid, link_motion
from tests.capsule_views import arms_down_by, captured, links_of

MESH = captured(0.8)
OWN = arms_down_by(0.8)
OTHER = arms_down_by(0.2, turned_rad=0.6)


def test_its_own_skeleton_moves_nothing() -> None:
    motion = link_motion(MESH, links_of(OWN))
    np.testing.assert_allclose(motion, np.broadcast_to(np.eye(4)[:3], motion.shape), atol=1e-5)
    np.testing.assert_allclose(animate_rigid(MESH, motion), MESH.mesh.vertices, atol=1e-5)


def test_a_moved_root_moves_the_whole_mesh() -> None:
    step = np.array([0.3, 0.1, -0.2], np.float32)
    moved = SkeletonPose(OWN.root_position + step, OWN.rotations, OWN.confidence)
    vertices = animate_rigid(MESH, link_motion(MESH, links_of(moved)))
    np.testing.assert_allclose(vertices, MESH.mesh.vertices + step, atol=1e-5)


def test_each_vertex_keeps_its_place_in_its_links_frame() -> None:
    T_out = links_of(OTHER).astype(float)
    T_in = links_of(OWN).astype(float)
    vertices = animate_rigid(MESH, link_motion(MESH, links_of(OTHER)))
    expected = np.empty_like(vertices)
    for link in range(len(T_in)):
        own = MESH.vertex_link == link
        local = (MESH.mesh.vertices[own] - T_in[link, :3, 3]) @ T_in[link, :3, :3]
        expected[own] = local @ T_out[link, :3, :3].T + T_out[link, :3, 3]
    np.testing.assert_allclose(vertices, expected, atol=1e-5)
    hand = MESH.vertex_link == LINK_INDEX["left_hand"]
    assert np.linalg.norm(vertices - MESH.mesh.vertices, axis=1)[hand].min() > 0.1


def test_the_result_is_ready_for_the_page() -> None:
    motion = link_motion(MESH, links_of(OTHER))
    assert motion.dtype == np.float32
    assert motion.shape == (23, 3, 4)
    assert motion.flags.c_contiguous
    assert animate_rigid(MESH, motion).dtype == np.float32
