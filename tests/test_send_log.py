"""Every send leaves a line, and the file stays within its bound."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sender.candidate_poses.mesh_scheduler import Reason, SendRecord
from sender.send_log import REMEMBERED, SendLog


def record(pose_id: int, reason: Reason = Reason.BEST) -> SendRecord:
    return SendRecord("wall", pose_id, reason, 0.5, 0.75, 0.25, 40_000, 120_000, 7, 9)


def test_a_line_tells_all_of_a_send(tmp_path: Path) -> None:
    log = SendLog(tmp_path / "sends.jsonl")
    log.add(record(3))
    log.add(record(4, Reason.RETAINED))
    log.close()
    first, second = [json.loads(line) for line in (tmp_path / "sends.jsonl").read_text().splitlines()]
    assert first == {
        "receiver_id": "wall", "pose_id": 3, "reason": "best χ", "chi": 0.5, "chi_best": 0.75,
        "retain_threshold": 0.25, "size_bytes": 40_000, "budget_bytes": 120_000, "chosen_ns": 7, "sent_ns": 9,
        "preview": False,
    }  # fmt: skip
    assert (second["pose_id"], second["reason"]) == (4, "retained, χ > RT")


def test_the_file_goes_on_after_a_restart_and_never_outgrows_its_bound(tmp_path: Path) -> None:
    file = tmp_path / "sends.jsonl"
    for start in (0, 50):
        log = SendLog(file, max_bytes=2000)
        for pose_id in range(start, start + 50):
            log.add(record(pose_id))
        log.close()
    old = tmp_path / "sends.jsonl.1"
    assert {path.name for path in tmp_path.iterdir()} == {file.name, old.name}
    assert max(file.stat().st_size, old.stat().st_size) <= 2000
    ids = [json.loads(line)["pose_id"] for path in (old, file) for line in path.read_text().splitlines()]
    assert ids == list(range(100 - len(ids), 100))


def test_without_a_file_the_newest_are_remembered() -> None:
    log = SendLog(None)
    for pose_id in range(REMEMBERED + 5):
        log.add(record(pose_id, Reason.FIRST if pose_id == 0 else Reason.GAIN))
    log.close()
    figures = log.figures()
    assert figures["by_reason"] == {"the receiver has nothing": 1, "largest gain of coverage": REMEMBERED + 4}
    assert [figures["newest"][index]["pose_id"] for index in (0, -1)] == [5, REMEMBERED + 4]


def test_a_full_disk_is_said_once_and_ends_the_file_alone(caplog: pytest.LogCaptureFixture) -> None:
    log = SendLog(Path("/dev/full"))
    for pose_id in range(3):
        log.add(record(pose_id))
    assert len(log.figures()["newest"]) == 3
    assert [entry.getMessage() for entry in caplog.records] == [
        "/dev/full: nothing more is logged: No space left on device"
    ]
    log.close()
