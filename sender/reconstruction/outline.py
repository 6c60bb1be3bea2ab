"""The person's outline by colour: pixels beside the person that depth missed.

A depth sensor loses readings at edges, and near the floor its noise hides a shoe. Where a pixel that touches the
person looks like the person and not like the empty room, it is the person's too: with its own reading where that lies
on the surface beside it, else with that surface's depth. So the outline grows pixel by pixel, ``REACH`` at most.

Candidate poses are worth the time this takes; the tracker, which goes by some points of each frame, does not need it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.view import View

REACH = 5  # pixels that depth misses at most: a sole on the floor, a few lost readings at an edge
NOISE = 24.0  # levels: colours this alike may be the same, by a sensor's noise or a soft shadow
MIXED = 0.5  # a pixel is the person's if it shows more of the person than of the room
STRIPES = 32  # a frame updates every 32nd row: all in a second
LEARNING_RATE = 0.05  # weight of one picture in the mean
MARGIN = 24  # pixels around the person that are not learned: shadows, soles, blur
CHANGED_SHARE = 0.1  # of the room beside the person; with more, the light or the exposure is another

Box = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class SeenView(View):
    """A view and what else its pixels showed: ``readings_mm`` (h, w) uint16 [mm], all of them; ``room`` (h, w, 3)
    float32, the empty room's colour, nan where it is not known. ``range_limit``: share of its depth that a reading may
    be off the surface beside it."""

    readings_mm: NDArray[np.uint16] = field(kw_only=True)
    room: NDArray[np.float32] = field(kw_only=True)
    range_limit: float = field(kw_only=True)


def completed(view: View) -> View:
    """The view with what its outline lacked, where colour can tell; else as it is."""
    if not isinstance(view, SeenView):
        return view
    depth_mm = view.depth_mm.copy()
    _grow(depth_mm, view.readings_mm, view.colour, view.room, np.float32(view.range_limit))
    known = bool(np.isfinite(view.room).all())  # else what is missing there cannot be told
    return View(view.camera, view.u0, view.v0, depth_mm, view.colour, complete=known)


class RoomColour:
    """What the room of one camera looks like where nobody stands: ``picture`` (H, W, 3) uint8 RGB of the empty room
    where there is one, and what is seen beside the person."""

    def __init__(self, height: int, width: int, picture: NDArray[np.uint8] | None) -> None:
        self._mean = np.full((height, width, 3), np.nan, np.float32) if picture is None else picture.astype(np.float32)
        self._row = 0
        self.steady = True  # it looks as it did; else nothing can be told by it

    def learn(self, colour: NDArray[np.uint8], box: Box | None) -> None:
        """Follow the room in ``colour`` (H, W, 3), but for the person's ``box`` (u0, v0, w, h) [px]."""
        u0, v0, w, h = box or (0, 0, 0, 0)
        margin = MARGIN if box else 0
        left, top, right, bottom = u0 - margin, v0 - margin, u0 + w + margin, v0 + h + margin
        known, changed = _learn(self._mean, colour, self._row, left, top, right, bottom)
        self.steady = bool(changed <= CHANGED_SHARE * known)
        self._row = (self._row + 1) % STRIPES

    def around(self, box: Box) -> NDArray[np.float32]:
        """What is known of it in ``box`` (h, w, 3): nan where nothing is. It goes on to follow the room."""
        u0, v0, w, h = box
        return self._mean[v0 : v0 + h, u0 : u0 + w]


@njit(nogil=True, cache=True, error_model="numpy")
def _learn(mean, colour, first_row, left, top, right, bottom):  # type: ignore[no-untyped-def]
    """Every ``STRIPES``-th row outside the rectangle; how many pixels were known, and how many of those changed."""
    known = changed = 0
    for y in range(first_row, mean.shape[0], STRIPES):
        for x in range(mean.shape[1]):
            if top <= y < bottom and left <= x < right:
                continue
            apart = np.float32(0)
            for n in range(3):
                difference = np.float32(colour[y, x, n]) - mean[y, x, n]
                apart += difference * difference
                mean[y, x, n] += np.float32(LEARNING_RATE) * difference
            if apart >= 0:
                known += 1
                changed += 1 if apart > np.float32(NOISE * NOISE) else 0
            else:  # not a number: never seen before
                for n in range(3):
                    mean[y, x, n] = colour[y, x, n]
    return known, changed


@njit(nogil=True, cache=True, error_model="numpy")
def _grow(out, depth_mm, colour, room, range_limit):  # type: ignore[no-untyped-def]
    """Ring by ring, so that what is found does not depend on the order in a ring."""
    h, w = out.shape
    ring = np.empty((h * w, 2), np.int32)  # rows and columns of pixels to judge, ring after ring
    waiting = np.zeros((h, w), np.bool_)
    found = np.empty(h * w, np.uint16)
    first = last = 0
    for y in range(h):
        for x in range(w):
            if out[y, x] > 0:
                last = _surround(out, waiting, y, x, ring, last)
    for _ in range(REACH):
        for n in range(first, last):
            found[n] = _depth_at(out, depth_mm, colour, room, range_limit, ring[n, 0], ring[n, 1])
        for n in range(first, last):
            out[ring[n, 0], ring[n, 1]] = found[n]
        following = last
        for n in range(first, last):
            if found[n] > 0:
                following = _surround(out, waiting, ring[n, 0], ring[n, 1], ring, following)
        first, last = last, following


@njit(nogil=True, cache=True, error_model="numpy")
def _surround(out, waiting, y, x, ring, count):  # type: ignore[no-untyped-def]
    """Add the neighbours of (y, x) that are not the person's and do not wait yet."""
    for j in range(max(y - 1, 0), min(y + 2, out.shape[0])):
        for i in range(max(x - 1, 0), min(x + 2, out.shape[1])):
            if out[j, i] == 0 and not waiting[j, i]:
                waiting[j, i] = True
                ring[count, 0], ring[count, 1] = j, i
                count += 1
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def _depth_at(out, depth_mm, colour, room, range_limit, y, x):  # type: ignore[no-untyped-def]
    """The depth of the person there, 0 where it is the room; of the surfaces beside it the one that looks alike."""
    shown = np.zeros(3, np.float32)  # the person's colours beside it
    count, most_alike, z = np.float32(0), np.float32(np.inf), np.float32(0)
    for j in range(max(y - 1, 0), min(y + 2, out.shape[0])):
        for i in range(max(x - 1, 0), min(x + 2, out.shape[1])):
            if out[j, i] > 0:
                apart = np.float32(0)
                for n in range(3):
                    shown[n] += colour[j, i, n]
                    apart += (np.float32(colour[j, i, n]) - np.float32(colour[y, x, n])) ** 2
                count += 1
                if apart < most_alike:
                    most_alike, z = apart, np.float32(out[j, i])
    from_room = contrast = np.float32(0)
    for n in range(3):
        from_room += (np.float32(colour[y, x, n]) - room[y, x, n]) ** 2
        contrast += (shown[n] / count - room[y, x, n]) ** 2
    if not from_room > max(np.float32(NOISE * NOISE), np.float32(MIXED * MIXED) * contrast):  # also: room not known
        return np.uint16(0)
    reading = np.float32(depth_mm[y, x])
    return depth_mm[y, x] if abs(reading - z) <= range_limit * z else np.uint16(z)
