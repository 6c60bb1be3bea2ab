"""Residual maps' grids (Lien §5.2): a posed person's points → colour and radius in cells of links' cylinders, and back.

A point has, in its link's cylinder, an angle around the axis, a height along it and a radius, its distance from the
axis. Beyond an end it has its angle to the end's plane in place of a height and its distance from the end in place of
a radius: round caps, joined to the cylinder without a step. None of these change when link and points move together
rigidly. A cell keeps the mean of its points, without those well behind the outermost: a sleeve hides the arm in it.

What is lost on the way there and back: the place within a cell, at most half of ``cell_m`` along and half across, the
latter times radius / R_l where the surface is not at R_l, on a cap both times radius over the cap's; and the radius,
rounded to 2 mm, so at most 1 mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.link_points import LinkPoints
from common.body.map_layout import MapLayout

RADIUS_STEP_M = 0.002
RADIUS_MAX = 255  # steps: 51 cm; a point farther out is put there
_SAME_SURFACE_M = 0.03  # behind the outermost point of a cell: another surface
_CLOSING_NEIGHBOURS = 5  # of 8: an empty cell among so many full ones is a gap between points, not a hole
_CLOSING_PASSES = 4


@dataclass(frozen=True, slots=True, eq=False)
class LinkMaps:
    """One frame's maps of all links in one atlas (H, W) of a layout.

    ``full`` (H, W) bool: cells that hold surface. ``colour`` (H, W, 3) uint8 RGB and ``radius`` (H, W) uint8 [2 mm]:
    zero in empty cells.
    """

    full: NDArray[np.bool_]
    colour: NDArray[np.uint8]
    radius: NDArray[np.uint8]


def project_points(
    layout: MapLayout,
    T_world_link: NDArray[np.float32],
    links: NDArray[np.uint8],
    positions: NDArray[np.float32],
    colours: NDArray[np.uint8],
) -> LinkMaps:
    """The maps of points (N, 3) [m, world] with ``colours`` (N, 3) RGB, each of one of the posed ``links`` (N,)."""
    cells, radii = _cells_of(positions, links, into_cylinders(layout, T_world_link), layout.sizes, layout.places,
                             layout.width)  # fmt: skip
    full, colour, radius = _gathered(cells, radii, colours, layout.height * layout.width)
    shape = layout.height, layout.width
    return LinkMaps(full.reshape(shape), colour.reshape(*shape, 3), radius.reshape(shape))


def closed(layout: MapLayout, maps: LinkMaps) -> LinkMaps:
    """``maps`` with the gaps between points filled by their neighbours' mean; around a link the grid has no border."""
    out = LinkMaps(maps.full.copy(), maps.colour.copy(), maps.radius.copy())
    most = (layout.places[:, 2:].max(axis=0) + 2).tolist()
    _close(layout.places, np.zeros(most, np.uint8), out.full, out.colour, out.radius)
    return out


def resampled(layout: MapLayout, maps: LinkMaps, finer: MapLayout) -> LinkMaps:
    """The same surface on another layout of the same body, interpolated between the full cells."""
    shape = finer.height, finer.width
    out = LinkMaps(np.zeros(shape, np.bool_), np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8))
    _resample(layout.places, maps.full, maps.colour, maps.radius, finer.places, out.full, out.colour, out.radius)
    return out


def unproject(
    layout: MapLayout, maps: LinkMaps, T_world_link: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Positions (N, 3) [m, world], outward directions (N, 3) and colours (N, 3) of the full cells' middles, posed.

    A cap's cells get narrow towards its pole: there, of every two, three… the first full one is given.
    """
    positions, normals, colours, _ = _points(layout, maps, T_world_link)
    return positions, normals, colours


def unproject_to_links(layout: MapLayout, maps: LinkMaps) -> LinkPoints:
    """The same points, each in its link's own frame."""
    unmoved = np.tile(np.eye(4, dtype=np.float32), (len(layout.sizes), 1, 1))
    positions, _, colours, links = _points(layout, maps, unmoved)
    return LinkPoints(positions, links, colours)


def _points(
    layout: MapLayout, maps: LinkMaps, T_world_link: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]:
    """Positions, outward directions, colours and links of the points ``unproject`` gives."""
    to_world = into_cylinders(layout, T_world_link)
    R = np.ascontiguousarray(np.swapaxes(to_world[:, :, :3], 1, 2))
    origins = np.ascontiguousarray(T_world_link[:, :3, 3], np.float32)
    most = int(np.count_nonzero(maps.full))
    positions, normals = np.empty((most, 3), np.float32), np.empty((most, 3), np.float32)
    colours, links = np.empty((most, 3), np.uint8), np.empty(most, np.uint8)
    n = _points_of(layout.places, layout.sizes, R, origins, maps.full, maps.colour, maps.radius,
                   positions, normals, colours, links)  # fmt: skip
    return positions[:n], normals[:n], colours[:n], links[:n]


def into_cylinders(layout: MapLayout, T_world_link: NDArray[np.float32]) -> NDArray[np.float32]:
    """(L, 3, 4): world → front, side and axis coordinates of each posed link's cylinder."""
    R = layout.cylinders @ np.swapaxes(T_world_link[:, :3, :3], 1, 2)
    t = -np.einsum("lij,lj->li", R, T_world_link[:, :3, 3])
    return np.concatenate([R, t[:, :, None]], axis=2).astype(np.float32)


@njit(nogil=True, cache=True, error_model="numpy")
def cylinder_coordinates(point, into, length, cap, rows, columns):  # type: ignore[no-untyped-def]
    """A point's row and column in its link's grid, in cells from the top left corner, its radius [m], and (front, side,
    beyond) [m]: from the nearest place on the bone, in the cylinder's directions. ``into`` (3, 4): world → cylinder."""
    x, y, z = point[0], point[1], point[2]
    front = into[0, 0] * x + into[0, 1] * y + into[0, 2] * z + into[0, 3]
    side = into[1, 0] * x + into[1, 1] * y + into[1, 2] * z + into[1, 3]
    along = into[2, 0] * x + into[2, 1] * y + into[2, 2] * z + into[2, 3]
    across = np.sqrt(front * front + side * side)
    beyond = along if along < 0 else max(along - length, np.float32(0))
    turn = np.float32(2 * np.pi)
    cap_arc = cap * turn / 4
    height = min(max(along, np.float32(0)), length) + cap * np.float32(np.arctan2(beyond, across))
    row = (height + cap_arc) / (length + 2 * cap_arc) * rows
    column = (np.float32(np.arctan2(side, front)) / turn + np.float32(0.5)) * columns
    return row, column, np.sqrt(across * across + beyond * beyond), (front, side, beyond)


@njit(nogil=True, cache=True, error_model="numpy")
def _cells_of(positions, links, into, sizes, places, width):  # type: ignore[no-untyped-def]
    """Cell in the atlas (N,) int32 and radius (N,) [m] of each point."""
    cells, radii = np.empty(len(positions), np.int32), np.empty(len(positions), np.float32)
    for n in range(len(positions)):
        link = links[n]
        top, left, rows, columns = places[link]
        y, x, radius, _ = cylinder_coordinates(positions[n], into[link], sizes[link, 0], sizes[link, 1], rows, columns)
        row, column = min(max(int(y), 0), rows - 1), min(max(int(x), 0), columns - 1)
        cells[n] = (top + row) * width + left + column
        radii[n] = radius
    return cells, radii


@njit(nogil=True, cache=True, error_model="numpy")
def _gathered(cells, radii, colours, count):  # type: ignore[no-untyped-def]
    """Mean colour and radius of each cell's outermost points."""
    outermost, number = np.zeros(count, np.float32), np.zeros(count, np.float32)
    sums = np.zeros((count, 4), np.float32)
    for n in range(len(cells)):
        outermost[cells[n]] = max(outermost[cells[n]], radii[n])
    for n in range(len(cells)):
        cell = cells[n]
        if radii[n] >= outermost[cell] - np.float32(_SAME_SURFACE_M):
            number[cell] += 1
            sums[cell, 3] += radii[n]
            for c in range(3):
                sums[cell, c] += colours[n, c]
    full, colour, radius = np.zeros(count, np.bool_), np.zeros((count, 3), np.uint8), np.zeros(count, np.uint8)
    for cell in range(count):
        if number[cell] > 0:
            full[cell] = True
            for c in range(3):
                colour[cell, c] = np.uint8(sums[cell, c] / number[cell] + np.float32(0.5))
            steps = sums[cell, 3] / number[cell] / np.float32(RADIUS_STEP_M) + np.float32(0.5)
            radius[cell] = np.uint8(min(steps, np.float32(RADIUS_MAX)))
    return full, colour, radius


@njit(nogil=True, cache=True, error_model="numpy")
def _close(places, room, full, colour, radius):  # type: ignore[no-untyped-def]
    """Fill empty cells among at least five full neighbours, in place, as long as there are any but at most so often.

    ``room``: for a grid as it was before, with what is around it: the other side left and right, nothing above and
    below.
    """
    in_column, in_block = np.empty(room.shape[1], np.uint8), np.empty(room.shape[1], np.uint8)
    changed, changing = np.empty(len(room), np.bool_), np.empty(len(room), np.bool_)  # rows
    for link in range(len(places)):
        top, left, rows, columns = places[link]
        before = room[: rows + 2, : columns + 2]
        before[0], before[rows + 1] = 0, 0
        changed[:] = True
        for _ in range(_CLOSING_PASSES):
            for row in range(1, rows + 1):
                if changed[row]:
                    before[row, 1 : columns + 1] = full[top + row - 1, left : left + columns]
                    before[row, 0], before[row, columns + 1] = before[row, columns], before[row, 1]
            changing[:] = False
            for row in range(1, rows + 1):
                if not (changed[row - 1] or changed[row] or changed[row + 1]):
                    continue
                if _most_around(before[row - 1 : row + 2], in_column, in_block) < _CLOSING_NEIGHBOURS:
                    continue  # most of the void, and of what is full
                for column in range(columns):
                    if in_block[column] >= _CLOSING_NEIGHBOURS:
                        _fill_by_mean(before, full, colour, radius, row, column + 1, places[link])
                        changing[row] = True
            changed, changing = changing, changed
            if not changed.any():
                break


@njit(nogil=True, cache=True)
def _most_around(rows, in_column, in_block):  # type: ignore[no-untyped-def]
    """How many of their 8 neighbours are full, for the cells of the middle one of three ``rows`` that are empty, to
    ``in_block``, and the most of these."""
    above, own, below = rows[0], rows[1], rows[2]
    for n in range(len(own)):
        in_column[n] = above[n] + own[n] + below[n]
    most = np.uint8(0)
    for n in range(len(own) - 2):
        count = np.uint8((in_column[n] + in_column[n + 1] + in_column[n + 2]) * (1 - own[n + 1]))
        in_block[n] = count
        most = max(most, count)
    return most


@njit(nogil=True, cache=True, error_model="numpy")
def _fill_by_mean(before, full, colour, radius, row, column, place):  # type: ignore[no-untyped-def]
    """The cell at (row, column) of ``before`` becomes the mean of its neighbours that were full then."""
    top, left, rows, columns = place
    count = red = green = blue = steps = np.int64(0)
    for x in range(column - 1, column + 2):
        u = left + (columns if x == 0 else 1 if x > columns else x) - 1
        for y in range(row - 1, row + 2):
            v, one = top + min(max(y, 1), rows) - 1, np.int64(before[y, x])  # no if: which are full is hard to guess
            count += one
            steps += one * radius[v, u]
            red += one * colour[v, u, 0]
            green += one * colour[v, u, 1]
            blue += one * colour[v, u, 2]
    half, number = count // 2, np.float32(count)  # of integers this small a float's quotient is right, and fast
    v, u = top + row - 1, left + column - 1
    full[v, u] = True
    radius[v, u] = int(np.float32(steps + half) / number)
    colour[v, u, 0], colour[v, u, 1] = int(np.float32(red + half) / number), int(np.float32(green + half) / number)
    colour[v, u, 2] = int(np.float32(blue + half) / number)


@njit(nogil=True, cache=True, error_model="numpy")
def _resample(places, full, colour, radius, finer, out_full, out_colour, out_radius):  # type: ignore[no-untyped-def]
    """Bilinear between the full cells of ``places``; a cell is full where these weigh at least half."""
    one, half = np.float32(1), np.float32(0.5)
    sums = np.zeros(4, np.float32)
    for link in range(len(places)):
        top, left, rows, columns = places[link]
        out_top, out_left, out_rows, out_columns = finer[link]
        for row in range(out_rows):
            y = (np.float32(row) + half) * np.float32(rows) / np.float32(out_rows) - half
            y0 = int(np.floor(y))
            fy = y - np.float32(y0)
            for column in range(out_columns):
                x = (np.float32(column) + half) * np.float32(columns) / np.float32(out_columns) - half
                x0 = int(np.floor(x))
                fx = x - np.float32(x0)
                v0, v1 = top + min(max(y0, 0), rows - 1), top + min(max(y0 + 1, 0), rows - 1)
                u0, u1 = left + x0 % columns, left + (x0 + 1) % columns
                if not (full[v0, u0] or full[v0, u1] or full[v1, u0] or full[v1, u1]):
                    continue  # most of the void
                weight = np.float32(0)
                sums[:] = 0
                for v, wy in ((v0, one - fy), (v1, fy)):
                    for u, wx in ((u0, one - fx), (u1, fx)):
                        if full[v, u]:
                            w = wy * wx
                            weight += w
                            sums[3] += w * radius[v, u]
                            for c in range(3):
                                sums[c] += w * colour[v, u, c]
                if weight >= half:
                    v, u = out_top + row, out_left + column
                    out_full[v, u] = True
                    out_radius[v, u] = np.uint8(sums[3] / weight + half)
                    for c in range(3):
                        out_colour[v, u, c] = np.uint8(sums[c] / weight + half)


@njit(nogil=True, cache=True, error_model="numpy")
def _points_of(places, sizes, R, origins, full, colour, radius, positions, normals, colours, links):  # type: ignore[no-untyped-def]
    """Fill the arrays with the full cells' points, return how many there are."""
    n, quarter = 0, np.float32(np.pi / 2)
    around = np.empty((places[:, 3].max(), 2), np.float32)  # cosine and sine of each column's angle
    for link in range(len(places)):
        top, left, rows, columns = places[link]
        length, cap = sizes[link, 0], sizes[link, 1]
        for column in range(columns):
            angle = ((np.float32(column) + np.float32(0.5)) / columns * 4 - 2) * quarter
            around[column] = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        for row in range(rows):
            height = (np.float32(row) + np.float32(0.5)) / rows * (length + 2 * cap * quarter) - cap * quarter
            along = min(max(height, np.float32(0)), length)
            slope = (height - along) / cap  # angle beyond the end
            cosine, sine = np.float32(np.cos(slope)), np.float32(np.sin(slope))
            every = min(int(1 / max(cosine, np.float32(1e-3))), columns)
            given = -1  # of so many columns the first full one
            for column in range(columns):
                v, u = top + row, left + column
                if not full[v, u]:
                    continue
                if every > 1:
                    if column // every == given:
                        continue
                    given = column // every
                distance = np.float32(radius[v, u]) * np.float32(RADIUS_STEP_M)
                front, side = cosine * around[column, 0], cosine * around[column, 1]
                for i in range(3):
                    outward = R[link, i, 0] * front + R[link, i, 1] * side + R[link, i, 2] * sine
                    normals[n, i] = outward
                    positions[n, i] = origins[link, i] + R[link, i, 2] * along + outward * distance
                    colours[n, i] = colour[v, u, i]
                links[n] = link
                n += 1
    return n
