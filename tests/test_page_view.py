"""The page's messages read back by a page that is no browser."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.body.skinning import Skinning, animate
from receiver.viewer.page_messages import (
    encode_frame,
    encode_hello,
    encode_pose,
    encode_remove,
    encode_status,
)
from receiver.viewer.page_view import PageView
from receiver.viewer.viewer import ConnectionState, MovedPose, ViewerStatus
from tests.capsule_person import capsule_person, shown_frame

PERSON = capsule_person(pose_id=7)
POSE = encode_pose(PERSON)
FRAME = encode_frame(shown_frame(PERSON, 1.3, 90))


def view_of(*messages: bytes) -> PageView:
    view = PageView()
    for message in messages:
        view.take(message)
    return view


@pytest.mark.parametrize("skinning", ["rigid", "linear", "spherical"])
def test_the_person_stands_as_the_receiver_moved_it(skinning: Skinning) -> None:
    view = PageView()
    view.take_text(encode_hello(skinning))
    view.take(POSE)
    view.take(FRAME)
    assert view.person is not None
    frame = shown_frame(PERSON, 1.3, 90)
    assert frame.motion is not None
    assert np.abs(view.person.vertices() - animate(PERSON, frame.motion, skinning)).max() < 1e-4  # quantised places
    np.testing.assert_array_equal(view.person.pose.mesh.faces, PERSON.faces_drawn)
    assert view.person.pose.mesh.texture.shape == PERSON.mesh.texture.shape
    assert np.abs(view.person.pose.mesh.texture.astype(int) - PERSON.mesh.texture).max() <= 3
    assert view.taken_in == 2


def test_a_frame_before_its_mesh_waits_for_it() -> None:
    view = view_of(FRAME)
    assert view.person is None
    view.take(POSE)
    assert view.person is not None
    assert view.person.frame.sequence == 90


def test_the_last_picture_stays_until_the_next_mesh_is_here() -> None:
    other = capsule_person(pose_id=8)
    view = view_of(POSE, FRAME, encode_frame(shown_frame(other, 2.0, 91)))
    assert view.person is not None
    assert view.person.frame.sequence == 90
    view.take(encode_pose(other))
    assert (view.person.pose.pose_id, view.person.frame.sequence) == (8, 91)


def test_nobody_without_a_pose_and_after_its_removal() -> None:
    assert view_of(POSE, FRAME, encode_frame(shown_frame(None, 0.0))).person is None
    assert view_of(POSE, FRAME, encode_remove(7)).person is None
    assert view_of(POSE, FRAME, encode_remove(8)).person is not None


def test_a_withheld_frame_is_told() -> None:
    frame = shown_frame(PERSON, 1.3)
    for withheld in (False, True):
        view = view_of(POSE, encode_frame(dataclasses.replace(frame, withheld=withheld)))
        assert view.person is not None
        assert view.person.frame.withheld == withheld


def test_of_blended_poses_the_first_is_shown() -> None:
    frame = shown_frame(PERSON, 1.3, 90)
    assert frame.motion is not None
    others = (MovedPose(8, 2 * frame.motion), MovedPose(9, 3 * frame.motion))
    message = encode_frame(dataclasses.replace(frame, others=others))
    view, alone = view_of(POSE, message), view_of(POSE, FRAME)
    assert view.person is not None
    assert alone.person is not None
    np.testing.assert_array_equal(view.person.vertices(), alone.person.vertices())
    for wrong in (message[:-1], message + b"\0", FRAME[:-4]):
        with pytest.raises(ValueError, match="for each other pose"):
            PageView().take(wrong)


def test_the_picture_is_live_while_the_receiver_receives() -> None:
    view = PageView()
    for state in ConnectionState:
        view.take_text(encode_status(ViewerStatus(state)))
        assert view.sight.live == (state is ConnectionState.RECEIVING)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "{}", "null", '{"kind": "status"}', '{"kind": "status", "connection": "?"}',
     json.dumps(json.loads(encode_hello("linear")) | {"version": 1}),
     json.dumps(json.loads(encode_hello("linear")) | {"skinning": "elastic"})],
)  # fmt: skip
def test_text_that_is_no_message_is_refused(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011
        PageView().take_text(text)


@given(st.binary(max_size=64))
def test_nonsense_is_refused(message: bytes) -> None:
    if message[:1] == POSE[:1] and message[1:2] == b"\3" and len(message) >= 8:
        return  # REMOVE takes any number
    with pytest.raises(ValueError):  # noqa: PT011
        PageView().take(message)


@given(st.sampled_from([POSE, FRAME]), st.data())
def test_damaged_messages_are_refused_or_show_something_whole(message: bytes, data: st.DataObject) -> None:
    damaged = bytearray(message)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, min(len(damaged), 2000) - 1))] = data.draw(st.integers(0, 255))
    damaged = damaged[: data.draw(st.integers(0, len(damaged)))] if data.draw(st.booleans()) else damaged
    view = view_of(FRAME if message is POSE else POSE)
    try:
        view.take(bytes(damaged))
    except ValueError:
        return
    if view.person is not None:
        assert len(view.person.vertices()) > view.person.pose.mesh.faces.max()
