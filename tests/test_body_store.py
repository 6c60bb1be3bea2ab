"""The body kept for a restart: whole or not at all, and never a reason to fail."""

from __future__ import annotations

import logging

import pytest

from common.runtime.daemon import DaemonError
from sender.body_store import BodyStore
from sender.fitting.gauss_newton_tracker import GaussNewtonSettings, GaussNewtonTracker
from tests.rig_scene import frame_set, skeleton_path


@pytest.fixture(scope="module")
def body_bytes() -> bytes:
    tracker = GaussNewtonTracker(GaussNewtonSettings())
    path = skeleton_path(tracker)
    for sequence in range(1, 40):
        path.process(frame_set(sequence))
    assert tracker.body is not None
    return tracker.body.to_bytes()


def test_a_saved_body_comes_back(tmp_path, body_bytes):
    BodyStore(tmp_path, "studio", 0).save(body_bytes)
    body = BodyStore(tmp_path, "studio", 0).load()
    assert body is not None
    assert body.to_bytes() == body_bytes
    assert [file.name for file in tmp_path.iterdir()] == ["studio-0.body"]


def test_every_person_and_site_has_a_body_of_its_own(tmp_path, body_bytes):
    BodyStore(tmp_path, "studio", 0).save(body_bytes)
    assert BodyStore(tmp_path, "studio", 1).load() is None
    assert BodyStore(tmp_path, "lobby", 0).load() is None


@pytest.mark.parametrize("damage", [lambda b: b[:-100], lambda b: b"", lambda b: b"\x00" * len(b)])
def test_a_damaged_body_is_said_so_and_not_used(tmp_path, body_bytes, damage, caplog):
    (tmp_path / "studio-0.body").write_bytes(damage(body_bytes))
    with caplog.at_level(logging.WARNING):
        assert BodyStore(tmp_path, "studio", 0).load() is None
    assert "studio-0.body is not used" in caplog.text


def test_a_body_that_cannot_be_written_costs_a_warning(tmp_path, body_bytes, caplog):
    store = BodyStore(tmp_path, "studio", 0)
    (tmp_path / "studio-0.body.part").mkdir()  # in the way of the file, even for root
    with caplog.at_level(logging.WARNING):
        store.save(body_bytes)
    assert "was not written" in caplog.text


def test_a_state_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DaemonError, match="state folder"):
        BodyStore(tmp_path / "file" / "state", "studio", 0)
