"""The dataset of DISPOSE §7: twelve poses once, then free motion, without a jump between them."""

import numpy as np
import pytest

from common.geometry import quaternion
from sender.capture.builtin_body import builtin_body
from sender.capture.choreography import routine
from sender.capture.frame_set import CaptureError
from sender.capture.fundamental_poses import FUNDAMENTAL_POSES, fundamental_poses, joined
from sender.capture.performer import open_performer
from sender.capture.retarget import retarget


def test_there_are_twelve_and_each_is_held():
    clip = fundamental_poses()
    assert len(FUNDAMENTAL_POSES) == 12
    body = builtin_body()
    track = retarget(body, clip)
    hands = [body.joint("LeftHand"), body.joint("RightHand")]
    places = np.array([body.joint_transforms(pose, np.zeros(3))[hands, :, 3] for pose in track.local[::6]])
    speed = np.linalg.norm(np.diff(places, axis=0), axis=-1).max(axis=1)
    still = speed < 0.01
    starts = np.flatnonzero(still[1:] & ~still[:-1])
    assert len(starts) >= 12


def test_free_motion_follows_without_a_jump():
    body = builtin_body()
    first, then = retarget(body, fundamental_poses()), retarget(body, routine())
    track = joined(first, then)
    assert len(track.root) == len(first.root) + len(then.root) + 59
    turns = quaternion.angle_between(track.local[1:], track.local[:-1])
    assert turns.max() < np.deg2rad(25)
    assert np.linalg.norm(np.diff(track.root, axis=0), axis=1).max() < 0.05


def test_performer_by_name_needs_data_for_clips_only():
    assert open_performer("builtin", "dispose12+routine").name == "builtin/dispose12+routine"
    with pytest.raises(CaptureError, match="14_06"):
        open_performer("builtin", "dispose12+14_06")
