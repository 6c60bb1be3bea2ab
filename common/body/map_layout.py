"""Where every link's grid lies in the one atlas of a frame (Lien §5.2): both ends work it out, so it is not sent.

A link's surface is unrolled as a capsule's: columns go around it, rows along it. §5.2 asks for a grid of 2πR_l·S ×
L_l·S cells, S = √(|P_l| / (π R_l L_l)), of which x % residuals keep x %. Here |P_l| is the link's share, by area, of
the points of a frame, so that S is the same for all links and a cell as large everywhere. A cylinder has no ends, but
heads, fingertips and soles are seen from there: beyond each end the rows go on over a round cap, which adds rows to
§5.2's and loses no point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from common.body.link_segmentation import CAP_M
from common.body.skeleton import LINK_COUNT, Skeleton

BLOCK = 8  # cells: links begin at JPEG blocks, so that none bleeds into another
LEVEL_MIN, LEVEL_MAX = 1.0, 100.0  # %
POINTS_MIN, POINTS_MAX = 100, 500_000
CELLS_MAX = 1 << 23  # of an atlas: 4 × those of the most points on an ordinary body
_LENGTH_MIN_M = 0.02  # of a bone: a shorter one gets a grid as for this


@dataclass(frozen=True, slots=True, eq=False)
class MapLayout:
    """The grids of all links (L) at one density.

    ``height``, ``width``: cells of the atlas. ``places`` (L, 4) int32: top, left, rows, columns of each link's grid.
    ``cylinders`` (L, 3, 3) float32: rows are the front, side and axis directions of the cylinder in the link's frame;
    columns begin at the back, so the seam is where least is seen. ``sizes`` (L, 2) float32 [m]: length of the bone and
    radius by which rows go over the caps. ``cell_m``: side of a cell at the radius R_l [m], 1/S.
    """

    height: int
    width: int
    places: NDArray[np.int32]
    cylinders: NDArray[np.float32]
    sizes: NDArray[np.float32]
    cell_m: float


@lru_cache(maxsize=16)
def map_layout(skeleton: Skeleton, points: int, level: float) -> MapLayout:
    """The layout for a body of whose surface a frame has ``points`` points, at ``level`` percent of the cells.

    The skeleton must be the one the other end decodes (``quantized_skeleton``).

    Raises:
        ValueError: points or level outside their bounds, or a body so large that the atlas would be.
    """
    if not (POINTS_MIN <= points <= POINTS_MAX and LEVEL_MIN <= level <= LEVEL_MAX):
        raise ValueError(f"maps: {points} points at {level} %")
    lengths = np.maximum(np.sqrt((skeleton.tips.astype(np.float64) ** 2).sum(axis=1)), _LENGTH_MIN_M)
    radii = skeleton.radii.astype(np.float64)
    caps = np.minimum(radii, CAP_M)
    density = np.sqrt(points / (np.pi * (radii * lengths).sum()) * level / 100)  # S of §5.2, for all links
    columns = np.maximum(np.ceil(2 * np.pi * radii * density), 4).astype(np.int64)
    rows = np.maximum(np.ceil((lengths + np.pi * caps) * density), 4).astype(np.int64)
    tops, lefts, height, width = _shelves(rows, columns)
    places = np.stack([tops, lefts, rows, columns], axis=1).astype(np.int32)
    cylinders = np.stack([_cylinder(tip) for tip in skeleton.tips.astype(np.float64)]).astype(np.float32)
    sizes = np.stack([lengths, caps], axis=1).astype(np.float32)
    return MapLayout(height, width, places, cylinders, sizes, float(1 / density))


def _shelves(
    rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], int, int]:
    """Top and left (L,), (L,) of rectangles side by side on shelves, the tallest first, and the whole's size."""
    heights, widths = -(-rows // BLOCK) * BLOCK, -(-columns // BLOCK) * BLOCK
    area = int((heights * widths).sum())
    if area > CELLS_MAX:
        raise ValueError(f"maps: an atlas of {area} cells, at most {CELLS_MAX} are allowed")
    width = max(int(np.ceil(np.sqrt(area) / BLOCK)) * BLOCK, int(widths.max()))
    tops, lefts = np.empty(LINK_COUNT, np.int64), np.empty(LINK_COUNT, np.int64)
    top = left = shelf = 0
    for link in sorted(range(LINK_COUNT), key=lambda k: (-heights[k], k)):
        if left + widths[link] > width:
            top, left, shelf = top + shelf, 0, 0
        tops[link], lefts[link] = top, left
        left, shelf = left + int(widths[link]), max(shelf, int(heights[link]))
    return tops, lefts, top + shelf, width


def _cylinder(tip: NDArray[np.float64]) -> NDArray[np.float64]:
    """Front, side and axis (3, 3) of a bone in its link's frame: a person at rest faces +Z; a foot's front is up."""
    length = np.sqrt((tip**2).sum())
    axis = tip / length if length > 1e-6 else np.array([0.0, 1.0, 0.0])
    towards = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.7 else np.array([0.0, 1.0, 0.0])
    front = towards - axis * axis.dot(towards)
    front /= np.sqrt((front**2).sum())
    return np.stack([front, np.cross(axis, front), axis])
