"""Sets by capture time from frames that are skewed, lost, doubled, late or wrong; no clock, no sleep."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sender.capture.frame_set import DepthFrame, FrameSet
from sender.capture.synchronizer import MAX_OPEN, Synchronizer

MS = 1_000_000
PERIOD = 33 * MS
TOLERANCE, PATIENCE = PERIOD // 2, 50 * MS
SHAPE = (3, 4)


def frame(camera: int, capture_ns: int, shape: tuple[int, ...] = SHAPE) -> DepthFrame:
    return DepthFrame(camera, capture_ns // PERIOD, capture_ns, np.zeros(shape, np.uint16), None)


def three_cameras() -> Synchronizer:
    return Synchronizer(3, TOLERANCE, PATIENCE, [SHAPE] * 3)


def members(frame_set: FrameSet) -> list[int | None]:
    return [None if f is None else f.capture_ns for f in frame_set.frames]


def test_a_set_is_delivered_with_its_last_frame_whatever_the_order() -> None:
    sync = three_cameras()
    assert sync.push(frame(2, 6 * MS), 10) == []
    assert sync.push(frame(0, 0), 20) == []
    (complete,) = sync.push(frame(1, 2 * MS), 30)
    assert members(complete) == [0, 2 * MS, 6 * MS]
    assert complete.capture_ns == 2 * MS  # the median
    assert (sync.counters.sets, sync.counters.complete, sync.counters.missing) == (1, 1, 0)


def test_instants_are_not_mixed_when_a_camera_is_a_whole_frame_behind() -> None:
    sync = three_cameras()
    sync.push(frame(0, 0), 0)
    sync.push(frame(1, 0), 0)
    sync.push(frame(0, PERIOD), 0)
    sync.push(frame(1, PERIOD), 0)
    (first,) = sync.push(frame(2, 0), 0)
    (second,) = sync.push(frame(2, PERIOD), 0)
    assert members(first) == [0, 0, 0]
    assert members(second) == [PERIOD] * 3


def test_a_lost_frame_is_known_as_soon_as_its_camera_shows_a_later_one() -> None:
    sync = three_cameras()
    sync.push(frame(0, 0), 0)
    sync.push(frame(1, 0), 0)
    assert sync.push(frame(0, PERIOD), 1 * MS) == []
    (incomplete,) = sync.push(frame(2, PERIOD), 2 * MS)  # long before the patience runs out
    assert members(incomplete) == [0, 0, None]
    assert sync.counters.missing == 1
    (complete,) = sync.push(frame(1, PERIOD), 3 * MS)
    assert members(complete) == [PERIOD] * 3


def test_a_camera_that_stopped_is_waited_for_no_longer_than_the_patience() -> None:
    sync = three_cameras()
    sync.push(frame(0, 0), 5 * MS)
    sync.push(frame(1, 0), 6 * MS)
    assert sync.waiting_since_ns == 5 * MS
    assert sync.expire(5 * MS + PATIENCE - 1) == []
    (incomplete,) = sync.expire(5 * MS + PATIENCE)
    assert members(incomplete) == [0, 0, None]
    assert sync.waiting_since_ns is None
    assert sync.expire(10 * PATIENCE) == []


def test_a_frame_of_a_delivered_instant_is_late_and_not_delivered() -> None:
    sync = three_cameras()
    sync.push(frame(0, 0), 0)
    sync.expire(PATIENCE)
    assert sync.push(frame(1, 1 * MS), PATIENCE + 1) == []
    assert sync.counters.late == 1
    assert sync.waiting_since_ns is None


def test_doubled_frames_count_once() -> None:
    sync = three_cameras()
    for camera in (0, 0, 1):
        sync.push(frame(camera, 0), 0)
    (complete,) = sync.push(frame(2, 0), 0)
    assert members(complete) == [0, 0, 0]
    sync.push(frame(2, 0), 1)  # after delivery
    assert sync.counters.duplicate == 2
    assert sync.counters.late == 0


def test_frames_of_a_camera_may_change_places_while_their_sets_wait() -> None:
    sync = three_cameras()
    sync.push(frame(0, 0), 0)
    sync.push(frame(0, PERIOD), 0)
    sync.push(frame(1, PERIOD), 0)
    sync.push(frame(1, 0), 0)
    (first,) = sync.push(frame(2, 0), 0)
    (second,) = sync.push(frame(2, PERIOD), 0)
    assert members(first) == [0, 0, 0]
    assert members(second) == [PERIOD] * 3


@pytest.mark.parametrize(
    "wrong",
    [
        frame(0, 0, (3, 5)),
        frame(3, 0),
        frame(-1, 0),
        frame(0, 0, (3, 4, 1)),
        DepthFrame(0, 0, 0, np.zeros(SHAPE, np.float32), None),  # type: ignore[arg-type]
        DepthFrame(0, 0, 0, np.zeros(SHAPE, np.uint16), np.zeros((6, 4, 3), np.uint8)),
    ],
)
def test_wrong_frames_are_rejected_and_counted(wrong: DepthFrame) -> None:
    sync = three_cameras()
    assert sync.push(wrong, 0) == []
    assert sync.counters.rejected == 1
    assert sync.waiting_since_ns is None


def test_one_camera_passes_straight_through() -> None:
    sync = Synchronizer(1, TOLERANCE, PATIENCE)
    for capture_ns in (0, 5 * MS, PERIOD):  # also closer together than the tolerance
        (single,) = sync.push(frame(0, capture_ns), 0)
        assert single.capture_ns == capture_ns
    assert sync.counters.complete == 3


def test_a_source_whose_clock_starts_anew_is_followed() -> None:
    sync = three_cameras()
    for camera in range(3):
        sync.push(frame(camera, 100_000 * MS), 0)
    sync.push(frame(0, 0), 1)
    sync.push(frame(1, 0), 1)
    (again,) = sync.push(frame(2, 0), 1)
    assert members(again) == [0, 0, 0]
    assert sync.counters.restarts == 1


def test_open_sets_are_bounded_without_any_time_passing() -> None:
    sync = Synchronizer(2, TOLERANCE, PATIENCE)
    delivered = [s for k in range(30) for s in sync.push(frame(0, k * PERIOD), 0)]
    assert len(delivered) == 30 - MAX_OPEN
    assert sync.counters.missing == len(delivered)


Event = tuple[int, int, int, int]  # instant, camera, skew [ms], delay [ms]


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 12), st.integers(0, 2), st.integers(-4, 4), st.integers(0, 120)),
        max_size=60,
    )
)
def test_every_frame_is_delivered_once_or_counted(events: list[Event]) -> None:
    sync = three_cameras()
    arrivals = sorted((i * PERIOD + delay * MS, i * PERIOD + skew * MS, camera) for i, camera, skew, delay in events)
    delivered = [s for now, capture, camera in arrivals for s in sync.push(frame(camera, capture), now)]
    delivered += sync.expire(10**12)
    counters = sync.counters
    frames = [(f.camera_index, f.capture_ns) for s in delivered for f in s.frames if f is not None]
    assert len(frames) == len(set(frames))
    assert len(frames) + counters.late + counters.duplicate + counters.rejected == len(events)
    assert counters.missing == 3 * len(delivered) - len(frames)
    times = [s.capture_ns for s in delivered]
    assert times == sorted(times)
    for s in delivered:
        present = [f.capture_ns for f in s.frames if f is not None]
        assert present
        assert max(present) - min(present) <= 8 * MS
