"""How many of the skeletons go out: all of them, or every 2nd, 4th or 8th where a receiver's path cannot carry more.

A skeleton costs 70 to 87 kbit/s at 30 per second with all headers. On a thinner path they would wait in queues, every
one older than the one before; fewer of them are fresh, and each packet repeats the frame before it, so that every
2nd carries the whole motion. Skeletons go to all receivers under one key: the thinnest path counts.
Pure: time is an argument.
"""

from __future__ import annotations

import bisect
from collections import deque

from common.wire.receiver_report import ReceiverReport

DIVISOR_MAX = 8
SPAN_NS = 2_000_000_000  # over which skeletons sent and received are compared
LEAST_SENT = 6  # in that span, to judge by
FULL_S, TOO_FULL_S = 0.05, 0.3  # queueing delay with losses, and without
DRAINING = 2.0
CARRIED, WELL_CARRIED = 0.85, 0.93  # of the skeletons; a path may lose a few by chance
BAD_NS, SETTLE_NS = 1_000_000_000, 2_000_000_000  # so long it must be bad, and so long a change takes to show
PATIENCE_NS, PATIENCE_MAX_NS = 10_000_000_000, 160_000_000_000  # so long all must be well before more are tried
SENT_MAX = 4096


class _Path:
    """One receiver's: whether it carries the skeletons."""

    def __init__(self, now_ns: int) -> None:
        self.divisor = 1
        # When, send time of the newest skeleton, how many came, queueing delay.
        self._heard: deque[tuple[int, int, int, float]] = deque()
        self._changed_ns = now_ns
        self._bad_ns: int | None = None
        self._good_ns: int | None = None
        self._patience_ns = PATIENCE_NS
        self._raised = False  # the last change was one to more

    def on_report(
        self, send_ns: int, received: int, queueing_s: float, yielding: bool, sent_ns: list[int], now_ns: int
    ) -> None:
        self._heard.append((now_ns, send_ns, received, queueing_s))
        while now_ns - self._heard[0][0] > SPAN_NS:
            self._heard.popleft()
        _, first_send_ns, first_received, _ = self._heard[0]
        sent = bisect.bisect_right(sent_ns, send_ns) - bisect.bisect_right(sent_ns, first_send_ns)
        if sent < LEAST_SENT:
            return
        carried = (received - first_received) / sent
        least_s = min(q for when_ns, _, _, q in self._heard if now_ns - when_ns <= SPAN_NS / 2)  # a chunk is no queue
        fallen_s = max(q for _, _, _, q in self._heard) - queueing_s
        draining = queueing_s < DRAINING * fallen_s  # it will be empty within two spans more
        full = least_s > TOO_FULL_S and not draining
        bad = yielding and (full or (least_s > FULL_S and carried < CARRIED))
        good = least_s < FULL_S and carried >= WELL_CARRIED
        self._bad_ns = (self._bad_ns or now_ns) if bad else None
        self._good_ns = (self._good_ns or now_ns) if good else None
        self._decide(now_ns)

    def _decide(self, now_ns: int) -> None:
        if self._bad_ns is not None and now_ns - self._bad_ns >= BAD_NS:
            if self.divisor < DIVISOR_MAX and now_ns - self._changed_ns >= SETTLE_NS:
                if self._raised:  # in vain: next time later
                    self._patience_ns = min(2 * self._patience_ns, PATIENCE_MAX_NS)
                self._change(2 * self.divisor, now_ns)
        elif self._good_ns is not None and now_ns - self._good_ns >= self._patience_ns and self.divisor > 1:
            self._change(self.divisor // 2, now_ns)

    def _change(self, divisor: int, now_ns: int) -> None:
        self._raised = divisor < self.divisor
        self.divisor = divisor
        self._changed_ns = now_ns
        self._bad_ns = self._good_ns = None
        self._heard.clear()


class SkeletonPace:
    """``left_out``: how many skeletons were not published."""

    def __init__(self) -> None:
        self.left_out = 0
        self._paths: dict[str, _Path] = {}
        self._sent_ns: list[int] = []
        self._frames = 0

    @property
    def divisor(self) -> int:
        """Every so manieth skeleton goes out."""
        return max((path.divisor for path in self._paths.values()), default=1)

    def divisor_of(self, receiver: str) -> int:
        """What one receiver's path alone would ask for."""
        path = self._paths.get(receiver)
        return 1 if path is None else path.divisor

    def due(self, now_ns: int) -> bool:
        """Another skeleton is there: whether it is to be published, at once."""
        self._frames += 1
        if self._frames % self.divisor:
            self.left_out += 1
            return False
        self._sent_ns.append(now_ns)
        if len(self._sent_ns) > SENT_MAX:
            del self._sent_ns[: SENT_MAX // 2]
        return True

    def on_report(self, receiver: str, report: ReceiverReport, queueing_s: float, yielding: bool, now_ns: int) -> None:
        """A receiver's report, the queueing delay on its path, and whether bulk has given way as far as it can."""
        if report.skeleton_send_ns is None:
            return
        path = self._paths.setdefault(receiver, _Path(now_ns))
        path.on_report(report.skeleton_send_ns, report.skeletons, queueing_s, yielding, self._sent_ns, now_ns)

    def forget(self, receiver: str) -> None:
        """A receiver has gone."""
        self._paths.pop(receiver, None)
