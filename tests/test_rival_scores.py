"""The scores σ is compared with: nothing for a mesh in its own pose, more the further it is moved."""

import numpy as np
import pytest

from common.body.rigged_mesh import build_rigged_mesh
from common.body.skeleton_pose import forward_kinematics
from common.body.skinning import animate, link_motion
from scripts.fidelity_similarity import skeleton_distance_m
from scripts.rival_scores import DihedralScore, holistic_score
from tests.capsule_person import SKELETON
from tests.capsule_views import arms_down_by, capsule_views


@pytest.fixture(scope="module")
def mesh():
    pose = arms_down_by(0.3)
    return build_rigged_mesh(1, 0, SKELETON, pose, capsule_views(pose)[:2])


def moved(mesh, angle_rad):
    motion = link_motion(mesh, forward_kinematics(SKELETON, arms_down_by(angle_rad)))
    return animate(mesh, motion, "rigid")


def test_holistic_and_dihedral_scores_grow_with_the_motion(mesh):
    dihedral = DihedralScore(mesh)
    for score in (lambda vertices: holistic_score(mesh, vertices), dihedral):
        still, little, far = (score(moved(mesh, 0.3 + angle)) for angle in (0.0, 0.2, 0.8))
        assert still == pytest.approx(0, abs=2e-3)
        assert still < little < far


def test_dihedral_score_is_blind_to_moving_as_a_whole(mesh):
    turned = mesh.mesh.vertices[:, [2, 1, 0]] * np.array([1, 1, -1], np.float32) + np.float32(0.5)
    assert DihedralScore(mesh)(turned) == pytest.approx(0, abs=2e-3)


def test_skeleton_distance_is_seen_from_the_pelvis():
    here = forward_kinematics(SKELETON, arms_down_by(0.3))
    there = here.copy()
    there[:, :3, 3] += 1.0
    assert skeleton_distance_m(here, there) == pytest.approx(0, abs=1e-5)
    assert skeleton_distance_m(here, forward_kinematics(SKELETON, arms_down_by(0.9))) > 0.05
