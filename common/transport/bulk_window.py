"""How much bulk may be on its way to one receiver, so that it never delays a skeleton noticeably.

A window of the LEDBAT family (RFC 6817; SCReAM, RFC 8298): it grows while the queueing delay that skeletons see stays
below a target and shrinks above. The delay comes from the receiver's reports, so clocks need no common zero. It stops
by itself when reports stop, and no report can make it exceed its bounds. Pure: time is an argument.
"""

from __future__ import annotations

import statistics
from collections import Counter, deque
from dataclasses import dataclass

from common.transport.chunks import CHUNK_MAX_BYTES
from common.transport.path_delay import PathDelay
from common.wire.receiver_report import ReceiverReport

NS = 1e-9
FIRST_WINDOW_BYTES = 16 << 10
FLOOR_BPS = 100_000
QUEUE_MAX_S = 0.25  # so deep a queue the floor is kept beside
CHUNK_LEAST_BYTES = 1200
CHUNK_HOLDS_S = 0.005  # how long one chunk may hold up a skeleton behind it on the link
PACING = 1.1  # of the window per round trip: a little more than it allows, so that pacing is not the limit
BURST_NS = 10_000_000  # how far pacing may lag behind and catch up
GAIN = 1.5
CHUNK_TARGET_S = 0.012
TRICKLE_NS = 1_000_000_000  # between two chunks
SLOW_START_GAIN = 0.5
LOSS_SHARE = 0.1  # of chunks lost beyond which a queue is taken to be full (GCC, draft-ietf-rmcat-gcc-02 §6)


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """``target_ms``: queueing delay to stay at [ms]. ``floor_bps``: what bulk may use whatever the delay [bit/s].
    ``max_window_bytes``: most bytes in flight. ``report_period_ms``: how often the receiver reports [ms]."""

    target_ms: float = 7.0
    floor_bps: int = FLOOR_BPS
    max_window_bytes: int = 4 << 20
    report_period_ms: float = 50.0

    def __post_init__(self) -> None:
        if not 1.0 <= self.target_ms <= 200.0:
            raise ValueError(f"target_ms: {self.target_ms} is outside 1..200")
        if not 8_000 <= self.floor_bps <= 1_000_000_000:
            raise ValueError(f"floor_bps: {self.floor_bps} is outside 8000..1e9")
        if not 2 * CHUNK_MAX_BYTES <= self.max_window_bytes <= 32 << 20:
            raise ValueError(f"max_window_bytes: {self.max_window_bytes} is outside 64 KiB..32 MiB")
        if not 5.0 <= self.report_period_ms <= 1000.0:
            raise ValueError(f"report_period_ms: {self.report_period_ms} is outside 5..1000")


@dataclass(frozen=True, slots=True)
class Outcome:
    """Sequence numbers of chunks that are no longer in flight: arrived, or lost and to be sent again.

    ``restarted``: the receiver is a new one and has nothing of what was acknowledged before.
    """

    arrived: tuple[int, ...] = ()
    lost: tuple[int, ...] = ()
    restarted: bool = False


class BulkWindow:
    """The window towards one receiver, for chunks of the sender's run ``epoch``.

    ``counts``: by cause, reports that were not used and chunks that were lost. ``trickle``, to be set: the path can
    hardly carry what else is sent, so that only a small chunk goes now and then, one at a time.
    """

    def __init__(self, epoch: int, settings: WindowSettings | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self.trickle = False
        self._epoch = epoch
        self._settings = settings or WindowSettings()
        self._target_s = self._settings.target_ms * 1e-3  # τ
        self._period_s = self._settings.report_period_ms * 1e-3  # T
        self._in_flight: dict[int, tuple[int, int]] = {}  # sequence number → bytes, when sent; ascending
        self._in_flight_bytes = 0
        self._next_sequence = 0
        self._next_send_ns = 0
        self._last_sent_ns = 0
        self._progress_ns = 0
        self._last: tuple[ReceiverReport, int] | None = None  # and when it came
        self._path = PathDelay()
        self._rates: deque[float] = deque(maxlen=40)  # R_i [bytes/s]
        self._rate_from_ns = 0  # receiver's clock: since when the next chunks to be acknowledged have been on their way
        self._suspects: set[int] = set()  # missing in the last report: late, or lost
        self._begin_slow_start(FIRST_WINDOW_BYTES)

    @property
    def window_bytes(self) -> int:
        """W: how many bytes may be in flight."""
        return int(self._window)

    @property
    def in_flight_bytes(self) -> int:
        return self._in_flight_bytes

    @property
    def oldest_sequence(self) -> int:
        """The lowest sequence number in flight, or the next one to be used."""
        return next(iter(self._in_flight), self._next_sequence)

    @property
    def next_sequence(self) -> int:
        """The sequence number the next chunk has to carry."""
        return self._next_sequence

    @property
    def queueing_delay_s(self) -> float:
        """q: how long packets wait in queues on the way, at the last report."""
        return self._path.queueing_s

    @property
    def rate_bytes_s(self) -> float:
        """R̂: what the path delivers [bytes/s]; before the first sample 16 KB per round trip."""
        if not self._rates:
            return FIRST_WINDOW_BYTES / (self._path.round_trip_s + self._period_s)
        return statistics.median(self._rates)

    @property
    def allowed_bytes_s(self) -> float:
        """What the window lets through [bytes/s]; more than ``rate_bytes_s`` while it seeks how much the path takes.

        For streams that adapt to it: were they to follow what they sent themselves, they would never send more."""
        return self._window / (self._path.round_trip_s + self._period_s)

    @property
    def chunk_bytes(self) -> int:
        """C: how large a chunk should be now."""
        if self.trickle:
            return CHUNK_LEAST_BYTES
        return int(min(max(self.rate_bytes_s * CHUNK_HOLDS_S, CHUNK_LEAST_BYTES), CHUNK_MAX_BYTES))

    def budget_bytes(self, period_ns: int) -> int:
        """How many more bytes the path takes within ``period_ns``."""
        rate_bytes_s = max(self.rate_bytes_s, self._settings.floor_bps / 8)  # however slow it seems, that much may go
        return max(0, int(0.9 * rate_bytes_s * period_ns * NS) - self._in_flight_bytes)

    def time_to_deliver_s(self, size: int) -> float:
        """Roughly how long ``size`` bytes take to arrive."""
        return (self._in_flight_bytes + size) / self.rate_bytes_s + self._path.round_trip_s / 2

    def next_send_ns(self, size: int, now_ns: int) -> int | None:
        """When a chunk of ``size`` bytes may go, perhaps in the past; None: not before another report."""
        if self._silent(now_ns):
            return None
        if self.trickle:
            waits = self._in_flight or self._path.queueing_s > 3 * self._target_s
            return None if waits else self._last_sent_ns + TRICKLE_NS
        if self._in_flight and self._in_flight_bytes + size > self._window:
            return self._probe_ns if self._probe_ns <= now_ns else None
        return self._next_send_ns

    @property
    def _probe_ns(self) -> int:
        """When a full window lets one more chunk out: if the last ones were lost, only a later one shows it (RFC 8985
        §7)."""
        waited_ns = int(2 * (self._path.round_trip_s + self._period_s) / NS)
        return max(self._progress_ns, self._last_sent_ns) + waited_ns

    def on_sent(self, size: int, now_ns: int) -> int:
        """A chunk of ``size`` bytes goes out now; returns its sequence number."""
        if not self._in_flight:
            self._progress_ns = now_ns
        sequence = self._next_sequence
        self._next_sequence += 1
        self._in_flight[sequence] = (size, now_ns)
        self._in_flight_bytes += size
        self._last_sent_ns = now_ns
        pace_bytes_s = PACING * self._window / (self._path.round_trip_s + self._period_s)
        self._next_send_ns = max(self._next_send_ns, now_ns - BURST_NS) + int(size / pace_bytes_s / NS)
        return sequence

    def on_report(self, report: ReceiverReport, now_ns: int) -> Outcome:
        """Take a report in: which chunks are no longer in flight, and a new window."""
        if not self._usable(report, now_ns):
            return Outcome()
        was_silent = self._silent(now_ns)
        before, self._last = self._last, (report, now_ns)
        if before is not None and before[0].receiver_epoch != report.receiver_epoch:
            self._rate_from_ns = report.clock_ns
            return self._on_restart()
        if report.sender_epoch != self._epoch:
            self._rate_from_ns = report.clock_ns
            return Outcome()  # it has not heard of this run yet; but it is there
        outstanding = self._in_flight_bytes
        outcome, acked, acked_ns = self._resolve(report)
        self._path.update(report, self.chunk_bytes / self.rate_bytes_s, acked_ns, now_ns)
        if outcome.arrived:
            self._progress_ns = now_ns
        if self.trickle:
            self._begin_slow_start(0)  # and from the least window once it is over
            self._clamp()
        elif was_silent:
            self._begin_anew()
        else:
            # Otherwise the sample says nothing about the path.
            limited = outstanding > min(self._window / 2, self._window - self.chunk_bytes)
            if acked and limited and before is not None:
                period_s = max((report.clock_ns - self._rate_from_ns) * NS, self._period_s / 4)
                self._rates.append(acked / period_s)
            self._adapt(acked if limited else 0, now_ns)
        if acked or not outstanding:
            # TCP that waits for a lost packet delivers nothing and then all at once: the wait is part of the rate.
            self._rate_from_ns = report.clock_ns
        self._heed_losses(acked, outstanding - self._in_flight_bytes - acked, now_ns)
        return outcome

    def expire(self, now_ns: int) -> Outcome:
        """Write off everything in flight when nothing was acknowledged for long, or it would count for ever."""
        if not self._in_flight or (now_ns - self._progress_ns) * NS <= max(1.0, 4 * self._path.round_trip_s):
            return Outcome()
        self.counts["written off"] += len(self._in_flight)
        self._begin_anew()
        return Outcome(lost=self._write_off())

    def _usable(self, report: ReceiverReport, now_ns: int) -> bool:
        if self._last is None:
            return True
        last, last_ns = self._last
        if report.receiver_epoch == last.receiver_epoch and report.number <= last.number:
            self.counts["old report"] += 1
            return False
        if (now_ns - last_ns) * NS < self._period_s / 4:
            self.counts["report too soon"] += 1  # nothing is lost with it: reports are cumulative
            return False
        return True

    def _silent(self, now_ns: int) -> bool:
        limit_s = max(0.4, 4 * self._period_s + 2 * self._path.least_round_trip_s)
        return self._last is None or (now_ns - self._last[1]) * NS > limit_s

    def _on_restart(self) -> Outcome:
        self._path = PathDelay()
        self._begin_slow_start(FIRST_WINDOW_BYTES)
        return Outcome(lost=self._write_off(), restarted=True)

    def _write_off(self) -> tuple[int, ...]:
        lost = tuple(self._in_flight)
        self._in_flight.clear()
        self._suspects.clear()
        self._in_flight_bytes = 0
        return lost

    def _resolve(self, report: ReceiverReport) -> tuple[Outcome, int, int | None]:
        """Chunks below "next expected" have arrived, but for the missing ones, which are lost when a second report in
        a row says so: before that they may just have been overtaken. With it how many bytes arrived, and when the
        newest of them was sent."""
        if report.next_chunk > self._next_sequence:
            self.counts["future chunk"] += 1
        missing = set(report.missing_chunks) & self._in_flight.keys()
        lost = tuple(sorted(missing & self._suspects))
        self._suspects = missing.difference(lost)
        arrived = tuple(
            sequence for sequence in self._in_flight if sequence < report.next_chunk and sequence not in missing
        )
        acked_ns = self._in_flight[arrived[-1]][1] if arrived else None
        lost_bytes, acked = (sum(self._in_flight.pop(chunk)[0] for chunk in chunks) for chunks in (lost, arrived))
        self._in_flight_bytes -= lost_bytes + acked
        self.counts["lost"] += len(lost)
        return Outcome(arrived, lost), acked, acked_ns

    def _begin_slow_start(self, window_bytes: float) -> None:
        self._slow_start = True
        self._window = float(window_bytes)
        self._rates.clear()
        self._short_queue_since_ns: int | None = None
        self._loss_share = 0.0
        self._reduced_ns = 0

    def _begin_anew(self) -> None:
        """After silence: nothing is known of the path but that it was once as fast as it was."""
        window = self.rate_bytes_s * (self._path.least_round_trip_s + self._period_s) / 2
        self._begin_slow_start(min(window, FIRST_WINDOW_BYTES))
        self._clamp()

    def _adapt(self, acked: int, now_ns: int) -> None:
        """The new window after ``acked`` bytes arrived while it was the window that limited them."""
        q = self._path.queueing_s
        chunk_s = self.chunk_bytes / self.rate_bytes_s
        target = max(self._target_s, min(chunk_s, CHUNK_TARGET_S))  # on a slow link one chunk alone takes so long
        round_trip_s = self._path.least_round_trip_s + self._period_s
        heeded = now_ns < self._reduced_ns + int(round_trip_s / NS)  # the queue that the last cut will drain
        if self._slow_start:
            if q > target / 2 and self._rates:
                self._slow_start = False
                self._reduced_ns = now_ns
                self._window = max(list(self._rates)[-4:]) * (round_trip_s + target)
            else:
                self._window += acked * SLOW_START_GAIN
        elif acked and not (heeded and q > target):
            gain = GAIN * max(1.0, round_trip_s / 0.1)
            step = gain * (target - q) / target * acked * self.chunk_bytes / self._window
            self._window += max(-acked / 4, step)
        if q < target / 2 and self._rates:
            # Where the path delivered more a moment ago, the queue was a hiccup: TCP's own, say (BBR's every 10 s).
            self._window = max(self._window, 0.9 * max(list(self._rates)[-8:]) * round_trip_s)
        if q > 3 * target and not heeded and not (self._slow_start and self._rates):
            self._reduced_ns = now_ns
            self._slow_start = False
            delivered = 0.85 * self._rates[-1] * round_trip_s if self._rates else self._window / 2
            self._window = min(self._window, delivered)
        self._clamp()
        self._seek_room(acked, now_ns)

    def _seek_room(self, acked: int, now_ns: int) -> None:
        """Into slow start again when the queue stays short although the window is used: the path has room."""
        if self._slow_start or self._path.queueing_s > self._target_s / 2:
            self._short_queue_since_ns = None
        elif self._short_queue_since_ns is None:
            self._short_queue_since_ns = now_ns if acked else None
        elif (now_ns - self._short_queue_since_ns) * NS > max(0.5, 2 * (self._path.round_trip_s + self._period_s)):
            self._short_queue_since_ns = None
            self._slow_start = acked > 0

    def _heed_losses(self, acked: int, lost: int, now_ns: int) -> None:
        """Give way when many chunks are lost: a queue somewhere is full, though short. Once per round trip. A few that
        are lost by chance are no such sign."""
        if acked + lost:
            weight = min(1.0, (acked + lost) / self._window)
            self._loss_share += (lost / (acked + lost) - self._loss_share) * weight
        if (
            self._loss_share > LOSS_SHARE
            and (now_ns - self._reduced_ns) * NS > self._path.round_trip_s + self._period_s
        ):
            self._reduced_ns = now_ns
            self._slow_start = False
            self._window *= 1 - self._loss_share / 2
            self._clamp()

    def _clamp(self) -> None:
        self._window = min(max(self._window, self._least_window), self._settings.max_window_bytes)

    @property
    def _least_window(self) -> float:
        # Beside a deep queue of others the floor is kept, but not by filling one that grows without end.
        round_trip_s = min(self._path.round_trip_s, self._path.least_round_trip_s + QUEUE_MAX_S)
        floor = self._settings.floor_bps / 8 * (round_trip_s + self._period_s)
        return max(floor, self.chunk_bytes)
