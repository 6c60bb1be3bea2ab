"""The offscreen viewer shows what the page would show."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from common.body.live_surface import LiveSurface
from common.body.map_layout import map_layout
from common.body.skeleton_pose import forward_kinematics
from common.geometry.camera_model import Camera
from receiver.viewer.offscreen_viewer import OffscreenViewer
from receiver.viewer.viewer import ConnectionState, NullViewer, Viewer, ViewerStatus
from tests.capsule_person import SHIRT, SKELETON, capsule_person, link_points, pose_at, shown_frame

# In front of the person at 3 m, looking along -Z.
FRONT = Camera("front", 160, 200, 220.0, 220.0, 79.5, 99.5, np.array(
    [[1, 0, 0, 0], [0, -1, 0, 0.9], [0, 0, -1, 3], [0, 0, 0, 1.0]]
))  # fmt: skip


def viewer_with(*pose_ids: int) -> OffscreenViewer:
    viewer = OffscreenViewer()
    for pose_id in pose_ids:
        viewer.add_pose(capsule_person(pose_id))
    return viewer


def seen(viewer: OffscreenViewer) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    return viewer.render([FRONT])[0]


def test_person_stands_in_the_middle_in_its_colours() -> None:
    viewer = viewer_with(1)
    viewer.show(shown_frame(capsule_person(1), time_s=0.0))
    colour, depth = seen(viewer)
    assert tuple(colour[75, 79]) == pytest.approx(SHIRT, abs=2)
    assert depth[75, 79] == pytest.approx(3 - 0.15, abs=0.1)
    assert tuple(colour[0, 0]) == (255, 255, 255)
    assert depth[0, 0] == 0


def test_picture_follows_the_motion() -> None:
    viewer = viewer_with(1)
    pictures = []
    for time_s in (0.0, 0.8):
        viewer.show(shown_frame(capsule_person(1), time_s))
        pictures.append(seen(viewer)[0])
    assert (pictures[0] != pictures[1]).any(axis=2).sum() > 200
    assert viewer.frames_shown == 2


def test_nobody_is_shown_before_the_first_pose_and_after_the_last() -> None:
    viewer = viewer_with()
    viewer.show(shown_frame(None, 0.0))
    viewer.show(shown_frame(capsule_person(1), 0.0))  # not added yet
    assert viewer.frames_shown == 0
    assert not seen(viewer)[1].any()
    viewer.add_pose(capsule_person(1))
    viewer.show(shown_frame(capsule_person(1), 0.0))
    assert seen(viewer)[1].any()
    viewer.remove_pose(1)
    assert not seen(viewer)[1].any()


def test_removing_another_pose_leaves_the_picture() -> None:
    viewer = viewer_with(1, 2)
    viewer.show(shown_frame(capsule_person(1), 0.0))
    before = seen(viewer)[0]
    viewer.remove_pose(2)
    np.testing.assert_array_equal(seen(viewer)[0], before)


def test_in_point_mode_every_skeleton_moves_the_points_and_the_mesh_is_not_shown() -> None:
    person = capsule_person(1)
    meshes, points = OffscreenViewer(), OffscreenViewer(mode="points")
    points.show(shown_frame(person, 0.4))
    assert points.frame is None
    assert not seen(points)[1].any()
    for viewer in (meshes, points):
        viewer.add_pose(person)
        viewer.show_points(link_points(person))
    for time_s in (0.4, 2.3):
        for viewer in (meshes, points):
            viewer.show(shown_frame(person, time_s))
        (_, of_mesh), (_, of_points) = seen(meshes), seen(points)
        near = cv2.dilate(np.uint8(of_mesh > 0), np.ones((7, 7), np.uint8)) > 0  # a splat, and a bent joint
        assert (of_points > 0).sum() > 0.3 * (of_mesh > 0).sum()
        assert ((of_points > 0) & ~near).sum() == 0
    points.show_points(None)
    assert not seen(points)[1].any()


@pytest.mark.parametrize("viewer", [NullViewer(), OffscreenViewer()], ids=["null", "offscreen"])
def test_every_viewer_takes_the_same_calls(viewer: Viewer) -> None:
    viewer.add_pose(capsule_person(1))
    viewer.show_points(link_points(capsule_person(1)))
    viewer.show(shown_frame(capsule_person(1), 0.0))
    viewer.set_status(ViewerStatus(ConnectionState.RECEIVING))
    viewer.remove_pose(1)


def test_a_withheld_frame_is_the_picture_before_it_once_more() -> None:
    """Though its links are the newest skeleton's, its mesh follows maps by those it was shown with."""
    person = capsule_person(7)
    layout = map_layout(SKELETON, 1000, 25.0)
    offsets = np.full((layout.height, layout.width, 4), 128, np.uint8)
    offsets[::2, :, 0] = 228  # rings about every link
    viewer = OffscreenViewer(mode="live")
    viewer.add_pose(person)
    links = forward_kinematics(SKELETON, pose_at(0.5))[:, :3]
    frame = dataclasses.replace(
        shown_frame(person, 0.5), links=links, surfaces=(LiveSurface(7, layout, offsets),), live=1.0
    )
    viewer.show(frame)
    before = viewer.render([FRONT])[0][0]
    elsewhere = forward_kinematics(SKELETON, pose_at(1.7))[:, :3]
    viewer.show(dataclasses.replace(frame, sequence=1, links=elsewhere))
    assert (viewer.render([FRONT])[0][0] != before).any()
    viewer.show(frame)
    viewer.show(dataclasses.replace(frame, sequence=2, withheld=True, links=elsewhere))
    np.testing.assert_array_equal(viewer.render([FRONT])[0][0], before)
