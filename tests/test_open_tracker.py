"""Every tracker that settings allow exists, and the other way round; settings without an effect are refused."""

from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from sender.config import CaptureSettings, TrackingSettings
from sender.fitting.open_tracker import TRACKERS, WEIGHTS


def test_settings_name_the_trackers_there_are():
    assert set(get_args(get_type_hints(TrackingSettings)["tracker"])) == set(TRACKERS)


def test_settings_name_the_weights_there_are():
    assert set(get_args(get_type_hints(TrackingSettings)["weights"])) == set(WEIGHTS)


def test_depth_cannot_be_switched_off_for_a_recording():
    with pytest.raises(ValueError, match="depth"):
        CaptureSettings(source="recording", recording=Path("monday"), depth=False)
