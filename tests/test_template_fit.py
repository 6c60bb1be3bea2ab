"""The human template and the kernels that fit it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_NAMES
from common.body.skeleton_pose import forward_kinematics
from sender.fitting.body_template import (
    ROOT,
    SIZE_INDEX,
    Template,
    angle_index,
    human_template,
    template_pose,
    template_skeleton,
)
from sender.fitting.template_fit import fit_template, unfitted
from sender.fitting.template_kernels import jacobian, match, place

Floats = NDArray[np.float64]
TEMPLATE = human_template()
P, K = len(TEMPLATE.prior), len(TEMPLATE.cone_links)


def _some_theta(seed: int) -> Floats:
    rng = np.random.default_rng(seed)
    theta = TEMPLATE.prior + rng.normal(size=P) * 0.5 * TEMPLATE.sigma
    theta[ROOT : ROOT + 3] = 0.2, 0.95, -0.1
    return theta


def _placed(theta: Floats, heading: float) -> tuple[Floats, Floats, Floats, Floats]:
    rotations, origins = np.empty((LINK_COUNT, 3, 3)), np.empty((LINK_COUNT, 3))
    ends, radii = np.empty((K, 2, 3)), np.empty((K, 2))
    place(theta, heading, tuple(TEMPLATE[:10]), ROOT, np.zeros((LINK_COUNT, 3)), rotations, origins, ends, radii)
    return rotations, origins, ends, radii


def _surface(theta: Floats, heading: float, cones: NDArray[np.bool_], count: int) -> tuple[Floats, Floats]:
    """Points and normals on the sides of the cones."""
    rng = np.random.default_rng(5)
    _, _, ends, radii = _placed(theta, heading)
    k = rng.choice(np.flatnonzero(cones), count)
    axis = ends[k, 1] - ends[k, 0]
    side = np.cross(axis, rng.normal(size=(count, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    t = rng.uniform(0, 1, (count, 1))
    radius = (1 - t) * radii[k, :1] + t * radii[k, 1:]
    return ends[k, 0] + t * axis + radius * side, side


@pytest.mark.parametrize("seed", range(4))
def test_kernel_and_skeleton_agree_on_every_link_frame(seed: int) -> None:
    theta, heading = _some_theta(seed), 0.7 * seed
    rotations, origins, _, _ = _placed(theta, heading)
    pose = template_pose(TEMPLATE, theta, heading, np.ones(LINK_COUNT, np.float32))
    T_world_link = forward_kinematics(template_skeleton(TEMPLATE, theta), pose)
    np.testing.assert_allclose(T_world_link[:, :3, :3], rotations, atol=1e-5)
    np.testing.assert_allclose(T_world_link[:, :3, 3], origins, atol=1e-5)


def test_a_size_stretches_its_links_and_no_others() -> None:
    theta = TEMPLATE.prior.copy()
    before = template_skeleton(TEMPLATE, theta)
    theta[SIZE_INDEX["forearm"]] = 1.2
    after = template_skeleton(TEMPLATE, theta)
    changed = {LINK_NAMES[i] for i in np.flatnonzero(np.abs(after.offsets - before.offsets).max(axis=1) > 1e-6)}
    assert changed == {"left_hand", "right_hand"}
    hand = LINK_INDEX["left_hand"]
    np.testing.assert_allclose(after.offsets[hand], 1.2 * before.offsets[hand], rtol=1e-5)
    np.testing.assert_allclose(after.tips[LINK_INDEX["left_forearm"]], after.offsets[hand], rtol=1e-6)


def test_bones_end_at_their_childs_joint_and_the_crown_at_stature() -> None:
    theta = TEMPLATE.prior.copy()
    theta[ROOT + 1] = 0.53 * theta[0]
    skeleton = template_skeleton(TEMPLATE, theta)
    T_world_link = forward_kinematics(skeleton, template_pose(TEMPLATE, theta, 0.0, np.ones(LINK_COUNT, np.float32)))
    crown = T_world_link[LINK_INDEX["head"], :3, 3] + skeleton.tips[LINK_INDEX["head"]]
    assert crown[1] == pytest.approx(theta[0], rel=0.01)
    for child in ("left_shin", "left_foot", "right_forearm", "head"):
        link = LINK_INDEX[child]
        parent = LINK_INDEX[
            {"left_shin": "left_thigh", "left_foot": "left_shin", "right_forearm": "right_upper_arm"}.get(child, "neck")
        ]
        np.testing.assert_allclose(skeleton.tips[parent], skeleton.offsets[link], atol=1e-6)


def test_jacobian_predicts_a_small_step() -> None:
    theta = _some_theta(1)
    step = np.random.default_rng(2).normal(size=P) * 1e-3
    ends, radii, d_ends, d_radii = np.empty((K, 2, 3)), np.empty((K, 2)), np.empty((P, K, 2, 3)), np.empty((P, K, 2))
    jacobian(theta, 0.4, tuple(TEMPLATE[:10]), ROOT, ends, radii, d_ends, d_radii)
    _, _, moved_ends, moved_radii = _placed(theta + step, 0.4)
    np.testing.assert_allclose(ends + np.tensordot(step, d_ends, 1), moved_ends, atol=5e-5)
    np.testing.assert_allclose(radii + np.tensordot(step, d_radii, 1), moved_radii, atol=5e-6)


def test_points_match_the_cone_they_lie_on_or_one_that_is_nearer() -> None:
    theta = _some_theta(3)
    points, normals = _surface(theta, 0.0, np.ones(K, np.bool_), 300)
    _, _, ends, radii = _placed(theta, 0.0)
    n = len(points)
    cone, along, distance, outward = np.empty(n, np.int64), np.empty(n), np.empty(n), np.empty((n, 3))
    match(points, normals, ends, radii, np.ones(K, np.bool_), cone, along, distance, outward)
    assert (cone >= 0).all()
    assert np.abs(distance).max() < 1e-6
    match(points, -normals, ends, radii, np.ones(K, np.bool_), cone, along, distance, outward)
    assert (np.abs(distance[cone >= 0]) > 0.005).mean() > 0.9  # nothing matches from the inside


def _fit(template: Template, truth: Floats, start: Floats, used: NDArray[np.bool_]) -> Floats:
    points, normals = _surface(truth, 0.5, used, 1500)
    return fit_template(template, points, normals, unfitted(start, 0.5), used, None, 20, (0.15, 0.03)).theta


def test_fit_recovers_pose_and_sizes_of_its_own_shape() -> None:
    truth = TEMPLATE.prior.copy()
    truth[ROOT : ROOT + 3] = 0.1, 0.92, 0.05
    truth[SIZE_INDEX["upper_arm"]], truth[SIZE_INDEX["leg_radius"]] = 1.08, 1.2
    truth[angle_index(TEMPLATE, "left_upper_arm", "z")] = -0.8
    truth[angle_index(TEMPLATE, "right_upper_arm", "z")] = 1.1
    truth[angle_index(TEMPLATE, "right_shin", "x")] = 0.3
    start = TEMPLATE.prior.copy()
    start[ROOT : ROOT + 3] = 0.0, 0.9, 0.0
    start[angle_index(TEMPLATE, "left_upper_arm", "z")] = -0.6
    start[angle_index(TEMPLATE, "right_upper_arm", "z")] = 0.8
    theta = _fit(TEMPLATE, truth, start, np.ones(K, np.bool_))
    _, expected, _, _ = _placed(truth, 0.5)
    _, found, _, _ = _placed(theta, 0.5)
    assert np.linalg.norm(found - expected, axis=1).mean() < 0.02
    assert theta[SIZE_INDEX["leg_radius"]] == pytest.approx(1.2, abs=0.05)


def test_what_is_not_seen_stays_at_the_prior() -> None:
    truth = TEMPLATE.prior.copy()
    truth[ROOT + 1] = 0.9
    truth[SIZE_INDEX["trunk_radius"]] = 1.15
    start = TEMPLATE.prior.copy()
    start[ROOT + 1] = 0.9
    theta = _fit(TEMPLATE, truth, start, ~TEMPLATE.leg_cones)
    for size in ("thigh", "shin", "leg_radius", "foot"):
        assert theta[SIZE_INDEX[size]] == pytest.approx(1.0, abs=1e-6)
    assert theta[angle_index(TEMPLATE, "left_shin", "x")] == pytest.approx(0.0, abs=1e-6)


def test_knees_and_elbows_do_not_bend_backwards() -> None:
    truth = TEMPLATE.prior.copy()
    truth[ROOT + 1] = 0.9
    truth[angle_index(TEMPLATE, "left_shin", "x")] = -0.5
    truth[angle_index(TEMPLATE, "left_forearm", "y")] = 0.5
    start = TEMPLATE.prior.copy()
    start[ROOT + 1] = 0.9
    theta = _fit(TEMPLATE, truth, start, np.ones(K, np.bool_))
    assert theta[angle_index(TEMPLATE, "left_shin", "x")] >= -0.05
    assert theta[angle_index(TEMPLATE, "left_forearm", "y")] <= 0.05


def test_angles_the_template_does_not_have_are_refused() -> None:
    with pytest.raises(ValueError, match="left_shin does not turn about z"):
        angle_index(TEMPLATE, "left_shin", "z")
