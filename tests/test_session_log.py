"""What a receiver hears, kept as a session that plays, whatever becomes of the disk or the receiver."""

from __future__ import annotations

from pathlib import Path

import pytest

from common.runtime.session_recording import RecordingError, SessionReader
from receiver.session_log import SessionLog

FULL = Path("/dev/full")


def test_what_was_added_is_there_under_its_name_once_it_is_closed(tmp_path):
    log = SessionLog(tmp_path / "s.mcap", "studio", 3)
    for number in range(100):
        log.add("v1/studio/3/skeleton", number, bytes([number]) * 1000)
    assert [file.name for file in tmp_path.iterdir()] == ["s.mcap.part"]
    log.close()
    log.close()
    assert [file.name for file in tmp_path.iterdir()] == ["s.mcap"]
    reader = SessionReader(tmp_path / "s.mcap", "v1")
    assert reader.about["person"] == "3"
    assert [message.payload[0] for message in reader.messages()] == list(range(100))


def test_after_a_crash_what_was_written_plays(tmp_path):
    log = SessionLog(tmp_path / "s.mcap", "studio", 0)
    for number in range(200):
        log.add("k", number, bytes([number]) * 1000)
    reader = SessionReader(tmp_path / "s.mcap.part", "v1")
    found = [message.payload[0] for message in reader.messages()]
    assert found == list(range(len(found)))
    assert len(found) > 100
    assert reader.damage is not None


@pytest.mark.skipif(not FULL.exists(), reason="no /dev/full here")
def test_a_full_disk_is_said_once_and_ends_the_file_not_the_session(tmp_path, caplog):
    (tmp_path / "s.mcap.part").symlink_to(FULL)
    log = SessionLog(tmp_path / "s.mcap", "studio", 0)
    for number in range(2000):
        log.add("k", number, bytes(1000))
    log.close()
    assert caplog.text.count("nothing more is recorded") == 1
    assert "No space left" in caplog.text


def test_a_place_that_cannot_be_written_is_an_error_at_once(tmp_path):
    with pytest.raises(RecordingError, match="cannot write"):
        SessionLog(tmp_path / "nowhere" / "s.mcap", "studio", 0)
