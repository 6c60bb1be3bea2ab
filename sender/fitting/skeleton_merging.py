"""Skeletons of several sensors merged by confidence into one (Yeung, Kwok & Wang 2013; DISPOSE §3).

A Kalman filter joins what the sensors say of each joint (``joint_filter``), and bones keep their lengths. A sensor's
word is worth the inverse of a variance, which grows with what makes a sensor err: its noise of late, guessed joints, a
person side-on to it or turned away, bones of a wrong length, a place far from where the past leads while another
sensor's is near.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sender.capture.outside_skeleton import JOINTS_BY_KIND, Instant, Sensor
from sender.fitting.bone_lengths import RunningMedian, bones_of
from sender.fitting.joint_filter import JointFilter

Floats = NDArray[np.float64]

NOISE_M = 0.002  # of a tracked joint, before anything is known of a sensor
LEAST_NOISE_M = 0.001
NOISE_RATE = 0.05  # of the running mean of the noise, per frame
DISAGREEMENT_M = 0.03
BONE_ERROR_M = 0.03
SIDE_ON = 0.25  # weight of a sensor that sees the person from the side or from behind
EARLY_FRAMES = 64
TRIAL_FRAMES = 256  # a person who comes in from the side is measured badly at first
ANOTHER_PERSON = 0.12  # median difference of the bones' lengths
PAUSE_S = 0.3  # after so long the past does not say where the joints are
ABSENCE_S = 2.0  # after so long it may be another person
PROJECTIONS = 100
UNSEEN_M = 0.1  # how well a joint is known that nobody sees
SEEN = 0.5  # least confidence of a joint that sizes are learned from
_TINY = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class MergedSkeleton:
    """``joints`` (J, 3) float64 [m, world] in the sensors' order; ``confidence`` (J,) in [0, 1]; ``spread_m``: RMS
    distance between the joints and what the sensors said of them, after their constant differences."""

    capture_ns: int
    joints: Floats
    confidence: Floats
    spread_m: float


@njit(nogil=True, cache=True, error_model="numpy")
def _keep_lengths(joints, share, bones, lengths, rounds):  # type: ignore[no-untyped-def]
    """Move joints (J, 3) until the ``bones`` (B, 2) have their ``lengths`` (B,) [m]; of a bone's two ends each moves by
    its ``share`` (J,), a variance: what is known well stays."""
    for _ in range(rounds):
        worst = 0.0
        for b in range(len(bones)):
            i, j = bones[b, 0], bones[b, 1]
            x, y, z = joints[j, 0] - joints[i, 0], joints[j, 1] - joints[i, 1], joints[j, 2] - joints[i, 2]
            length = np.sqrt(x * x + y * y + z * z)
            if not length > 1e-9 or not lengths[b] > 0.0:  # an end that nobody has seen is NaN
                continue
            excess = (length - lengths[b]) / (length * (share[i] + share[j]))
            worst = max(worst, abs(length - lengths[b]))
            for axis, d in enumerate((x, y, z)):
                joints[i, axis] += share[i] * excess * d
                joints[j, axis] -= share[j] * excess * d
        if worst < 1e-5:
            return


class _Witness:
    """What is remembered of one sensor: its last two skeletons (NaN where it did not track a joint), its noise, and
    which joints it tracks."""

    def __init__(self, joints: int) -> None:
        self.noise = np.full(joints, NOISE_M**2)  # variance per axis [m²]
        self.tracked = np.zeros(joints, np.bool_)
        self._times_ns = (0, 0)
        self._last: Floats | None = None
        self._before: Floats | None = None

    def take(self, capture_ns: int, joints: Floats, tracked: NDArray[np.bool_]) -> bool:
        """A skeleton (J, 3) of this sensor, of which it tracks some joints (J,); False for one that was taken before,
        which says nothing new."""
        step_s, past_s = (capture_ns - self._times_ns[0]) * 1e-9, (self._times_ns[0] - self._times_ns[1]) * 1e-9
        if self._last is not None and step_s == 0:
            return False
        joints = np.where(tracked[:, None], joints, np.nan)
        goes_on = 0 < step_s < PAUSE_S
        if goes_on and self._last is not None and self._before is not None:
            ahead = step_s / past_s
            surprise = joints - self._last - ahead * (self._last - self._before)
            variance = (surprise**2).mean(axis=1) / (1 + (1 + ahead) ** 2 + ahead**2)
            variance = np.minimum(variance, 25 * self.noise)  # a jump is judged by the others, not by this
            change = np.maximum(variance, LEAST_NOISE_M**2) - self.noise
            self.noise += NOISE_RATE * np.nan_to_num(change)  # not from places that it guessed
        self._before = self._last if goes_on else None
        self._last, self._times_ns = joints, (capture_ns, self._times_ns[0])
        return True


@dataclass(frozen=True, slots=True, eq=False)
class _Words:
    """What S sensors say at one instant. ``joints`` (S, J, 3) [m]; ``places`` (S, J, 3): brought to the instant by the
    joints' velocity; ``age_s`` (S,): by how much; ``fresh``: who says something new."""

    sensors: list[int]
    witnesses: tuple[_Witness, ...]
    positions: Floats  # of the sensors (S, 3)
    joints: Floats
    places: Floats
    confidence: Floats
    age_s: Floats
    fresh: tuple[bool, ...]


class SkeletonMerger:
    """Merges the skeletons of ``sensors``, all of one ``kind`` (a key of ``JOINTS_BY_KIND``), instant after instant.

    ``bones`` (B, 2) and ``lengths`` (B,) [m]: the joints they join, and their lengths as learned so far.
    """

    def __init__(self, kind: str, sensors: Sequence[Sensor]) -> None:
        names = JOINTS_BY_KIND[kind]
        self.bones = bones_of(kind)
        self.lengths = np.full(len(self.bones), np.nan)
        self._learned = RunningMedian(len(self.bones))
        self.people = 1  # so far, told apart by their sizes
        self._stranger: RunningMedian | None = None  # sizes of somebody who came after an absence
        self._positions = np.array([sensor.position for sensor in sensors], np.float64).reshape(-1, 3)
        self._sides = tuple([names.index(f"{s}_{joint}") for joint in ("shoulder", "hip")] for s in ("left", "right"))
        self._witnesses = [_Witness(len(names)) for _ in sensors]
        self._filter = JointFilter(len(names), len(sensors))
        self._capture_ns: int | None = None

    def merge(self, instant: Instant) -> MergedSkeleton:
        """One skeleton from those of an instant (of one sensor or more), at the time of the newest.

        Raises:
            ValueError: a skeleton of another kind, or of a sensor there is not.
        """
        for skeleton in instant:
            if len(skeleton.joints) != len(self._filter.places) or not 0 <= skeleton.sensor < len(self._witnesses):
                raise ValueError(f"a {skeleton.kind} skeleton of sensor {skeleton.sensor} does not belong here")
        capture_ns = max(skeleton.capture_ns for skeleton in instant)
        passed_s = self._passed_s(capture_ns)
        self._filter.advance(passed_s)
        words = self._words(instant, capture_ns)
        self._welcome(words)
        said = words.places - np.moveaxis(self._filter.offsets[:, words.sensors], 1, 0)
        variance = self._variance(words, said)
        self._take(words, variance, passed_s)
        joints = self._with_bones_kept(variance, words)
        unseen = words.confidence.max(axis=0) == 0
        self._move_on(joints, unseen, capture_ns)
        apart = np.linalg.norm(said - joints, axis=2)[words.confidence > SEEN]
        spread_m = float(np.sqrt((apart**2).mean())) if len(apart) else 0.0
        return MergedSkeleton(capture_ns, joints, words.confidence.max(axis=0), spread_m)

    @property
    def _knows_lengths(self) -> bool:
        """Early on lengths may be wrong, and must not confirm themselves."""
        return self._learned.count >= EARLY_FRAMES

    def _passed_s(self, capture_ns: int) -> float:
        """Since the last instant; after a pause the past is forgotten, after an absence the person as well."""
        passed_s = np.inf if self._capture_ns is None else (capture_ns - self._capture_ns) * 1e-9
        if 0 <= passed_s < PAUSE_S:
            return float(passed_s)
        self._filter = JointFilter(len(self._filter.places), len(self._witnesses))
        for witness in self._witnesses:
            witness.tracked[:] = False
        if not 0 <= passed_s < ABSENCE_S and self._learned.count:
            self._stranger = RunningMedian(len(self.bones))
        return 0.0

    def _words(self, instant: Instant, capture_ns: int) -> _Words:
        sensors = [skeleton.sensor for skeleton in instant]
        joints = np.array([skeleton.joints for skeleton in instant], np.float64)
        age_s = np.array([capture_ns - skeleton.capture_ns for skeleton in instant]) * 1e-9
        confidence = np.array([skeleton.confidence for skeleton in instant], np.float64)
        fresh = tuple(
            self._witnesses[skeleton.sensor].take(skeleton.capture_ns, own, sure > 0)
            for skeleton, own, sure in zip(instant, joints, confidence, strict=True)
        )
        return _Words(
            sensors=sensors,
            witnesses=tuple(self._witnesses[sensor] for sensor in sensors),
            positions=self._positions[sensors],
            joints=joints,
            places=joints + self._filter.velocity * np.minimum(age_s, PAUSE_S)[:, None, None],
            confidence=confidence,
            age_s=age_s,
            fresh=fresh,
        )

    def _welcome(self, words: _Words) -> None:
        """A joint that a sensor tracks again goes on from where it is led to by the others and the past."""
        for sensor, own, confidence in zip(words.sensors, words.places, words.confidence, strict=True):
            witness = self._witnesses[sensor]
            self._filter.welcome(sensor, own, (confidence > 0) & ~witness.tracked)
            witness.tracked = confidence > 0

    def _take(self, words: _Words, variance: Floats, passed_s: float) -> None:
        """Take what is new into the joints, the oldest first."""
        worth = np.full((len(self._filter.places), len(self._witnesses)), np.inf)
        worth[:, words.sensors] = variance.T
        self._filter.wander(passed_s, worth)
        for s in np.argsort(-words.age_s, kind="stable"):
            if words.fresh[s]:
                self._filter.take(words.sensors[s], words.joints[s], min(float(words.age_s[s]), PAUSE_S), variance[s])

    def _variance(self, words: _Words, said: Floats) -> Floats:
        """What each sensor's word for each joint is worth (S, J): a variance per axis [m²], infinite for what is not
        tracked."""
        led = self._filter.places
        away = np.nan_to_num(np.linalg.norm(said - led, axis=2))
        least = np.where(words.confidence > 0, away, np.inf).min(axis=0)
        excess = np.maximum(away - np.minimum(least, away), 0.0)
        weight = words.confidence**2 * self._facing(words, led)[:, None] * self._length_trust(words.places)
        weight = weight / (1 + (excess / DISAGREEMENT_M) ** 2) ** 2
        noise = np.array([witness.noise for witness in words.witnesses])
        return np.where(weight > 0, noise / np.maximum(weight, _TINY), np.inf)

    def _facing(self, words: _Words, joints: Floats) -> Floats:
        """How much each sensor (S,) sees of the person from the front: 1 from the front, ``SIDE_ON`` from elsewhere."""
        known = joints if np.isfinite(joints).all() else words.places[0]
        left, right = (known[side].mean(axis=0) for side in self._sides)
        facing = np.cross(left - right, [0.0, 1.0, 0.0])
        towards = words.positions - (left + right) / 2
        towards[:, 1] = 0.0
        scale = np.linalg.norm(facing) * np.linalg.norm(towards, axis=1)
        return np.asarray(np.maximum(towards @ facing / np.maximum(scale, _TINY), SIDE_ON))

    def _length_trust(self, places: Floats) -> Floats:
        """1 where the bones at a joint (S, J) have their lengths; of several the best one counts: a wrist in the wrong
        place is not the elbow's fault."""
        first, second = self.bones.T
        error = np.abs(np.linalg.norm(places[:, first] - places[:, second], axis=2) - self.lengths)
        least = np.full((places.shape[1], len(places)), np.inf)
        for ends in (first, second):
            np.minimum.at(least, ends, np.nan_to_num(error, nan=np.inf).T)
        return np.asarray(1 / (1 + (np.where(np.isfinite(least), least, 0.0).T / BONE_ERROR_M) ** 2))

    def _with_bones_kept(self, variance: Floats, words: _Words) -> Floats:
        """The joints (J, 3) with their bones at the lengths learned, from this frame as well."""
        self._learn(words)
        joints = self._filter.places.copy()
        share = 1 / ((1 / variance).sum(axis=0) + 1 / UNSEEN_M**2)
        _keep_lengths(joints, share, self.bones, self.lengths, PROJECTIONS)
        return joints

    def _measured(self, words: _Words) -> Floats:
        """The bones' lengths (B,) [m] by the sensors that see both ends: the mean, weighted by their noise, which makes
        a bone longer and is taken off; NaN of a bone that nobody sees."""
        first, second = self.bones.T
        square = ((words.places[:, first] - words.places[:, second]) ** 2).sum(axis=2)
        noise = np.array([witness.noise for witness in words.witnesses])
        variance = noise[:, first] + noise[:, second]
        lengths = np.sqrt(np.maximum(square - 2 * variance, square / 4))
        seen = words.confidence > SEEN
        weight = np.where(seen[:, first] & seen[:, second], 1 / variance, 0.0)
        total = weight.sum(axis=0)
        return np.where(total > 0, (weight * lengths).sum(axis=0) / np.maximum(total, _TINY), np.nan)

    def _learn(self, words: _Words) -> None:
        """Learn the bones' lengths from one frame. After an absence they are learned anew aside, and taken when they
        are clearly another person's."""
        lengths = self._measured(words)
        if self._stranger is None:
            self.lengths = self._learned.update(lengths)
            return
        theirs = self._stranger.update(lengths)
        if self._stranger.count < TRIAL_FRAMES:
            return
        if np.nanmedian(np.abs(theirs - self.lengths) / self.lengths) > ANOTHER_PERSON:
            self._learned, self.lengths = self._stranger, theirs
            self.people += 1
        self._stranger = None

    def _move_on(self, joints: Floats, unseen: NDArray[np.bool_], capture_ns: int) -> None:
        self._filter.places[unseen] = joints[unseen]
        for parent, joint in self.bones:  # outwards: what nobody sees goes with its parent
            if unseen[joint]:
                self._filter.velocity[joint] = self._filter.velocity[parent]
        self._capture_ns = capture_ns
