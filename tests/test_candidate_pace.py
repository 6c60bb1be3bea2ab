"""How often frames become candidate poses."""

from __future__ import annotations

from itertools import pairwise

import pytest

from sender.candidate_poses.candidate_pace import CandidatePace

MS = 1_000_000
FRAME_NS = 33 * MS


def begun_at(pace: CandidatePace, work_ns: int, seconds: float) -> list[int]:
    """When frames, taken in the moment they are captured, are begun, each after ``work_ns`` done."""
    begun: list[int] = []
    done_ns: int | None = None
    for now_ns in range(0, int(seconds * 1e9), FRAME_NS):
        if done_ns is not None and now_ns >= done_ns:
            pace.done(work_ns)
            done_ns = None
        if pace.due(now_ns, now_ns):
            pace.begin(now_ns, now_ns)
            begun.append(now_ns)
            done_ns = now_ns + work_ns
    return begun


def test_the_first_frame_is_taken_at_once() -> None:
    assert CandidatePace(200 * MS, 0.25).due(5_000 * MS, 7_000 * MS)


def test_a_fast_machine_is_bounded_by_the_interval() -> None:
    begun = begun_at(CandidatePace(200 * MS, 0.25), 10 * MS, 10)
    assert min(b - a for a, b in pairwise(begun)) >= 200 * MS
    assert len(begun) >= 42


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 1.0])
def test_a_slow_machine_is_bounded_by_the_share(share: float) -> None:
    work_ns = 400 * MS
    begun = begun_at(CandidatePace(200 * MS, share), work_ns, 60)
    spent = len(begun) * work_ns / 60e9
    assert 0.85 * share <= spent <= share + work_ns / 60e9


def test_one_at_a_time() -> None:
    pace = CandidatePace(0, 1.0)
    pace.begin(0, 0)
    assert not pace.due(10_000 * MS, 10_000 * MS)
    pace.done(1)
    assert pace.due(10_000 * MS, 10_000 * MS)


def test_done_without_a_beginning_changes_nothing() -> None:
    pace = CandidatePace(200 * MS, 0.25)
    pace.done(50 * MS)
    assert pace.due(50 * MS, 50 * MS)
