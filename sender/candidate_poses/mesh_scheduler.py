"""Which candidate pose goes to which receiver next (DISPOSE §6.1), whenever its link is free.

What a pose is worth comes from the usable pose set (χ, the paper's rule) or from the coverage (the better one); here
each receiver's own state is kept: what it has, and what it is being sent. Poses already sent stay, within a bound, for
receivers that join late.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from sender.candidate_poses.pose_coverage import Coverage
from sender.candidate_poses.usable_pose_set import Quotients


@dataclass(frozen=True, slots=True)
class SchedulerSettings:
    """``max_bytes, max_poses``: bound on the encoded poses held. ``ample_poses``: bandwidth is ample when that many
    fit in a second: then RT is its full share, ``retain_share``, of χ_s, and by coverage the newest pose goes first.
    ``first_s``: a first pose that takes longer is sent as its small preview. ``least_gain``: of σ, for a pose to be
    worth sending by coverage. ``supersede``: a pose on its way gives way to one that adds so many times as much and
    leaves it so small a share (its inverse) of what it adds."""

    max_bytes: int = 64 << 20
    max_poses: int = 200
    max_receivers: int = 64
    ample_poses: float = 4.0
    retain_share: float = 0.8
    first_s: float = 0.3
    least_gain: float = 1e-4
    supersede: float = 2.0


class Reason(StrEnum):
    """Why a pose was chosen."""

    FIRST = "the receiver has nothing"
    NEWEST = "newest, bandwidth is ample"
    RETAINED = "retained, χ > RT"
    BEST = "best χ"
    GAIN = "largest gain of coverage"


@dataclass(frozen=True, slots=True)
class SendRecord:
    """One send, for the log. χ of the pose and the best χ there was, ``chi_best`` (χ_s); by coverage both are gains of
    σ. RT, its size and the budget [bytes/s]; ``preview``: it went out small."""

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
    preview: bool = False


@dataclass(slots=True)
class _Held:
    pose_id: int
    encoded: bytes
    preview: bytes | None
    capture_ns: int
    chi: float = 0.0
    retained: bool = False
    was_sent: bool = False


@dataclass(slots=True)
class _Receiver:
    epoch: int
    has: set[int] = field(default_factory=set)
    sees: bool = False  # a pose, or a preview of one
    budget_bytes: int = 0
    pending: SendRecord | None = None


class MeshScheduler:
    """Poses of one person on their way to its receivers; pure, time is an argument."""

    def __init__(self, settings: SchedulerSettings | None = None) -> None:
        self._settings = settings or SchedulerSettings()
        self._held: dict[int, _Held] = {}
        self._newest: int | None = None
        self._coverage: Coverage | None = None
        self._receivers: dict[str, _Receiver] = {}

    @property
    def held_bytes(self) -> int:
        """Memory of the encoded poses."""
        return sum(len(pose.encoded) + len(pose.preview or b"") for pose in self._held.values())

    @property
    def budget_bytes(self) -> int | None:
        """What the thinnest receiver's window can carry in a second, last time it was asked; None without any."""
        return min((r.budget_bytes for r in self._receivers.values() if r.budget_bytes > 0), default=None)

    def offer(
        self, pose_id: int, encoded: bytes, capture_ns: int, worth: Quotients | Coverage, preview: bytes | None = None
    ) -> None:
        """A newly captured pose, and what the poses are worth now. Offer also those the usable pose set rejected: a
        receiver without any is shown the newest. What has left the set is forgotten unless it was sent to someone
        (then it keeps its last χ)."""
        previous = self._held.get(self._newest) if self._newest is not None else None
        if previous is not None:
            previous.preview = None
        self._held[pose_id] = _Held(pose_id, encoded, preview, capture_ns)
        self._newest = pose_id
        self._follow(worth)
        while self.held_bytes > self._settings.max_bytes or len(self._held) > self._settings.max_poses:
            others = [pose for pose in self._held.values() if pose.pose_id != pose_id]
            if not others:
                break
            self._forget(min(others, key=lambda pose: (pose.chi, pose.capture_ns)).pose_id)

    def _follow(self, worth: Quotients | Coverage) -> None:
        if isinstance(worth, Coverage):
            self._coverage, known = worth, set(worth.pose_ids)
        else:
            self._coverage, known = None, set(worth.chi)
            for pose in self._held.values():
                pose.retained = pose.pose_id in worth.retained
                pose.chi = worth.chi.get(pose.pose_id, pose.chi)
        for pose in list(self._held.values()):
            if pose.pose_id not in known and not pose.was_sent and pose.pose_id != self._newest:
                self._forget(pose.pose_id)

    def receiver_joined(self, receiver_id: str, epoch: int, holding: Mapping[int, int] | None = None) -> bool:
        """A receiver is there; a new ``epoch`` means it restarted with nothing else. ``holding``: the bytes of the
        poses it has, by id; fewer than a pose's own are its preview's. False: there are too many receivers."""
        known = self._receivers.get(receiver_id)
        if known is None and len(self._receivers) >= self._settings.max_receivers:
            return False
        if known is None or known.epoch != epoch:
            known = self._receivers[receiver_id] = _Receiver(epoch)
        whole = {i for i, size in (holding or {}).items() if i in self._held and size == len(self._held[i].encoded)}
        known.has |= whole
        known.sees = known.sees or bool(whole)
        return True

    @property
    def holding(self) -> dict[int, int]:
        """The bytes of the poses held, by id."""
        return {pose.pose_id: len(pose.encoded) for pose in self._held.values()}

    def receiver_left(self, receiver_id: str) -> None:
        """Forget a receiver; unknown ones are ignored."""
        self._receivers.pop(receiver_id, None)

    def next_for(self, receiver_id: str, budget_bytes: int, now_ns: int) -> tuple[int, bytes] | None:
        """The pose to send now that the receiver's link is free, or None: nothing it lacks is worth it, or nothing can
        be sent.

        ``budget_bytes``: what its window can carry in a second. A receiver that sees nobody is sent the newest at
        once. Asking again before ``sent`` abandons the pose given last.
        """
        receiver = self._receivers.get(receiver_id)
        if receiver is None:
            return None
        receiver.pending = None
        receiver.budget_bytes = budget_bytes
        lacking = [pose for pose in self._held.values() if pose.pose_id not in receiver.has]
        if not lacking or (receiver.sees and budget_bytes <= 0):
            return None
        worth = self._worth(lacking, receiver)
        chi_best = max(worth.values())
        rich = min(max(budget_bytes, 0) / self._ample_bytes(), 1.0)
        retain_threshold = 0.0 if self._coverage else self._settings.retain_share * rich * chi_best
        chosen = self._choose(lacking, worth, receiver.sees, rich >= 1, retain_threshold)
        if chosen is None:
            return None
        pose, reason = chosen
        slow = len(pose.encoded) > budget_bytes * self._settings.first_s
        small = pose.preview if reason is Reason.FIRST and slow else None
        encoded = small or pose.encoded
        receiver.pending = SendRecord(
            receiver_id, pose.pose_id, reason, worth[pose.pose_id], chi_best, retain_threshold,
            len(encoded), budget_bytes, now_ns, preview=small is not None,
        )  # fmt: skip
        return pose.pose_id, encoded

    def sent(self, receiver_id: str, pose_id: int, now_ns: int) -> SendRecord | None:
        """The pose given by ``next_for`` is out, or the link sees it through; None when it is no longer pending."""
        receiver = self._receivers.get(receiver_id)
        if receiver is None or receiver.pending is None or receiver.pending.pose_id != pose_id:
            return None
        record, receiver.pending = replace(receiver.pending, sent_ns=now_ns), None
        receiver.sees = True
        if pose_id in self._held and not record.preview:
            self._held[pose_id].was_sent = True
            receiver.has.add(pose_id)
        return record

    def superseded(self, receiver_id: str, under_way: Collection[int]) -> tuple[int, ...]:
        """Those of the poses on their way to a receiver that are not worth the rest of the way since a better one is
        here: by coverage one that adds much more, and with which they would add little. The receiver lacks them again.
        """
        receiver = self._receivers.get(receiver_id)
        if receiver is None or self._coverage is None:
            return ()
        arrived = receiver.has - set(under_way)
        lacking = [pose_id for pose_id in self._held if pose_id not in receiver.has]
        going = [pose_id for pose_id in under_way if pose_id in receiver.has]
        if not lacking or not going:
            return ()
        times = self._settings.supersede
        gains = self._coverage.gains(lacking, arrived)
        best, most = lacking[int(gains.argmax())], float(gains.max())
        now, then = self._coverage.gains(going, arrived), self._coverage.gains(going, arrived | {best})
        lost = [
            i for i, gain, left in zip(going, now, then, strict=True) if most > times * gain and gain > times * left
        ]
        receiver.has.difference_update(lost)
        return tuple(lost)

    def _worth(self, lacking: list[_Held], receiver: _Receiver) -> dict[int, float]:
        """χ of each pose, or what it would add to those the receiver has."""
        if self._coverage is None:
            return {pose.pose_id: pose.chi for pose in lacking}
        ids = [pose.pose_id for pose in lacking]
        return dict(zip(ids, self._coverage.gains(ids, receiver.has).tolist(), strict=True))

    def _choose(
        self, lacking: list[_Held], worth: Mapping[int, float], sees: bool, ample: bool, retain_threshold: float
    ) -> tuple[_Held, Reason] | None:
        newest = max(lacking, key=lambda pose: pose.capture_ns)
        best = max(lacking, key=lambda pose: (worth[pose.pose_id], pose.capture_ns))
        if not sees:
            return newest, Reason.FIRST
        if self._coverage is not None:
            if ample and newest.pose_id == self._newest:
                return newest, Reason.NEWEST
            return (best, Reason.GAIN) if worth[best.pose_id] > self._settings.least_gain else None
        retained = [pose for pose in lacking if pose.retained and pose.chi > retain_threshold]
        if retained:
            return max(retained, key=lambda pose: (pose.chi, pose.capture_ns)), Reason.RETAINED
        return (best, Reason.BEST) if best.chi > 0 else None

    def _ample_bytes(self) -> float:
        newest = self._held.get(self._newest) if self._newest is not None else None
        return self._settings.ample_poses * max(len(newest.encoded) if newest else 0, 1)

    def _forget(self, pose_id: int) -> None:
        del self._held[pose_id]
        for receiver in self._receivers.values():
            receiver.has.discard(pose_id)
