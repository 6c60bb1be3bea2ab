"""Plays skeletons at an even pace although they arrive unevenly: between newest wins (0) and smoothest (1).

A frame captured at c is shown at c + base + D. ``base`` is the quickest transit seen lately, clock offset included, so
that no common zero is needed; D is ``smoothness`` times the delay at which 99 % of the frames have come in time to be
interpolated to (an adaptive playout delay; Moon, Kurose & Towsley 1998). What D does not cover is extrapolated, within
a bound, and then held. A single lost frame is there all the same, since the packet after it repeats it; so is every
second frame where only half of the skeletons are taken.
Pure: time is an argument. With a smoothness of 0 there is no need of it: the newest skeleton is shown when it comes.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np

from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.geometry import quaternion
from common.wire.skeleton_packet import SkeletonPacket

IN_TIME = 0.99  # of the frames, at a smoothness of 1
REMEMBERED = 300  # frames whose lateness is known
FRAMES_MAX = 64
BUCKET_NS, BUCKETS = 5_000_000_000, 6  # the base is the least transit of the last half minute
AHEAD_MAX_NS = 66_000_000  # what may be extrapolated
SLEW = 0.1  # by how much faster or slower than life it may play to reach another delay
CATCH_UP_NS = 300_000_000  # the time in which it would, were it not for SLEW
JUMP_NS = 500_000_000  # further off, it jumps


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A skeleton with its body: one that arrived, or one for an instant between two (its packet says which)."""

    packet: SkeletonPacket
    body: Skeleton


class JitterBuffer:
    """Frames of one sender's run in, poses at any time out. ``counts``: interpolated, extrapolated, held (as often as
    it was asked), filled (frames that did not come and that the next packet repeated), jumps."""

    def __init__(self, smoothness: float) -> None:
        """
        Raises:
            ValueError: not in (0, 1].
        """
        if not 0 < smoothness <= 1:
            raise ValueError(f"smoothness: {smoothness} is outside 0..1, 0 excluded")
        self.counts: Counter[str] = Counter()
        self._smoothness = smoothness
        self._begin()

    def _begin(self) -> None:
        """Nothing is known of a new run's frames, times and path."""
        self._frames: deque[Frame] = deque(maxlen=FRAMES_MAX)
        self._transits: deque[tuple[int, int]] = deque(maxlen=BUCKETS)  # (which 5 s, the least transit in them)
        self._lateness_ns: deque[int] = deque(maxlen=REMEMBERED)
        self._delay_ns = 0
        self._played_ns: int | None = None  # the capture time shown last
        self._asked_ns = 0

    @property
    def delay_ns(self) -> int:
        """D: how much later than at the soonest frames are shown [ns]."""
        return self._delay_ns

    def push(self, packet: SkeletonPacket, body: Skeleton, arrival_ns: int) -> None:
        """The newest frame so far arrived; one of another run begins anew."""
        before = self._frames[-1].packet if self._frames else None
        if before is not None and before.epoch != packet.epoch:
            self._begin()
            before = None
        self._note_transit(arrival_ns - packet.capture_ns, arrival_ns)
        if before is not None:
            # The pose just after the one before is known from now on; until then it had to be extrapolated.
            self._lateness_ns.append(arrival_ns - self._base_ns - before.capture_ns)
            self._delay_ns = int(self._smoothness * np.quantile(self._lateness_ns, IN_TIME))
            self._fill(before, packet, body)
        self._frames.append(Frame(packet, body))

    def play(self, now_ns: int) -> Frame | None:
        """The pose to show at ``now_ns``; None when there is nothing new to see. Capture times never go back."""
        if not self._frames:
            return None
        shown_ns = self._played_ns
        self._played_ns = self._next_time(now_ns)
        self._asked_ns = now_ns
        newest = self._frames[-1].packet
        if self._played_ns <= newest.capture_ns:
            self.counts["interpolated"] += 1
            return self._between(self._played_ns)
        self._played_ns = max(min(self._played_ns, newest.capture_ns + AHEAD_MAX_NS), shown_ns or 0)
        if self._played_ns == shown_ns:
            self.counts["held"] += 1
            return None
        self.counts["extrapolated"] += 1
        return self._beyond(self._played_ns)

    @property
    def _base_ns(self) -> int:
        return min(transit for _, transit in self._transits)

    def _note_transit(self, transit_ns: int, now_ns: int) -> None:
        bucket = now_ns // BUCKET_NS
        if self._transits and self._transits[-1][0] == bucket:
            transit_ns = min(transit_ns, self._transits.pop()[1])
        self._transits.append((bucket, transit_ns))

    def _fill(self, before: SkeletonPacket, packet: SkeletonPacket, body: Skeleton) -> None:
        """Put the frame in between that the packet repeats: it was lost, or of a layer that is not taken."""
        capture_ns = packet.capture_ns - packet.previous_age_ns
        if packet.previous is None or packet.sequence < before.sequence + 2 or capture_ns <= before.capture_ns:
            return
        lost = replace(packet, sequence=packet.sequence - 1, capture_ns=capture_ns, pose=packet.previous, previous=None)
        self._frames.append(Frame(lost, body))
        self.counts["filled"] += 1

    def _next_time(self, now_ns: int) -> int:
        """The capture time to show: at life's pace, a little faster or slower where the delay is not what it should
        be."""
        due_ns = now_ns - self._base_ns - self._delay_ns
        if self._played_ns is None:
            return due_ns
        passed_ns = max(now_ns - self._asked_ns, 0)
        error_ns = due_ns - (self._played_ns + passed_ns)
        if abs(error_ns) > JUMP_NS:
            self.counts["jumps"] += 1
            return max(due_ns, self._played_ns)
        correction = min(max(error_ns / CATCH_UP_NS, -SLEW), SLEW)
        return self._played_ns + int(passed_ns * (1 + correction))

    def _between(self, capture_ns: int) -> Frame:
        """Interpolated to ``capture_ns``, not after the newest frame; the oldest one where it is before that."""
        later = next(i for i, frame in enumerate(self._frames) if frame.packet.capture_ns >= capture_ns)
        b = self._frames[later]
        if later == 0:
            return Frame(b.packet, b.body)
        a = self._frames[later - 1].packet
        share = (capture_ns - a.capture_ns) / (b.packet.capture_ns - a.capture_ns)
        return Frame(replace(b.packet, capture_ns=capture_ns, pose=moved(a.pose, b.packet.pose, share)), b.body)

    def _beyond(self, capture_ns: int) -> Frame:
        """The newest frame's motion carried on to ``capture_ns``."""
        newest = self._frames[-1]
        packet, pose = newest.packet, newest.packet.pose
        if len(self._frames) > 1:
            before = self._frames[-2].packet
            share = (capture_ns - before.capture_ns) / (packet.capture_ns - before.capture_ns)
            pose = moved(before.pose, pose, share)
        return Frame(replace(packet, capture_ns=capture_ns, pose=pose), newest.body)


def moved(a: SkeletonPose, b: SkeletonPose, share: float) -> SkeletonPose:
    """The pose at ``share`` of the way from ``a`` to ``b``, beyond 1 carried on: the root straight on, each rotation by
    slerp; with the confidence of ``b``."""
    rotations = quaternion.slerp(a.rotations.astype(np.float64), b.rotations.astype(np.float64), share)
    root = a.root_position + np.float32(share) * (b.root_position - a.root_position)
    return SkeletonPose(root, quaternion.normalized(rotations).astype(np.float32), b.confidence)
