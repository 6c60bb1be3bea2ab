"""How views become a rigged mesh where there is a choice: it travels with them, so that both ends build the same."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Views = Literal["zippered", "separate"]
Segmentation = Literal["voronoi", "region-growing"]


@dataclass(frozen=True, slots=True)
class Rigging:
    """``segmentation``: each vertex to the nearest link, or regions grown from the links on the depth image.
    ``views``: several cameras' surfaces zippered into one, or each for itself."""

    segmentation: Segmentation = "voronoi"
    views: Views = "separate"


DEFAULT_RIGGING = Rigging()
