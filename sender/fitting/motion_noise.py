"""How far joints turn between two frames: the noise of the particles (Rao & Hodges §5.1).

σ of a degree of freedom at the top layer is a third of its largest change from frame to frame. It depends on the time
between frames, so the table holds several. Learned from motion capture where there is some; the default reads the
joint table's own steps as the largest changes, and lets them grow with the root of the time: limbs turn back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sender.fitting.ellipsoid_body import EllipsoidBody
from sender.fitting.joint_limits import ROOT_STEP_M, joint_table

Array = NDArray[Any]
Floats = NDArray[np.float64]

FRAMES = (1, 2, 4, 8)  # the table's intervals, in frames of 1/30 s
FRAME_S = 1 / 30
# The largest change "after discounting for the noise": motion capture has a few frames in which markers were confused.
LARGEST_PERCENTILE = 99.5
ROOT_RANGE_M = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class MotionNoise:
    """``intervals_s`` (I,), rising; ``sigma`` (I, D) [rad, m] after each."""

    intervals_s: Floats
    sigma: Floats

    def after(self, interval_s: float) -> Floats:
        """σ (D,) of frames ``interval_s`` apart: linear between the intervals, in proportion below the first, and no
        more than after the last."""
        times = np.concatenate([[0.0], self.intervals_s])
        table = np.concatenate([np.zeros((1, self.sigma.shape[1])), self.sigma])
        return np.array([np.interp(interval_s, times, column) for column in table.T])


def learned_noise(clips: Sequence[Floats]) -> MotionNoise:
    """From clips (F, D) [rad, m] of particles 1/30 s apart: a third of the 99.5th percentile of the changes.

    Raises:
        ValueError: no clip is as long as the longest interval.
    """
    clips = [clip for clip in clips if len(clip) > FRAMES[-1]]
    if not clips:
        raise ValueError(f"motion noise: no clip of more than {FRAMES[-1]} frames")
    changes = [np.concatenate([_wrapped(clip[step:] - clip[:-step]) for clip in clips]) for step in FRAMES]
    sigma = np.array([np.percentile(np.abs(change), LARGEST_PERCENTILE, axis=0) / 3 for change in changes])
    return MotionNoise(np.array(FRAMES) * FRAME_S, sigma)


def default_noise(body: EllipsoidBody) -> MotionNoise:
    """From ``joint_limits``: a third of the step per 1/30 s times the root of the time, at most of the range."""
    table = joint_table()
    links, axes = body.links[body.dof_link], body.dof_axis
    turns, angle = axes < 3, np.minimum(axes, 2)
    step = np.where(turns, table.step[links, angle], ROOT_STEP_M)
    reach = np.where(turns, np.minimum(table.high - table.low, np.pi)[links, angle], ROOT_RANGE_M)
    return MotionNoise(
        np.array(FRAMES) * FRAME_S, np.array([np.minimum(step * np.sqrt(frames), reach) / 3 for frames in FRAMES])
    )


def _wrapped(angles: Floats) -> Floats:
    return (angles + np.pi) % (2 * np.pi) - np.pi
