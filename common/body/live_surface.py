"""A moved mesh that stays alive: where the newest maps show another radius or colour than the mesh, it follows.

The mesh (a candidate pose, DISPOSE §5.1) is fine but was captured at another moment; the maps (Lien §5.2) are coarse
but new. So the mesh is put into the maps' own grid and the difference is taken cell by cell, which leaves what is finer
than a cell as the mesh has it; it is smoothed against noise and given back to the vertices: along the radius to their
places, as an offset to the texture's colours. A shirt that slides is dragged along; an elbow that skinning pinches gets
its width.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.cylindrical_map import (
    RADIUS_STEP_M,
    LinkMaps,
    cylinder_coordinates,
    into_cylinders,
    project_points,
)
from common.body.map_layout import MapLayout

NO_OFFSET = 128  # of a colour offset: in between of uint8
_FOLLOWED_M = 0.05  # a map farther off than this shows another surface
_DEAD_COLOUR, _DEAD_M = 6.0, 0.002  # smaller differences are noise


def live_surface(
    layout: MapLayout,
    maps: LinkMaps,
    T_world_link: NDArray[np.float32],
    links: NDArray[np.uint8],
    vertices: NDArray[np.float32],
    colours: NDArray[np.uint8],
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Vertices (V, 3) float32 [m, world] moved towards the newest ``maps``, and colour offsets (V, 3) uint8 about
    ``NO_OFFSET``.

    ``links`` (V,), ``colours`` (V, 3): the link and the texture's colour of each of the mesh's ``vertices``, which are
    already animated to the posed links ``T_world_link`` (L, 4, 4).
    """
    own = project_points(layout, T_world_link, links, vertices, colours)
    difference = np.zeros((layout.height, layout.width, 4), np.float32)
    known = np.zeros((layout.height, layout.width), np.bool_)
    _compare(maps.full, maps.colour, maps.radius, own.full, own.colour, own.radius, difference, known)
    smooth = np.zeros_like(difference)
    _smooth(layout.places, known, difference, smooth)
    moved, offsets = vertices.copy(), np.full(vertices.shape, NO_OFFSET, np.uint8)
    into = into_cylinders(layout, T_world_link)
    _follow(vertices, links, into, layout.sizes, layout.places, known, smooth, moved, offsets)
    return moved, offsets


@njit(nogil=True, cache=True, error_model="numpy")
def _compare(full, colour, radius, own_full, own_colour, own_radius, difference, known):  # type: ignore[no-untyped-def]
    """Where both are full and of one surface: colour and radius [m] of the maps beyond the mesh's own."""
    for v in range(full.shape[0]):
        for u in range(full.shape[1]):
            if not (full[v, u] and own_full[v, u]):
                continue
            out_m = np.float32((np.int64(radius[v, u]) - np.int64(own_radius[v, u])) * RADIUS_STEP_M)
            if abs(out_m) <= _FOLLOWED_M:
                known[v, u] = True
                difference[v, u, 3] = out_m
                for c in range(3):
                    difference[v, u, c] = np.float32(np.int64(colour[v, u, c]) - np.int64(own_colour[v, u, c]))


@njit(nogil=True, cache=True, error_model="numpy")
def _smooth(places, known, difference, out):  # type: ignore[no-untyped-def]
    """Mean of the known among each known cell and its eight neighbours; a grid goes around its link."""
    for link in range(len(places)):
        top, left, rows, columns = places[link]
        for row in range(rows):
            for column in range(columns):
                v, u = top + row, left + column
                if not known[v, u]:
                    continue
                count = np.float32(0)
                for y in range(max(row - 1, 0), min(row + 2, rows)):
                    for x in range(column - 1, column + 2):
                        at = left + x % columns
                        if known[top + y, at]:
                            count += 1
                            for c in range(4):
                                out[v, u, c] += difference[top + y, at, c]
                for c in range(4):
                    out[v, u, c] /= count


@njit(nogil=True, cache=True, error_model="numpy")
def _follow(vertices, links, into, sizes, places, known, difference, moved, offsets):  # type: ignore[no-untyped-def]
    """Give each vertex the difference between the middles of the known cells around it."""
    half = np.float32(0.5)
    sums = np.zeros(4, np.float32)
    for n in range(len(vertices)):
        link = links[n]
        top, left, rows, columns = places[link]
        m = into[link]
        y, x, radius, (front, side, beyond) = cylinder_coordinates(
            vertices[n], m, sizes[link, 0], sizes[link, 1], rows, columns
        )
        y, x = y - half, x - half
        y0, x0 = int(np.floor(y)), int(np.floor(x))
        sums[:] = 0
        weight = np.float32(0)
        for down in range(2):
            v = top + min(max(y0 + down, 0), rows - 1)
            wy = y - y0 if down else 1 - (y - y0)
            for across in range(2):
                u = left + (x0 + across) % columns
                if known[v, u]:
                    w = np.float32(wy * (x - x0 if across else 1 - (x - x0)))
                    weight += w
                    for c in range(4):
                        sums[c] += w * difference[v, u, c]
        if weight < half:
            continue
        out_m = _beyond_noise(sums[3] / weight, np.float32(_DEAD_M)) / max(radius, np.float32(1e-4))
        for i in range(3):
            moved[n, i] += out_m * (front * m[0, i] + side * m[1, i] + beyond * m[2, i])
            offset = _beyond_noise(sums[i] / weight, np.float32(_DEAD_COLOUR))
            offsets[n, i] = np.uint8(min(max(np.float32(NO_OFFSET) + offset, np.float32(0)), np.float32(255)))


@njit(nogil=True, cache=True, error_model="numpy")
def _beyond_noise(value, dead):  # type: ignore[no-untyped-def]
    return value - dead if value > dead else value + dead if value < -dead else np.float32(0)
