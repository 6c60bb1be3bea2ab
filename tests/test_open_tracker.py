"""Every tracker that settings allow exists, and the other way round."""

from typing import get_args, get_type_hints

from sender.config import TrackingSettings
from sender.fitting.open_tracker import TRACKERS, WEIGHTS


def test_settings_name_the_trackers_there_are():
    assert set(get_args(get_type_hints(TrackingSettings)["tracker"])) == set(TRACKERS)


def test_settings_name_the_weights_there_are():
    assert set(get_args(get_type_hints(TrackingSettings)["weights"])) == set(WEIGHTS)
