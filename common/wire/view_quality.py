"""How finely a view is coded; apart from the codec, as settings hold it and are read before anything slow to load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

ColourFormat = Literal["jpeg", "webp"]
DEPTH_ERROR_MAX_MM = 16


@dataclass(frozen=True, slots=True)
class ViewQuality:
    """``colour``: of ``colour_quality`` 1..100; depth is off by at most ``depth_error_mm``, 0..16."""

    colour: ColourFormat = "jpeg"
    colour_quality: int = 85
    depth_error_mm: int = 1


FINE = ViewQuality()
