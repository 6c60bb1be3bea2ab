"""Who stands in front of the virtual cameras, and how to get one by name."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sender.capture.body_performer import BodyPerformer
from sender.capture.builtin_body import BUILTIN, builtin_body
from sender.capture.choreography import routine
from sender.capture.frame_set import CaptureError
from sender.capture.fundamental_poses import PREFIX, fundamental_poses, joined
from sender.capture.mocap import read_clip
from sender.capture.retarget import retarget
from sender.capture.skinned_body import PerformerMesh, SkinnedBody, load_body

__all__ = ["Performer", "PerformerMesh", "open_performer"]

ROUTINE = "routine"


class Performer(Protocol):
    """A moving person with a known truth: metres, y up, on y = 0 near the origin, facing +Z at the start.

    From 0 to 1 s an A-pose, from 1 to 2 s a blend into the motion, which goes on for ever; ``duration_s`` is the time
    until it repeats.
    """

    name: str
    mesh: PerformerMesh
    duration_s: float

    def surface(self, time_s: float) -> NDArray[np.float32]:
        """Vertices (V, 3) float32 [m, world] at ``time_s`` >= 0."""
        ...

    def named_joints(self, time_s: float) -> NDArray[np.float32]:
        """True joints (16, 3) float32 [m, world], in the order of ``common.body.skeleton.NAMED_JOINTS``."""
        ...


def open_performer(
    name: str, motion: str | None = None, data: Path | None = None, on_the_spot: bool = True
) -> BodyPerformer:
    """The performer ``name`` in ``motion``.

    ``name``: "builtin" or a body of ``data``/bodies. ``motion``: a clip of ``data``/mocap, or None for the built-in
    routine (30 s: wave, T-pose, fold arms, squat, turn, steps, kick); "dispose12+" and a clip, or "routine": the twelve
    fundamental poses first. ``on_the_spot``: clips that travel metres are
    kept where cameras see them.

    Raises:
        CaptureError: unknown body or motion (the message lists those there are), or data that cannot be read.
    """
    body = builtin_body() if name == BUILTIN else _body_of(name, data)
    if motion is None:
        return BodyPerformer(body, retarget(body, routine()), name)
    free = motion.removeprefix(PREFIX)
    if free != ROUTINE and data is None:
        raise CaptureError(f"motion {free!r} needs a data folder with mocap/clips.json")
    clip = routine() if data is None or free == ROUTINE else read_clip(data / "mocap", free)
    track = retarget(body, clip, on_the_spot)
    if motion != free:
        track = joined(retarget(body, fundamental_poses()), track)
    return BodyPerformer(body, track, f"{name}/{motion}")


def _body_of(name: str, data: Path | None) -> SkinnedBody:
    if data is None:
        raise CaptureError(f"performer {name!r} needs a data folder with bodies/; without one there is: {BUILTIN}")
    path = data / "bodies" / f"{name}.npz"
    if not path.exists():
        there = sorted(file.stem for file in (data / "bodies").glob("*.npz"))
        raise CaptureError(f"no performer {name!r} in {data / 'bodies'}; there are: {', '.join([BUILTIN, *there])}")
    return load_body(path)
