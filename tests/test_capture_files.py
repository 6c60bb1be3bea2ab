"""Captured performances come back from disk as they were."""

import numpy as np

from scripts.capture_files import CapturedFrame, load_frames, save_frames
from tests.capsule_person import SKELETON
from tests.capsule_views import arms_down_by, capsule_views


def frame(angle_rad: float, views: int, own_confidence: float | None) -> CapturedFrame:
    pose = arms_down_by(angle_rad)
    own = None if own_confidence is None else (SKELETON, arms_down_by(angle_rad + 0.1), own_confidence)
    return CapturedFrame(angle_rad, capsule_views(pose)[:views], (SKELETON, pose), own)


def test_frames_with_and_without_views_and_skeletons_come_back(tmp_path):
    frames = [frame(0.2, 4, None), frame(0.4, 0, 0.25), frame(0.6, 2, 0.75)]
    cameras = [view.camera for view in frames[0].views]
    assert load_frames(tmp_path / "capture", cameras) is None
    save_frames(tmp_path / "capture", frames, cameras)
    found = load_frames(tmp_path / "capture", cameras)
    assert found is not None
    assert [f.time_s for f in found] == [0.2, 0.4, 0.6]
    for saved, loaded in zip(frames, found, strict=True):
        assert [v.camera.name for v in loaded.views] == [v.camera.name for v in saved.views]
        for a, b in zip(saved.views, loaded.views, strict=True):
            assert (a.u0, a.v0) == (b.u0, b.v0)
            np.testing.assert_array_equal(a.depth_mm, b.depth_mm)
            np.testing.assert_array_equal(a.colour, b.colour)
        np.testing.assert_array_equal(saved.true[1].rotations, loaded.true[1].rotations)
        assert (saved.own is None) == (loaded.own is None)
        if saved.own is not None and loaded.own is not None:
            assert loaded.own[2] == saved.own[2]
            np.testing.assert_array_equal(saved.own[0].radii, loaded.own[0].radii)
            np.testing.assert_array_equal(saved.own[1].rotations, loaded.own[1].rotations)
