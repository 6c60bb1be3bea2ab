"""Every tracker that settings allow exists, and the other way round; settings without an effect are refused."""

from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from common.body.skeleton import human_skeleton
from sender.config import CaptureSettings, TrackingSettings
from sender.fitting.body_model import BodyModel
from sender.fitting.open_tracker import TRACKERS, WEIGHTS, ignored_settings


def test_settings_name_the_trackers_there_are():
    assert set(get_args(get_type_hints(TrackingSettings)["tracker"])) == set(TRACKERS)


def test_settings_name_the_weights_there_are():
    assert set(get_args(get_type_hints(TrackingSettings)["weights"])) == set(WEIGHTS)


def test_depth_cannot_be_switched_off_for_a_recording():
    with pytest.raises(ValueError, match="depth"):
        CaptureSettings(source="recording", recording=Path("monday"), depth=False)


def test_what_a_tracker_will_not_use_is_said():
    body = BodyModel(human_skeleton(1.75))
    assert ignored_settings("gauss-newton", body, "numba") == []
    assert ignored_settings("particles", None, "opencl") == []
    assert "saved body" in ignored_settings("articp", body, "numba")[0]
    assert "opencl" in ignored_settings("gauss-newton", None, "opencl")[0]
    assert len(ignored_settings("articp", body, "opencl")) == 2
