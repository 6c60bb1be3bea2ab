"""Skeletons that waited for long are not fresh, whatever the clocks say."""

from __future__ import annotations

from receiver.freshness import STALE_NS, Freshness

SKEW_NS = -(10**15)
FRAME_NS = 33_000_000


def test_what_waited_for_long_is_stale_and_what_comes_after_is_fresh() -> None:
    freshness = Freshness()
    for frame in range(30):
        assert freshness.is_fresh(1, frame * FRAME_NS, frame * FRAME_NS + SKEW_NS)
    late_ns = 30 * FRAME_NS + STALE_NS + 1
    assert not freshness.is_fresh(1, 30 * FRAME_NS, late_ns + SKEW_NS)  # a burst after an outage
    assert freshness.is_fresh(1, 31 * FRAME_NS, late_ns + SKEW_NS)
    assert freshness.stale == 1


def test_a_new_run_of_the_sender_has_a_clock_of_its_own() -> None:
    freshness = Freshness()
    assert freshness.is_fresh(1, 0, 0)
    assert freshness.is_fresh(2, 0, 10**12)


def test_a_timeline_a_little_slower_than_life_stays_fresh() -> None:
    freshness = Freshness()
    assert all(freshness.is_fresh(1, int(frame * FRAME_NS * 0.97), frame * FRAME_NS) for frame in range(3000))
