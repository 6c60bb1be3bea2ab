"""How many layers of skeletons one receiver takes: as many as its own path carries.

A skeleton costs 70 to 87 kbit/s at 30 per second with all headers. On a thinner path they would wait in queues, every
one older than the one before; fewer of them are fresh. A layer is dropped when its path is full although bulk has given
way, and joined again after a time without queue or losses: on trial, and the later the more often it was in vain
(McCanne, Jacobson & Vetterli 1996 §3). What a receiver takes is its own affair: the sender decides nothing, and nobody
else has less for it.
Pure: time is an argument.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from common.transport.bulk_arrivals import LeastDelay
from common.transport.bulk_window import FLOOR_BPS
from common.transport.path_delay import LeastOfLate
from common.transport.temporal_layers import LAYERS, divisor_of

NS = 1e-9
SPAN_NS = 2_000_000_000  # over which skeletons that came and those that did not are compared
LEAST_SENT = 6  # in that span, to judge by
FULL_S, TOO_FULL_S = 0.05, 0.3  # queueing delay with losses, and without
DRAINING = 2.0
CARRIED, WELL_CARRIED = 0.85, 0.93  # of the skeletons; a path may lose a few by chance
GIVEN_WAY_BPS = 1.5 * FLOOR_BPS  # bulk that takes less has no more to give way with
BAD_NS = 1_000_000_000  # so long it must be bad
SILENCE_NS = 1_500_000_000  # without any skeleton
SETTLE_NS = 2_000_000_000  # so long a change takes to show, once what waits in the queue has passed
TRIAL_NS = 5_000_000_000  # so long a path that carries nearly enough takes to show it
PATIENCE_NS, PATIENCE_MAX_NS = 4_000_000_000, 160_000_000_000  # so long all must be well before more are tried
OVERFULL_NS = 3_000_000_000  # with the least layers: more comes than is taken


@dataclass(frozen=True, slots=True)
class _Heard:
    """At a time, what has come so far: skeletons, those that should have, bytes of bulk; and the queueing delay."""

    now_ns: int
    skeletons: int
    lost: int
    bulk_bytes: int
    queueing_s: float


class LayerSubscription:
    """One receiver's, of one stream. ``layers``: how many to take, the lowest first."""

    def __init__(self) -> None:
        self.layers = LAYERS
        self._patience_ns = PATIENCE_NS
        self._overfull_ns = OVERFULL_NS
        self._joined = False  # the last change was one to more
        self._settled_ns = 0
        self._on_trial = False  # the layer that was joined last
        self._begin(None)

    def _begin(self, epoch: int | None) -> None:
        """Another run of the sender: another clock, perhaps another host."""
        self._epoch = epoch
        self._skeletons = self._bulk_bytes = 0
        self._delay, self._least_delay = LeastDelay(), LeastOfLate()
        self._forget()

    def _forget(self) -> None:
        self._last = 0, 0.0  # when skeletons came, how long they had queued [s]
        self._heard: deque[_Heard] = deque()
        self._bad_ns: int | None = None
        self._good_ns: int | None = None

    @property
    def divisor(self) -> int:
        """Every so manieth skeleton comes."""
        return divisor_of(self.layers)

    @property
    def carried_divisor(self) -> int:
        """The same without a layer that is still on trial: bulk had better wait until it has passed."""
        return divisor_of(self.layers - self._on_trial)

    def is_overfull(self, now_ns: int) -> bool:
        """Whether the path has been full for long although but the least is taken. Few paths carry less than that: the
        sender may not have heard what is not taken any more, and send it still."""
        if self.layers > 1 or self._bad_ns is None or now_ns - self._last[0] > SILENCE_NS:
            return False
        return now_ns - max(self._bad_ns, self._settled_ns) >= self._overfull_ns

    def said_anew(self, now_ns: int, overfull: bool) -> None:
        """What is taken was told to the sender once more. If that was since the path was ``overfull``, the next time is
        later: it may not help."""
        self._overfull_ns = min(2 * self._overfull_ns, PATIENCE_MAX_NS) if overfull else OVERFULL_NS
        self._settled_ns = now_ns + SETTLE_NS
        self._forget()

    def skeleton(self, epoch: int, send_ns: int, arrival_ns: int) -> None:
        """The newest skeleton so far arrived; times by the sender's clock and by the receiver's."""
        if epoch != self._epoch:
            self._begin(epoch)
        self._skeletons += 1
        self._delay.note(send_ns, arrival_ns)
        self._least_delay.add(arrival_ns - send_ns, arrival_ns)

    def bulk(self, size: int) -> None:
        """So many bytes of bulk arrived."""
        self._bulk_bytes += size

    def judge(self, lost: int, now_ns: int) -> bool:
        """Every report period: whether ``layers`` has changed. ``lost``: skeletons of the layers taken that did not
        come, since ever."""
        queueing_s = self._queueing_s(now_ns)
        if queueing_s is None:
            return False
        self._heard.append(_Heard(now_ns, self._skeletons, lost, self._bulk_bytes, queueing_s))
        while now_ns - self._heard[0].now_ns > SPAN_NS:
            self._heard.popleft()
        self._weigh(self._heard[0], self._heard[-1])
        return self._decide(now_ns)

    def _queueing_s(self, now_ns: int) -> float | None:
        """Of the skeletons since the last judgement; None: none came, and there is no telling."""
        delay_ns, base_ns = self._delay.take(), self._least_delay.least
        if delay_ns is not None and base_ns is not None:
            self._last = now_ns, (delay_ns - base_ns) * NS
            return self._last[1]
        came_ns, queueing_s = self._last
        # After a queue the next ones wait, so long at least; after none the path is down.
        if now_ns - came_ns < SILENCE_NS or queueing_s < FULL_S:
            return None
        return queueing_s + (now_ns - came_ns) * NS

    def _weigh(self, first: _Heard, now: _Heard) -> None:
        """Since when the path is full, or well used."""
        came, lost = now.skeletons - first.skeletons, now.lost - first.lost
        silent = now.now_ns - self._last[0] >= SILENCE_NS
        if came + lost < LEAST_SENT and not silent:
            return
        carried = came / (came + lost) if came else 0.0
        passed_s = (now.now_ns - first.now_ns) * NS
        given_way = (now.bulk_bytes - first.bulk_bytes) * 8 <= GIVEN_WAY_BPS * passed_s
        late = [heard.queueing_s for heard in self._heard if now.now_ns - heard.now_ns <= SPAN_NS / 2]
        least_s = min(late)  # behind a chunk one skeleton may wait: that is no queue
        fallen_s = max(heard.queueing_s for heard in self._heard) - now.queueing_s
        draining = now.queueing_s < DRAINING * fallen_s  # it will be empty within two spans more
        full = least_s > TOO_FULL_S and not draining
        longer = self._on_trial and now.now_ns - first.now_ns > BAD_NS and least_s > FULL_S  # it was empty before
        bad = given_way and (full or longer or (least_s > FULL_S and carried < CARRIED))
        good = least_s < FULL_S and carried >= WELL_CARRIED
        self._bad_ns = (self._bad_ns or now.now_ns) if bad else None
        self._good_ns = (self._good_ns or now.now_ns) if good else None

    def _decide(self, now_ns: int) -> bool:
        settled = now_ns >= self._settled_ns
        bad_for_long = self._bad_ns is not None and now_ns - self._bad_ns >= BAD_NS and settled
        failed = self._bad_ns is not None and self._on_trial
        self._on_trial = self._on_trial and not settled
        if (bad_for_long or failed) and self.layers > 1:
            if self._joined:  # in vain: next time later
                self._patience_ns = min(2 * self._patience_ns, PATIENCE_MAX_NS)
            self._change(self.layers - 1, now_ns)
            return True
        if self._good_ns is not None and now_ns - self._good_ns >= self._patience_ns and self.layers < LAYERS:
            self._change(self.layers + 1, now_ns)
            return True
        return False

    def _change(self, layers: int, now_ns: int) -> None:
        self._joined = self._on_trial = layers > self.layers
        if self._joined:
            self._overfull_ns = OVERFULL_NS
        self.layers = layers
        self._settled_ns = now_ns + (TRIAL_NS if self._on_trial else SETTLE_NS) + int(self._heard[-1].queueing_s / NS)
        self._forget()
