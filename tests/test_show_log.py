"""The log of what was shown survives being read back, and being cut short."""

from pathlib import Path

import pytest

from receiver.show_log import ShowLog, read_show_log


def test_records_come_back_in_order(tmp_path):
    path = tmp_path / "run" / "shown.log"
    log = ShowLog(path)
    log.add("skeleton", 1, b"\x00" * 250)
    log.add("frame", 2, [7, 8, None, 0.5, 9])
    log.close()
    assert list(read_show_log(path)) == [("skeleton", 1, b"\x00" * 250), ("frame", 2, [7, 8, None, 0.5, 9])]


def test_a_log_cut_short_by_a_crash_gives_its_whole_records(tmp_path):
    path = tmp_path / "shown.log"
    log = ShowLog(path)
    for index in range(5):
        log.add("skeleton", index, b"x" * 100)
    log.close()
    path.write_bytes(path.read_bytes()[:-30])
    assert [time_ns for _, time_ns, _ in read_show_log(path)] == [0, 1, 2, 3]


def test_another_file_is_refused(tmp_path):
    path = tmp_path / "shown.log"
    path.write_bytes(b"\x01\x02\x03")
    with pytest.raises(ValueError, match="not a show log"):
        list(read_show_log(path))


def test_a_full_disk_ends_the_log_and_not_the_session(caplog):
    log = ShowLog(Path("/dev/full"))
    for index in range(1000):
        log.add("skeleton", index, b"x" * 250)
    log.close()
    assert [record.getMessage() for record in caplog.records] == [
        "/dev/full: nothing more is logged: No space left on device"
    ]


def test_a_full_disk_noticed_at_the_end_is_said_too(caplog):
    log = ShowLog(Path("/dev/full"))
    log.add("skeleton", 1, b"x")
    log.close()
    log.close()
    assert len(caplog.records) == 1
