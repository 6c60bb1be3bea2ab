"""The regions r of DISPOSE Eq. (1)–(2): the links, with the thumb apart from the palm, and how much each counts.

Thumb, palm and foot are prone to capture errors: "reducing the ω values for these regions improves the result
significantly" (§5.2).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, LINK_NAMES, SIDES

# A region has its link's number, the palm that of the hand; the thumbs, which move with it, come after the links.
REGION_NAMES = (*(name.replace("hand", "palm") for name in LINK_NAMES), *(f"{side}_thumb" for side in SIDES))
REGION_COUNT = len(REGION_NAMES)
REGION_INDEX = {name: index for index, name in enumerate(REGION_NAMES)}
REGION_LINKS = np.array(
    [*range(len(LINK_NAMES)), *(LINK_INDEX[f"{side}_hand"] for side in SIDES)], np.uint8
)  # the link each region moves with

# What Eq. (1) divides the change of a region's edges by: their own length, as printed; that of all the region's edges,
# those within it too; or their number times a fixed length. The first grows as edges get shorter, and the paper's
# threshold of 0.15 belongs to it on meshes like the paper's; the last means the same on coarse meshes and fine ones.
ScoreForm = Literal["joining-edges", "all-edges", "fixed-length"]

DEFAULT_WEIGHTS = {"thumb": 0.25, "palm": 0.5, "fingers": 0.25, "foot": 0.5, "toes": 0.25}


def default_region_weights() -> NDArray[np.float32]:
    """ω (R,) float32: 1, less for the regions prone to capture errors."""
    return region_weights({})


def region_weights(weights: Mapping[str, float]) -> NDArray[np.float32]:
    """ω (R,) float32 with ``weights`` in place of the defaults.

    A name is a region's ("left_thumb") or that of both sides' ("thumb"); a side's own goes before both sides'.

    Raises:
        ValueError: a name that is no region's, or a weight that is negative, not finite or above 10.
    """
    omega = np.ones(REGION_COUNT, np.float32)
    for table in (DEFAULT_WEIGHTS, weights):
        for name, weight in sorted(table.items(), key=lambda item: item[0] in REGION_INDEX):
            regions = [REGION_INDEX[r] for r in (name, *(f"{side}_{name}" for side in SIDES)) if r in REGION_INDEX]
            if not regions:
                raise ValueError(f"region_weights: no region {name!r}; there are {', '.join(_short_names())}")
            if not 0 <= weight <= 10:
                raise ValueError(f"region_weights: {name} = {weight} is outside 0..10")
            omega[regions] = weight
    if not omega.any():
        raise ValueError("region_weights: every region weighs 0")
    return omega


def _short_names() -> list[str]:
    sides = tuple(f"{side}_" for side in SIDES)
    return list(dict.fromkeys(name.removeprefix(sides[0]).removeprefix(sides[1]) for name in REGION_NAMES))
