"""What goes to one receiver next when its link is free, candidate poses or residual maps. Pure; one for each receiver.

The live sender asks with what its window allows, the encoder of a session with the rate it was given.

The rule: of the bytes both have a use for, residual maps get ``share``, or ``LIVE_SHARE`` where they only bring a mesh
alive, and then none on a link of under ``LIVE_LEAST_BYTES_S``; what one has no use for is the other's. It is
kept as a debt in bytes, half a second's at most, so that neither makes up for a long silence at the other's expense.
Maps go between a pose's chunks, since a pose is worth the same a second later and a map is not: of maps only the newest
waits, and it drives out what is left of the one before. A difference whose key has not gone out is worth nothing and
gives way to the key. Why shares and not priorities: poses first would starve the maps while the person does what they
never did before, which is just when maps show it; maps first would take whatever there is, as more is always better.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass

from sender.candidate_poses.mesh_scheduler import MeshScheduler, SendRecord
from sender.residual_path import Residual

LIVE_SHARE = 0.1  # more of it costs the poses more than it gives (docs/compression.md)
LIVE_LEAST_BYTES_S = 50_000.0  # 0.4 Mbit/s
LIVE_BEGIN = 1.25  # × that, for those who have none
DEBT_S = 0.5  # of the budget
RECENT_NS = 2_000_000_000  # what poses took lately counts this long


def pose_name(pose_id: int, preview: bool = False) -> tuple[str, int, bool]:
    """The name of a candidate pose on its way."""
    return "pose", pose_id, preview


def poses_in(names: Iterable[Hashable]) -> list[int]:
    """The ids of the whole candidate poses among the names."""
    return [name[1] for name in names if isinstance(name, tuple) and name == pose_name(name[1])]


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A message to send. ``supersedes``: the name of an earlier one that is worth nothing any more; ``urgent``: goes
    between the chunks of those that are not."""

    name: Hashable
    payload: bytes
    supersedes: Hashable | None = None
    urgent: bool = False


class OutgoingBulk:
    """``on_sent`` is told of every candidate pose that goes out: whoever asks sees it through. ``wants_residuals``: the
    receiver has a use for them; ``for_points``: for every frame's; ``wants_poses``: for more candidate poses.
    ``counts``: residual packets and bytes sent, packets dropped."""

    def __init__(
        self, receiver: str, scheduler: MeshScheduler, on_sent: Callable[[SendRecord], None], share: float = 0.5
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.wants_residuals = False
        self.for_points = self.wants_poses = True
        self._receiver = receiver
        self._scheduler = scheduler
        self._on_sent = on_sent
        self._share = self._share_of_points = share
        self._owed = 0.0  # bytes that residuals are behind their share
        self._pending: Residual | None = None
        self._key_sent: int | None = None  # the sequence of the last key that went out
        self._last_difference: Hashable | None = None
        self._pose_bytes_s, self._pose_ns = 0.0, 0

    def want(self, points: bool, live: bool, poses: bool, bytes_s: float) -> None:
        """What the receiver has a use for, and what its link may carry."""
        self.wants_poses = poses
        begin = 1.0 if self.wants_residuals else LIVE_BEGIN
        self.for_points = points
        self.wants_residuals = points or (live and bytes_s >= begin * LIVE_LEAST_BYTES_S)
        self._share = self._share_of_points if points else LIVE_SHARE

    @property
    def needs_key(self) -> bool:
        """No difference can be sent before another key."""
        return self.wants_residuals and self._key_sent is None and self._pending is None

    def offer(self, residual: Residual) -> None:
        """The newest residual packet; one still waiting is dropped for it, but for a key that it needs."""
        if not self.wants_residuals:
            self._pending = self._key_sent = None
            return
        waiting = self._pending
        if residual.key == residual.sequence:
            self.counts["dropped"] += waiting is not None
            self._pending = residual
        elif waiting is not None and waiting.sequence == residual.key:
            self.counts["dropped"] += 1
        elif self._key_sent == residual.key:
            self.counts["dropped"] += waiting is not None
            self._pending = residual
        else:
            self.counts["dropped"] += 1
            self._key_sent = None

    def next_message(self, budget_bytes: int, now_ns: int) -> Outgoing | None:
        """The next message, None: nothing is worth sending. ``budget_bytes``: a second's."""
        most = DEBT_S * max(budget_bytes, 1)
        self._owed = min(max(self._owed, -most), most)
        if (urgent := self.next_urgent()) is not None:
            return urgent
        return self._next_pose(budget_bytes, now_ns) or self._next_residual()

    def next_urgent(self) -> Outgoing | None:
        """The residual packet that waits, if it may go although a pose has a use for the link."""
        if self._owed < 0 or self._pending is None:
            return None
        self._owed -= len(self._pending.data)
        return self._next_residual()

    def residual_bytes_s(self, bytes_s: float, now_ns: int) -> float:
        """How much of a link's ``bytes_s`` residuals may take now: what poses leave, at least their share."""
        left = bytes_s - self._poses_lately(now_ns)
        return max(left, self._share * bytes_s)

    def _next_pose(self, budget_bytes: int, now_ns: int) -> Outgoing | None:
        chosen = self._scheduler.next_for(self._receiver, budget_bytes, now_ns) if self.wants_poses else None
        if chosen is None:
            return None
        pose_id, payload = chosen
        record = self._scheduler.sent(self._receiver, pose_id, now_ns)
        if record is None:
            return None
        self._pose_bytes_s = self._poses_lately(now_ns) + len(payload) * 1e9 / RECENT_NS
        self._pose_ns = now_ns
        if self.wants_residuals:
            self._owed += len(payload) * self._share / (1 - self._share)
        self._on_sent(record)
        return Outgoing(pose_name(pose_id, record.preview), payload)

    def _next_residual(self) -> Outgoing | None:
        residual, self._pending = self._pending, None
        if residual is None:
            return None
        name: Hashable = ("residual", residual.sequence)
        superseded, self._last_difference = self._last_difference, name
        if residual.key == residual.sequence:  # a key is seen through until there is another
            self._key_sent, self._last_difference = residual.key, None
        self.counts["sent"] += 1
        self.counts["bytes"] += len(residual.data)
        return Outgoing(name, residual.data, superseded, urgent=True)

    def _poses_lately(self, now_ns: int) -> float:
        """Bytes of poses a second, of late."""
        return self._pose_bytes_s * math.exp(-max(now_ns - self._pose_ns, 0) / RECENT_NS)
