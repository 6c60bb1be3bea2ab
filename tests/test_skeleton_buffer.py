"""Newest wins: order, duplicates, epochs and packets from the future."""

import pytest

from common.body.skeleton_pose import rest_pose
from common.wire.skeleton_packet import SkeletonPacket
from receiver.skeleton_buffer import FUTURE_RUN, RETIRED_EPOCHS, SkeletonBuffer

FRAME_NS = 33_333_333


def packet(sequence: int, epoch: int = 1, capture_ns: int | None = None) -> SkeletonPacket:
    return SkeletonPacket(
        person=0,
        epoch=epoch,
        sequence=sequence,
        capture_ns=sequence * FRAME_NS if capture_ns is None else capture_ns,
        body_revision=1,
        fit_confidence=1.0,
        pose=rest_pose(),
        previous=None,
    )


def fed(*sequences: int) -> SkeletonBuffer:
    buffer = SkeletonBuffer()
    for sequence in sequences:
        buffer.push(packet(sequence), sequence * FRAME_NS)
    return buffer


def test_in_order_packets_are_all_shown():
    buffer = fed(1, 2, 3)
    assert buffer.counts["accepted"] == 3
    assert buffer.counts["lost"] == 0
    assert buffer.newest is not None
    assert buffer.newest.sequence == 3


def test_late_and_repeated_packets_are_dropped_and_counted():
    buffer = fed(1, 2, 5)
    assert not buffer.push(packet(4), 5 * FRAME_NS)
    assert not buffer.push(packet(5), 5 * FRAME_NS)
    assert buffer.newest is not None
    assert buffer.newest.sequence == 5
    assert (buffer.counts["stale"], buffer.counts["duplicate"], buffer.counts["lost"]) == (1, 1, 2)


def test_what_layers_have_that_are_not_taken_is_not_lost():
    buffer = fed(0, 1, 2, 4)  # 3 is lost
    buffer.take(3)
    for sequence in (6, 8, 12):  # 10 is lost
        assert buffer.push(packet(sequence), sequence * FRAME_NS)
    assert (buffer.counts["accepted"], buffer.counts["lost"], buffer.counts["not taken"]) == (7, 2, 4)


def test_of_a_layer_that_is_joined_nothing_is_lost_before_its_first_packet():
    buffer = fed(0)
    buffer.take(2)
    buffer.push(packet(4), 4 * FRAME_NS)
    buffer.take(4)  # asked for, but on its way
    for sequence in (8, 12, 16, 17, 18, 20):  # 19 is lost
        assert buffer.push(packet(sequence), sequence * FRAME_NS)
    assert buffer.counts["lost"] == 1


def test_a_new_epoch_takes_over_and_the_old_one_never_returns():
    buffer = fed(100, 101)
    assert buffer.push(packet(1, epoch=2, capture_ns=5), 102 * FRAME_NS)
    assert not buffer.push(packet(102, epoch=1), 103 * FRAME_NS)
    assert buffer.counts["old_epoch"] == 1
    assert buffer.newest is not None
    assert buffer.newest.epoch == 2


@pytest.mark.parametrize(
    "forged",
    [
        packet(2**32 - 1, capture_ns=3 * FRAME_NS),  # sequence leaps, time does not
        packet(3, capture_ns=10**18),  # time leaps
    ],
)
def test_a_packet_from_the_future_does_not_silence_the_honest_ones(forged):
    buffer = fed(1, 2)
    assert not buffer.push(forged, 3 * FRAME_NS)
    assert buffer.counts["far_future"] == 1
    assert buffer.push(packet(3), 3 * FRAME_NS)


def test_a_first_packet_held_up_for_seconds_does_not_silence_the_stream():
    buffer = SkeletonBuffer()
    late_ns = 5_000_000_000  # its fit compiled kernels, say; those after it are on time
    assert buffer.push(packet(1), FRAME_NS + late_ns)
    arrivals = [FRAME_NS + late_ns + k * FRAME_NS for k in range(1, 100)]
    taken = [buffer.push(packet(1 + k, capture_ns=t), t) for k, t in enumerate(arrivals, 1)]
    assert taken.index(True) == FUTURE_RUN - 1
    assert all(taken[FUTURE_RUN:])


def test_a_run_of_unrelated_packets_from_the_future_is_refused():
    buffer = fed(1, 2)
    for k in range(10 * FUTURE_RUN):
        assert not buffer.push(packet(3, capture_ns=10**18 - k), 3 * FRAME_NS + k)
    assert buffer.push(packet(3), 4 * FRAME_NS)


def test_a_long_outage_is_not_mistaken_for_the_future():
    buffer = fed(1)
    hour_frames = 30 * 3600
    assert buffer.push(packet(hour_frames), hour_frames * FRAME_NS)
    assert buffer.counts["lost"] == hour_frames - 2


def test_memory_of_epochs_is_bounded():
    buffer = SkeletonBuffer()
    for epoch in range(10 * RETIRED_EPOCHS):
        buffer.push(packet(1, epoch=epoch), epoch)
    assert len(buffer._retired) == RETIRED_EPOCHS
