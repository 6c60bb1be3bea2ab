"""The offset between two hosts' monotonic clocks, from exchanged times: the quickest exchange is the most exact.

Of an exchange sent at t0, received at t1, answered at t2 and back at t3 (t0, t3 by our clock, t1, t2 by the other's)
the offset is ((t1 - t0) + (t2 - t3)) / 2, wrong by at most half the round trip (t3 - t0) - (t2 - t1). RFC 5905 §8, §10.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

REMEMBERED = 32  # exchanges
DRIFT_PPM = 100  # two ordinary quartz clocks part by less


@dataclass(frozen=True, slots=True)
class _Exchange:
    at_ns: int
    offset_ns: int
    round_trip_ns: int


class ClockOffset:
    """Keeps the latest exchanges and answers from the one that is most exact now."""

    def __init__(self, remembered: int = REMEMBERED, drift_ppm: int = DRIFT_PPM) -> None:
        self._exchanges: deque[_Exchange] = deque(maxlen=remembered)
        self._drift_ppm = drift_ppm
        self._refused = 0
        self._steps = 0

    @property
    def refused(self) -> int:
        """How many exchanges had impossible times."""
        return self._refused

    @property
    def steps(self) -> int:
        """How often a clock has jumped: a host that slept, say, whose monotonic clock stood still."""
        return self._steps

    @property
    def known(self) -> bool:
        return bool(self._exchanges)

    def add(self, t0_ns: int, t1_ns: int, t2_ns: int, t3_ns: int) -> bool:
        """Add an exchange; ``t2_ns`` may equal ``t1_ns``. False, and counted, when its times are impossible."""
        held_ns = t2_ns - t1_ns
        round_trip_ns = t3_ns - t0_ns - held_ns
        if held_ns < 0 or round_trip_ns < 0:
            self._refused += 1
            return False
        new = _Exchange(t3_ns, (t1_ns - t0_ns + t2_ns - t3_ns) // 2, round_trip_ns)
        if any(self._contradict(old, new) for old in self._exchanges):
            self._exchanges.clear()
            self._steps += 1
        self._exchanges.append(new)
        return True

    def forget(self) -> None:
        """Start anew: the other end has restarted, perhaps on another host."""
        self._exchanges.clear()

    def offset_ns(self, now_ns: int) -> int:
        """What to add to our time to get the other's.

        Raises:
            LookupError: no exchange yet.
        """
        return self._best(now_ns).offset_ns

    def error_ns(self, now_ns: int) -> int:
        """How wrong ``offset_ns`` can be: half the round trip, and the drift since.

        Raises:
            LookupError: no exchange yet.
        """
        return self._error_ns(self._best(now_ns), now_ns)

    def to_local_ns(self, remote_ns: int, now_ns: int) -> int:
        """The other host's time ``remote_ns`` by our clock.

        Raises:
            LookupError: no exchange yet.
        """
        return remote_ns - self.offset_ns(now_ns)

    def _best(self, now_ns: int) -> _Exchange:
        if not self._exchanges:
            raise LookupError("no exchange of times yet")
        return min(self._exchanges, key=lambda exchange: self._error_ns(exchange, now_ns))

    def _contradict(self, old: _Exchange, new: _Exchange) -> bool:
        """Whether clocks that run cannot give both: each is wrong by half its round trip and the drift at most."""
        return abs(old.offset_ns - new.offset_ns) > self._error_ns(old, new.at_ns) + new.round_trip_ns // 2 + 1

    def _error_ns(self, exchange: _Exchange, now_ns: int) -> int:
        return exchange.round_trip_ns // 2 + max(0, now_ns - exchange.at_ns) * self._drift_ppm // 1_000_000
