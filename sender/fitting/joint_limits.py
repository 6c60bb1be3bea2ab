"""How far, and how willingly, every joint of the link tree turns.

A joint's rotation relative to its parent is read as three angles along the axes of the link's rest frame: the twist
about the bone and the two components of the swing that is left (a rotation vector). The table gives for each angle the
range a healthy adult reaches, widened: limits that are too narrow cost far more than limits that are too wide
(±50° feet put the toes 18 cm off). Values are for the left side; the right side is its mirror image in x.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_NAMES, LINK_PARENTS, SIDES

Array = NDArray[Any]

X, Y = 0, 1  # twist axes: arms lie along x at rest, everything else roughly along y

# link: (twist axis, lowest angles [deg], highest angles [deg], spread about rest [deg], change from frame to frame [deg])
# A spread of 0 locks the axis: fingers and toes are too small for a depth camera at 2.5 m to show how they turn.
_TABLE: dict[str, tuple[int, tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "pelvis": (Y, (-400, -400, -400), (400, 400, 400), (400, 400, 400), (20, 20, 20)),
    "lower_spine": (Y, (-40, -50, -40), (70, 50, 40), (15, 15, 15), (8, 8, 8)),
    "upper_spine": (Y, (-40, -50, -40), (70, 50, 40), (15, 15, 15), (8, 8, 8)),
    "neck": (Y, (-50, -50, -45), (60, 50, 45), (15, 15, 15), (8, 8, 8)),
    "head": (Y, (-50, -60, -45), (50, 60, 45), (20, 25, 20), (10, 10, 10)),
    "clavicle": (X, (-10, -35, -20), (10, 35, 50), (3, 10, 10), (2, 6, 6)),
    "upper_arm": (X, (-120, -155, -110), (120, 70, 120), (90, 150, 150), (10, 30, 30)),
    "forearm": (X, (-60, -165, -20), (60, 10, 20), (15, 150, 5), (6, 30, 4)),
    "hand": (X, (-90, -50, -90), (90, 50, 90), (15, 20, 25), (8, 12, 12)),
    "fingers": (X, (0, 0, 0), (0, 0, 0), (0, 0, 0), (1, 1, 1)),
    "thigh": (Y, (-150, -70, -60), (70, 70, 100), (120, 40, 90), (25, 8, 20)),
    "shin": (Y, (-10, -30, -15), (170, 30, 15), (150, 10, 5), (25, 5, 4)),
    "foot": (Y, (-65, -50, -50), (65, 50, 50), (25, 15, 15), (12, 8, 8)),
    "toes": (Y, (0, 0, 0), (0, 0, 0), (0, 0, 0), (1, 1, 1)),
}


class JointTable(NamedTuple):
    """The table as arrays for the kernels (L links).

    ``parents`` (L,) int64; ``ancestor`` (L, L) bool, [a, l] = a is l or above it; ``twist_axis`` (L,) int64;
    ``low, high, spread, step`` (L, 3) float64 [rad]: range, standard deviation about rest, and standard deviation of the
    change in 1/30 s; ``dof_link, dof_axis`` (D,) int64: the D free joint axes, without the six of the root.
    """

    parents: Array
    ancestor: Array
    twist_axis: Array
    low: Array
    high: Array
    spread: Array
    step: Array
    dof_link: Array
    dof_axis: Array


def joint_table() -> JointTable:
    """The human joint table for ``LINK_NAMES``."""
    rows = [_row(name) for name in LINK_NAMES]
    low, high, spread, step = (np.radians(np.array([row[k] for row in rows], float)) for k in (1, 2, 3, 4))
    free = [(link, axis) for link in range(1, LINK_COUNT) for axis in range(3) if spread[link, axis] > 0]
    return JointTable(
        parents=np.array(LINK_PARENTS, np.int64),
        ancestor=_ancestors(),
        twist_axis=np.array([row[0] for row in rows], np.int64),
        low=low,
        high=high,
        spread=spread,
        step=step,
        dof_link=np.array([link for link, _ in free], np.int64),
        dof_axis=np.array([axis for _, axis in free], np.int64),
    )


def _row(name: str) -> tuple[int, Array, Array, Array, Array]:
    side, _, part = name.partition("_")
    twist, low, high, spread, step = _TABLE[part if side in SIDES else name]
    lo, hi = np.array(low, float), np.array(high, float)
    if side == "right":  # mirrored in x: turns about y and z change their sign
        lo[1:], hi[1:] = -hi[1:].copy(), -lo[1:].copy()
    return twist, lo, hi, np.array(spread, float), np.array(step, float)


def _ancestors() -> Array:
    above = np.eye(LINK_COUNT, dtype=np.bool_)
    for link in range(1, LINK_COUNT):
        above[:, link] |= above[:, LINK_PARENTS[link]]
    return above
