"""What a report says of skeletons and chunks, and that a new run of the sender begins it anew."""

from __future__ import annotations

from common.transport.chunks import Chunk
from common.transport.reception import Reception


def chunk(epoch: int, sequence: int, send_ns: int) -> Chunk:
    return Chunk(epoch, 0, 0, 1, 0, sequence, 0, send_ns, b"x")


def test_a_report_before_anything_came() -> None:
    report = Reception(5, 6).report(100, None, 0, skeleton_divisor=4)
    assert (report.receiver_id, report.receiver_epoch, report.number, report.clock_ns) == (5, 6, 1, 100)
    assert report.skeleton_divisor == 4
    assert report.sender_epoch is report.skeleton_send_ns is report.skeleton_delay_ns is report.bulk_delay_ns is None


def test_a_report_has_the_newest_skeleton_and_the_least_delays_since_the_last_one() -> None:
    reception = Reception(1, 1)
    reception.skeleton(9, 1000, 1500)
    reception.skeleton(9, 2000, 2300)
    reception.chunk(chunk(9, 0, 1900), 1200, 2350)
    reception.chunk(chunk(9, 2, 1950), 1300, 2360)
    report = reception.report(2400, 3, 4)
    assert (report.sender_epoch, report.skeleton_send_ns, report.skeleton_hold_ns) == (9, 2000, 100)
    assert (report.skeleton_delay_ns, report.bulk_delay_ns, report.bulk_bytes) == (300, 410, 2500)
    assert (report.next_chunk, report.missing_chunks) == (3, (1,))
    assert (report.body_revision, report.repository_poses) == (3, 4)
    later = reception.report(2500, 3, 4)
    assert (later.number, later.skeleton_send_ns, later.skeleton_hold_ns) == (2, 2000, 200)
    assert later.skeleton_delay_ns is later.bulk_delay_ns is None


def test_a_new_run_of_the_sender_begins_anew_whichever_part_of_it_comes_first() -> None:
    reception = Reception(1, 1)
    reception.skeleton(9, 1000, 1500)
    reception.chunk(chunk(9, 7, 1900), 1200, 2350)
    reception.chunk(chunk(10, 0, 1900), 1200, 2350)
    report = reception.report(2400, None, 0)
    assert (report.sender_epoch, report.next_chunk, report.bulk_bytes) == (10, 1, 1200)
    assert report.skeleton_send_ns is None  # that one was of the old run
    reception.skeleton(11, 3000, 3500)
    report = reception.report(3600, None, 0)
    assert (report.sender_epoch, report.next_chunk, report.skeleton_send_ns) == (11, 0, 3000)
