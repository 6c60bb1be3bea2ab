"""Round trip and queueing delay of a path, from receiver reports: no clock in common is needed.

A one-way delay by two clocks means nothing, but how far it is above the least of the last minute does: so long packets
wait in queues (RFC 6817 §3.1). Pure: time is an argument.
"""

from __future__ import annotations

from collections import deque

from common.wire.receiver_report import ReceiverReport

NS = 1e-9
ROUND_TRIP_MAX_NS = 10_000_000_000
BUCKET_NS, BUCKETS = 5_000_000_000, 12  # a minute: two clocks part by less than 6 ms in it
BULK_SHARE = 0.5  # how much of the delay that only chunks see counts


class LeastOfLate:
    """The least value of the last ``BUCKETS`` x 5 s that had any."""

    def __init__(self) -> None:
        self._buckets: deque[tuple[int, int]] = deque(maxlen=BUCKETS)  # (which 5 s, least value in them)

    def add(self, value: int, now_ns: int) -> None:
        bucket = now_ns // BUCKET_NS
        if self._buckets and self._buckets[-1][0] == bucket:
            value = min(value, self._buckets.pop()[1])
        self._buckets.append((bucket, value))

    @property
    def least(self) -> int | None:
        return min((value for _, value in self._buckets), default=None)


class PathDelay:
    """One receiver's path. All in seconds."""

    def __init__(self) -> None:
        self.round_trip_s = 0.2  # until the first sample
        self.queueing_s = 0.0
        self._round_trips_ns = LeastOfLate()
        self._delays_ns = LeastOfLate()

    @property
    def least_round_trip_s(self) -> float:
        least_ns = self._round_trips_ns.least
        return self.round_trip_s if least_ns is None else least_ns * NS

    def update(self, report: ReceiverReport, chunk_s: float, acked_ns: int | None, now_ns: int) -> None:
        """``chunk_s``: how long the link takes for one chunk. ``acked_ns``: when the newest chunk that this report
        acknowledges was sent, or None."""
        sent_ns, hold_ns = acked_ns, 0  # without skeletons: too long by what the chunk waited for the report
        if report.skeleton_send_ns is not None:
            sent_ns, hold_ns = report.skeleton_send_ns, report.skeleton_hold_ns
        if sent_ns is not None and 0 < now_ns - sent_ns - hold_ns < ROUND_TRIP_MAX_NS:
            sample_ns = now_ns - sent_ns - hold_ns
            first = self._round_trips_ns.least is None
            self.round_trip_s += (sample_ns * NS - self.round_trip_s) * (1 if first else 1 / 8)
            self._round_trips_ns.add(sample_ns, now_ns)
        d_s, d_b = report.skeleton_delay_ns, report.bulk_delay_ns
        delays_ns = [delay_ns for delay_ns in (d_s, d_b) if delay_ns is not None]
        if not delays_ns:
            return
        self._delays_ns.add(min(delays_ns), now_ns)
        base_ns = self._delays_ns.least
        assert base_ns is not None
        # Skeletons are few: what all the chunks of the same period escaped was jitter and no queue.
        seen_s = (min(delays_ns) - base_ns) * NS if d_s is not None else 0.0
        # Chunks may queue where skeletons do not, above a second link say: without this the window would not see it.
        own_s = ((d_b - base_ns) * NS - chunk_s) * BULK_SHARE if d_b is not None else 0.0
        self.queueing_s = max(seen_s, own_s, 0.0)
