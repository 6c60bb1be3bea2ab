"""Colours of the built-in performer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sender.capture.implicit_surface import Solid

Floats = NDArray[np.float64]


def paint(points, quads, solid, tube_names):
    owner = solid.owner(points)
    rng = np.random.default_rng(1)
    pal = rng.integers(60, 255, (len(tube_names), 3))
    n = solid.gradient(points)
    c = pal[owner] * (0.6 + 0.4 * np.clip(n[:, 2:], -1, 1))
    return None, None, c.astype(np.uint8)[quads.reshape(-1)]
