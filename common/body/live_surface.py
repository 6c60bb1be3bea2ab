"""A moved mesh that stays alive: where the newest maps show another radius or colour than the mesh, it follows.

The mesh (a candidate pose, DISPOSE §5.1) is fine but was captured at another moment; the maps (Lien §5.2) are coarse
but new. So the mesh is put into the maps' own grid and the difference is taken cell by cell, which leaves what is finer
than a cell as the mesh has it, and smoothed against noise. This small picture is all that is sent on: the vertices,
whichever way the links move them meanwhile, find their cells in it by their cylinder coordinates and get it back, along
the radius to their places and as an offset to the texture's colours. A shirt that slides is dragged along; an elbow
that skinning pinches gets its width.
"""

from __future__ import annotations

from dataclasses import dataclass

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
from common.geometry.triangle_mesh import TriangleMesh

NO_OFFSET = 128  # in between of uint8
OUTWARD_STEP_M = 0.0005  # of a radius' offset
_FOLLOWED_M = 0.05  # a map farther off than this shows another surface
_DEAD_COLOUR, _DEAD_M = 6.0, 0.002  # smaller differences are noise
_KNOWN_AROUND = 3  # of 9 cells: so many tell what one between them is like


@dataclass(frozen=True, slots=True, eq=False)
class LiveSurface:
    """What maps show beyond one mesh, the pose ``pose_id``: ``offsets`` (H, W, 4) uint8 about ``NO_OFFSET`` in the grid
    of ``layout``: RGB, and the radius in steps of ``OUTWARD_STEP_M``."""

    pose_id: int
    layout: MapLayout
    offsets: NDArray[np.uint8]

    def follow(
        self,
        T_world_link: NDArray[np.float32],
        links: NDArray[np.uint8],
        vertices: NDArray[np.float32],
        strength: float = 1.0,
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Vertices (V, 3) float32 [m, world] moved outwards or inwards, and their colour offsets (V, 3) uint8 about
        ``NO_OFFSET``; of both the part ``strength``.

        ``links`` (V,): of the mesh's ``vertices``, which are already animated to the links at ``T_world_link``
        (L, 3 or 4, 4).
        """
        moved, colours = vertices.copy(), np.full(vertices.shape, NO_OFFSET, np.uint8)
        layout = self.layout
        into = into_cylinders(layout, T_world_link)
        _follow(vertices, links, into, layout.sizes, layout.places, self.offsets, np.float32(strength), moved, colours)
        return moved, colours


def live_surface(
    pose_id: int,
    layout: MapLayout,
    maps: LinkMaps,
    T_world_link: NDArray[np.float32],
    links: NDArray[np.uint8],
    vertices: NDArray[np.float32],
    colours: NDArray[np.uint8],
) -> LiveSurface:
    """What the newest ``maps`` show beyond a mesh.

    ``links`` (V,), ``colours`` (V, 3): the link and the texture's colour of each of the mesh's ``vertices`` (V, 3),
    which are already animated to the posed links ``T_world_link`` (L, 4, 4).
    """
    own = project_points(layout, T_world_link, links, vertices, colours)
    difference = np.zeros((layout.height, layout.width, 4), np.float32)
    known = np.zeros((layout.height, layout.width), np.bool_)
    _compare(maps.full, maps.colour, maps.radius, own.full, own.colour, own.radius, difference, known)
    offsets = np.full(difference.shape, NO_OFFSET, np.uint8)
    dead = np.array([_DEAD_COLOUR, _DEAD_COLOUR, _DEAD_COLOUR, _DEAD_M / OUTWARD_STEP_M], np.float32)
    _smooth(layout.places, known, difference, dead, offsets)
    return LiveSurface(pose_id, layout, offsets)


def vertex_colours(mesh: TriangleMesh) -> NDArray[np.uint8]:
    """The texture's colour (V, 3) at each vertex."""
    height, width = mesh.texture.shape[:2]
    u = (mesh.uv[:, 0] * width).astype(np.int32).clip(0, width - 1)
    v = (mesh.uv[:, 1] * height).astype(np.int32).clip(0, height - 1)
    return np.ascontiguousarray(mesh.texture[v, u])


@njit(nogil=True, cache=True, error_model="numpy")
def _compare(full, colour, radius, own_full, own_colour, own_radius, difference, known):  # type: ignore[no-untyped-def]
    """Where both are full and of one surface: colour and radius [``OUTWARD_STEP_M``] of the maps beyond the mesh's."""
    steps = np.float32(RADIUS_STEP_M / OUTWARD_STEP_M)
    followed = np.float32(_FOLLOWED_M / OUTWARD_STEP_M)
    for v in range(full.shape[0]):
        for u in range(full.shape[1]):
            if not (full[v, u] and own_full[v, u]):
                continue
            outward = np.float32(np.int64(radius[v, u]) - np.int64(own_radius[v, u])) * steps
            if abs(outward) <= followed:
                known[v, u] = True
                difference[v, u, 3] = outward
                for c in range(3):
                    difference[v, u, c] = np.float32(np.int64(colour[v, u, c]) - np.int64(own_colour[v, u, c]))


@njit(nogil=True, cache=True, error_model="numpy")
def _smooth(places, known, difference, dead, offsets):  # type: ignore[no-untyped-def]
    """Mean of the known among each cell and its eight neighbours, where they are enough, beyond what is noise; a grid
    goes around its link."""
    sums = np.zeros(4, np.float32)
    for link in range(len(places)):
        top, left, rows, columns = places[link]
        for row in range(rows):
            for column in range(columns):
                v, u = top + row, left + column
                sums[:] = 0
                count = 0
                for y in range(max(row - 1, 0), min(row + 2, rows)):
                    for x in range(column - 1, column + 2):
                        at = left + x % columns
                        if known[top + y, at]:
                            count += 1
                            for c in range(4):
                                sums[c] += difference[top + y, at, c]
                if not known[v, u] and count < _KNOWN_AROUND:
                    continue
                for c in range(4):
                    value = sums[c] / np.float32(count)
                    value = value - dead[c] if value > dead[c] else min(value + dead[c], np.float32(0))
                    shifted = np.float32(NO_OFFSET) + value + np.float32(0.5)
                    offsets[v, u, c] = np.uint8(min(max(shifted, np.float32(0)), np.float32(255)))


@njit(nogil=True, cache=True, error_model="numpy")
def _follow(vertices, links, into, sizes, places, offsets, strength, moved, colours):  # type: ignore[no-untyped-def]
    """Give each vertex the offset between the middles of the cells around it."""
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
        for down in range(2):
            v = top + min(max(y0 + down, 0), rows - 1)
            wy = y - y0 if down else 1 - (y - y0)
            for across in range(2):
                u = left + (x0 + across) % columns
                w = np.float32(wy * (x - x0 if across else 1 - (x - x0))) * strength
                for c in range(4):
                    sums[c] += w * (np.float32(offsets[v, u, c]) - np.float32(NO_OFFSET))
        out_m = sums[3] * np.float32(OUTWARD_STEP_M) / max(radius, np.float32(1e-4))
        for i in range(3):
            moved[n, i] += out_m * (front * m[0, i] + side * m[1, i] + beyond * m[2, i])
            shifted = np.float32(NO_OFFSET) + sums[i] + half
            colours[n, i] = np.uint8(min(max(shifted, np.float32(0)), np.float32(255)))
