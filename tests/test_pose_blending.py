"""Several poses' pictures as one: the mean, and who is in it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from common.body.skeleton_pose import forward_kinematics
from common.body.skinning import link_motion
from receiver.repository.pose_selection import PoseSelector, SelectionSettings
from receiver.viewer.offscreen_viewer import OffscreenViewer
from receiver.viewer.pose_blending import blended
from receiver.viewer.viewer import MovedPose
from scripts.fidelity import measuring_cameras
from tests.capsule_person import SKELETON, capsule_person, pose_at, shown_frame


def picture(level: int, covered: slice):
    colour, depth = np.full((4, 6, 3), 255, np.uint8), np.zeros((4, 6), np.float32)
    colour[:, covered], depth[:, covered] = level, level / 100
    return colour, depth


def test_colour_is_the_mean_and_depth_there_where_half_of_them_show_something() -> None:
    pictures = [picture(100, slice(0, 3)), picture(40, slice(0, 2)), picture(10, slice(0, 5))]
    colour, depth = blended(pictures)
    np.testing.assert_array_equal(colour[0, :, 0], [50, 50, 122, 173, 173, 255])
    np.testing.assert_allclose(depth[0], [1, 1, 1, 0, 0, 0])


def test_one_picture_is_itself() -> None:
    alone = picture(100, slice(0, 3))
    assert blended([alone]) is alone


class Poses:
    """Poses of given scores, in order of use."""

    def __init__(self, sigmas: dict[int, float]) -> None:
        self.sigmas = sigmas

    def __contains__(self, pose_id: int) -> bool:
        return pose_id in self.sigmas

    def by_use(self) -> list[int]:
        return list(self.sigmas)

    def scores(self, pose_ids, T_world_link, limit=0.0, best=0):
        scored = [self.sigmas[pose_id] for pose_id in pose_ids]
        below = next((n for n, sigma in enumerate(scored) if sigma < limit), len(scored) - 1)
        return np.array(scored[: below + 1], np.float32)


LINKS = np.zeros((23, 4, 4), np.float32)


def test_the_next_best_are_blended_best_first() -> None:
    poses = Poses({1: 0.5, 2: 0.1, 3: 0.4, 4: 0.2})
    for blended_poses, others in ((1, ()), (2, (4,)), (3, (4, 3)), (8, (4, 3, 1))):
        selection = PoseSelector(SelectionSettings(blended=blended_poses)).select(poses, LINKS)
        assert selection is not None
        assert (selection.pose_id, selection.others) == (2, others)


def test_a_pose_that_is_kept_is_first_whatever_the_others_are() -> None:
    selector = PoseSelector(SelectionSettings(hysteresis=0.3))
    poses = Poses({1: 0.2, 2: 0.9, 3: 0.8})
    first = selector.select(poses, LINKS)
    assert first is not None
    poses.sigmas = {1: 0.2, 2: 0.15, 3: 0.8}
    kept = selector.select(poses, LINKS)
    assert kept is not None
    assert kept.held
    assert (kept.pose_id, kept.others) == (1, (2, 3))


def test_no_pose_makes_no_picture() -> None:
    with pytest.raises(ValueError, match="blended"):
        SelectionSettings(blended=0)


def test_the_offscreen_picture_is_the_mean_of_each_pose_s_own() -> None:
    poses = [capsule_person(7), dataclasses.replace(capsule_person(8), mesh=_inverted(capsule_person(8).mesh))]
    T_world_link = forward_kinematics(SKELETON, pose_at(1.0))
    camera = measuring_cameras(poses[0].mesh.vertices)[0]
    frame = shown_frame(poses[0], 1.0)
    other = MovedPose(8, link_motion(poses[1], T_world_link))
    viewer = OffscreenViewer()
    alone = []
    for pose in poses:
        viewer.add_pose(pose)
        viewer.show(dataclasses.replace(frame, pose_id=pose.pose_id, motion=link_motion(pose, T_world_link)))
        alone.append(viewer.render([camera])[0][0].astype(float))
    viewer.show(dataclasses.replace(frame, others=(other,)))
    both = viewer.render([camera])[0][0]
    assert abs(alone[0] - alone[1]).max() > 50
    np.testing.assert_allclose(both, (alone[0] + alone[1]) / 2, atol=1)
    viewer.remove_pose(8)
    viewer.show(dataclasses.replace(frame, others=(other,)))  # it left the repository meanwhile
    np.testing.assert_array_equal(viewer.render([camera])[0][0], alone[0])


def _inverted(mesh):
    return dataclasses.replace(mesh, texture=255 - mesh.texture)
