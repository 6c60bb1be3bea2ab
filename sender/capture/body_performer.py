"""A skinned body that plays a track of poses: what the virtual rig films."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.geometry import quaternion
from sender.capture.skinned_body import PerformerMesh, SkinnedBody, named_joint_indices

Floats = NDArray[np.float64]

REST_S = 1.0  # the A-pose a fit starts from
BLEND_S = 1.0  # from the A-pose into the motion
TURN_S = 0.25  # a track played to and fro slows down this long before its ends, or its speed would jump


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """F poses at a fixed rate: ``local`` (F, J, 4) rotations relative to the parent, ``root`` (F, 3) [m, world].

    A cyclic track's last pose equals its first; any other is played to and fro.
    """

    frame_rate_hz: float
    local: Floats
    root: Floats
    cyclic: bool


class BodyPerformer:
    """Performer: the body's A-pose, a blend into the first pose of the track, then the track for ever.

    ``duration_s``: A-pose, blend and the track once (to and fro unless it is cyclic); ``motion_s``: and only to.
    """

    def __init__(self, body: SkinnedBody, track: PoseTrack, name: str) -> None:
        self.name = name
        self.mesh: PerformerMesh = body.mesh
        self._body = body
        self._track = track
        self._opening = _opening(body, track)
        self._named = named_joint_indices(body)
        length_s = (len(track.root) - 1) / track.frame_rate_hz
        self._period_s = length_s if track.cyclic else 2 * (length_s + TURN_S)
        self.duration_s = REST_S + BLEND_S + self._period_s
        self.motion_s = REST_S + BLEND_S + length_s

    def surface(self, time_s: float) -> NDArray[np.float32]:
        """Vertices (V, 3) float32 [m, world] at ``time_s`` >= 0 since the start."""
        return self._body.surface(self._body.joint_transforms(*self._pose(time_s)))

    def named_joints(self, time_s: float) -> NDArray[np.float32]:
        """True positions (16, 3) float32 [m, world] of ``NAMED_JOINTS`` at ``time_s`` >= 0."""
        T = self._body.joint_transforms(*self._pose(time_s))
        return np.ascontiguousarray(T[self._named, :, 3], np.float32)

    def named_rotations(self, time_s: float) -> Floats:
        """True rotations (16, 4) of the links at ``NAMED_JOINTS``, each relative to the body's joint above it."""
        return self._pose(time_s)[0][self._named]

    def _pose(self, time_s: float) -> tuple[Floats, Floats]:
        """Local rotations (J, 4) and root position (3,) [m]."""
        playing_s = time_s - REST_S - BLEND_S
        if playing_s < 0:
            return _between(self._opening, max(time_s - REST_S, 0.0))
        if self._track.cyclic:
            return _between(self._track, playing_s % self._period_s)
        return _between(self._track, to_and_fro(playing_s, self._period_s / 2 - TURN_S, TURN_S))


def to_and_fro(time_s: float, length_s: float, turn_s: float) -> float:
    """Place 0..length_s on a track played forwards and backwards, its speed changing over ±``turn_s`` at the ends.

    A triangle wave of half period ``length_s + turn_s`` whose corners are parabolas, shifted so that it starts at 0.
    """
    half = length_s + turn_s
    place = half - abs(time_s % (2 * half) - half)
    if place < turn_s:
        place = (place**2 + turn_s**2) / (2 * turn_s)
    elif half - place < turn_s:
        place = half - ((half - place) ** 2 + turn_s**2) / (2 * turn_s)
    return min(max(place - turn_s / 2, 0.0), length_s)


def _between(track: PoseTrack, time_s: float) -> tuple[Floats, Floats]:
    """Local rotations (J, 4) and root position (3,) [m] between the two poses around ``time_s``."""
    place = min(time_s * track.frame_rate_hz, len(track.root) - 1.0)
    before = min(int(place), len(track.root) - 2)
    share = place - before
    local = quaternion.slerp(track.local[before], track.local[before + 1], share)
    root = (1 - share) * track.root[before] + share * track.root[before + 1]
    return local, root


def _opening(body: SkinnedBody, track: PoseTrack) -> PoseTrack:
    """The blend from the A-pose into the track's first pose, the feet following the floor from one to the other."""
    frames = round(BLEND_S * track.frame_rate_hz) + 1
    share = np.linspace(0, 1, frames)
    share = share**2 * (3 - 2 * share)
    rest = np.broadcast_to(quaternion.IDENTITY, track.local[0].shape)
    local = quaternion.slerp(rest[None], track.local[:1], share[:, None])
    root = (1 - share)[:, None] * body.heads[0] + share[:, None] * track.root[0]
    low = body.lowest_foot(local, root)
    root[:, 1] += share * low[-1] - low
    return PoseTrack(track.frame_rate_hz, local, root, cyclic=False)
