"""Which candidate pose goes to which receiver next (DISPOSE §6.1), given the bytes its window allows.

The usable pose set knows what a pose is worth (χ); here each receiver's own state is kept: what it has, what it is
being sent, when it got something last. Poses already sent stay, within a bound, for receivers that join late.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum


@dataclass(frozen=True, slots=True)
class SchedulerSettings:
    """``max_bytes, max_poses``: bound on the encoded poses held. ``period_ns``: the time a budget is for.
    ``ample_poses``: bandwidth is ample when that many poses fit in a period: then the newest pose goes first, and
    RT is its full share, ``retain_share``, of χ_s."""

    max_bytes: int = 64 << 20
    max_poses: int = 100
    max_receivers: int = 64
    period_ns: int = 1_000_000_000
    ample_poses: float = 4.0
    retain_share: float = 0.8


class Reason(StrEnum):
    """Why a pose was chosen."""

    FIRST = "the receiver has nothing"
    NEWEST = "newest, bandwidth is ample"
    RETAINED = "retained, χ > RT"
    BEST = "best χ"


@dataclass(frozen=True, slots=True)
class SendRecord:
    """One send, for the log: χ of the pose, the best χ there was (χ_s), RT, its size and the budget [bytes]."""

    receiver_id: str
    pose_id: int
    reason: Reason
    chi: float
    chi_best: float
    retain_threshold: float
    size_bytes: int
    budget_bytes: int
    chosen_ns: int
    sent_ns: int = -1


@dataclass(slots=True)
class _Held:
    pose_id: int
    encoded: bytes
    capture_ns: int
    chi: float
    retained: bool = False
    was_sent: bool = False


@dataclass(slots=True)
class _Receiver:
    epoch: int
    has: set[int] = field(default_factory=set)
    last_sent_ns: int | None = None
    pending: SendRecord | None = None


class MeshScheduler:
    """Poses of one person on their way to its receivers; pure, time is an argument."""

    def __init__(self, settings: SchedulerSettings | None = None) -> None:
        self._settings = settings or SchedulerSettings()
        self._held: dict[int, _Held] = {}
        self._newest: int | None = None
        self._receivers: dict[str, _Receiver] = {}

    @property
    def held_bytes(self) -> int:
        """Memory of the encoded poses."""
        return sum(len(pose.encoded) for pose in self._held.values())

    def offer(self, pose_id: int, encoded: bytes, capture_ns: int, chi: float) -> None:
        """A newly captured pose. Offer also those the usable pose set rejected (χ = 0): with ample bandwidth the
        newest look of the person is worth sending whatever it can animate."""
        superseded = self._held.get(self._newest) if self._newest is not None else None
        self._held[pose_id] = _Held(pose_id, encoded, capture_ns, chi)
        self._newest = pose_id
        if superseded and superseded.chi <= 0 and not superseded.was_sent:
            self._forget(superseded.pose_id)
        while self.held_bytes > self._settings.max_bytes or len(self._held) > self._settings.max_poses:
            others = [pose for pose in self._held.values() if pose.pose_id != pose_id]
            if not others:
                break
            self._forget(min(others, key=lambda pose: (pose.chi, pose.capture_ns)).pose_id)

    def update(self, quotients: Mapping[int, float], retained: Collection[int] = ()) -> None:
        """The usable pose set's χ now, and its retained poses. What has left the set is forgotten, unless it is the
        newest or was sent to someone: then it keeps its last χ."""
        for pose in list(self._held.values()):
            pose.retained = pose.pose_id in retained
            if pose.pose_id in quotients:
                pose.chi = quotients[pose.pose_id]
            elif not pose.was_sent and pose.pose_id != self._newest:
                self._forget(pose.pose_id)

    def receiver_joined(self, receiver_id: str, epoch: int, holding: Collection[int] = ()) -> bool:
        """A receiver is there, with the poses ``holding``; a new ``epoch`` means it restarted with nothing else.
        False: there are too many receivers."""
        known = self._receivers.get(receiver_id)
        if known is None and len(self._receivers) >= self._settings.max_receivers:
            return False
        if known is None or known.epoch != epoch:
            known = self._receivers[receiver_id] = _Receiver(epoch)
        known.has.update(self._held.keys() & set(holding))
        return True

    def receiver_left(self, receiver_id: str) -> None:
        """Forget a receiver; unknown ones are ignored."""
        self._receivers.pop(receiver_id, None)

    def next_for(self, receiver_id: str, budget_bytes: int, now_ns: int) -> tuple[int, bytes] | None:
        """The pose to send now, or None: nothing it lacks, or nothing that fits.

        ``budget_bytes``: what its window can carry in a period. A pose fits if it is smaller, or would have fitted
        into the time since the last one was sent. To a receiver without a pose, one is sent at once. Asking again
        before ``sent`` abandons the pose given last.
        """
        receiver = self._receivers.get(receiver_id)
        if receiver is None:
            return None
        receiver.pending = None
        lacking = [pose for pose in self._held.values() if pose.pose_id not in receiver.has]
        if not lacking:
            return None
        chi_best = max(pose.chi for pose in lacking)
        rich = min(max(budget_bytes, 0) / self._ample_bytes(), 1.0)
        retain_threshold = self._settings.retain_share * rich * chi_best
        if not receiver.has:
            pose, reason = max(lacking, key=lambda pose: pose.capture_ns), Reason.FIRST
        else:
            allowed = self._allowance(receiver, budget_bytes, now_ns)
            fitting = [pose for pose in lacking if len(pose.encoded) <= allowed]
            if not fitting:
                return None
            pose, reason = self._choose(fitting, rich >= 1, retain_threshold)
        receiver.pending = SendRecord(
            receiver_id, pose.pose_id, reason, pose.chi, chi_best, retain_threshold,
            len(pose.encoded), budget_bytes, now_ns,
        )  # fmt: skip
        return pose.pose_id, pose.encoded

    def sent(self, receiver_id: str, pose_id: int, now_ns: int) -> SendRecord | None:
        """The last byte of the pose given by ``next_for`` is out; None when that pose is no longer pending."""
        receiver = self._receivers.get(receiver_id)
        if receiver is None or receiver.pending is None or receiver.pending.pose_id != pose_id:
            return None
        record, receiver.pending = replace(receiver.pending, sent_ns=now_ns), None
        receiver.last_sent_ns = now_ns
        if pose_id in self._held:
            self._held[pose_id].was_sent = True
            receiver.has.add(pose_id)
        return record

    def _choose(self, fitting: list[_Held], ample: bool, retain_threshold: float) -> tuple[_Held, Reason]:
        best = max(fitting, key=lambda pose: (pose.chi, pose.capture_ns))
        newest = max(fitting, key=lambda pose: pose.capture_ns)
        if ample and newest.pose_id == self._newest:
            return newest, Reason.NEWEST
        retained = [pose for pose in fitting if pose.retained and pose.chi > retain_threshold]
        if retained:
            return max(retained, key=lambda pose: (pose.chi, pose.capture_ns)), Reason.RETAINED
        return best, Reason.BEST

    def _ample_bytes(self) -> float:
        newest = self._held.get(self._newest) if self._newest is not None else None
        return self._settings.ample_poses * max(len(newest.encoded) if newest else 0, 1)

    def _allowance(self, receiver: _Receiver, budget_bytes: int, now_ns: int) -> float:
        """Bytes that may go out now: a period's budget, or more after a longer wait, so that no pose is too large."""
        waited_ns = 0 if receiver.last_sent_ns is None else now_ns - receiver.last_sent_ns
        return budget_bytes * max(1.0, waited_ns / self._settings.period_ns)

    def _forget(self, pose_id: int) -> None:
        del self._held[pose_id]
        for receiver in self._receivers.values():
            receiver.has.discard(pose_id)
