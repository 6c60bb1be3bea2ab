"""The person as the tracker knows them: sizes, and the surface of each link in the link's own frame (P_l, Lien §5.1.1).

Points are running averages in small cells, so the model is bounded, gets better with every frame that is added, and
one bad frame is soon outvoted. A model can be saved, and a restarted sender goes on with it in mid-motion.
"""

from __future__ import annotations

import io
import zipfile
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_PARENTS, Skeleton
from common.body.skeleton_pose import bone_segments
from common.geometry.point_cloud import PointCloud
from sender.fitting.closest_point_grid import LinkGrid, build_link_grid, shifted
from sender.fitting.link_cells import COLUMNS, COUNT, MAX_POINTS_PER_LINK, LinkCells
from sender.fitting.surface_matching import Surface, tints

Array = NDArray[Any]

FORMAT_VERSION = 2
MAX_BYTES = 8_000_000
GRID_CELL_M, GRID_MARGIN_M = 0.020, 0.06
UNSEEN_REACH = 1.5  # radii from the bone: what is further away may be anything
SEAM_RATIO = 1.35  # near a joint a point is of both bones: the second is at most this much further, in radii

_UNSPLIT = {"fingers": "hand", "toes": "foot"}  # locked joints: their points belong to the link that moves them


class BodyModel:
    """Surface points per link, gathered from clouds with known poses.

    ``skeleton``: sizes. ``match_colours``: whether points are matched by colour too. Adding points does not move the
    surface at once: ``surface`` brings links up to date.
    """

    def __init__(self, skeleton: Skeleton, match_colours: bool = False) -> None:
        self.skeleton = skeleton
        self.match_colours = match_colours
        self._cells = [LinkCells() for _ in range(LINK_COUNT)]
        self._grids: list[_LinkSurface | None] = [None] * LINK_COUNT
        self._stale = list(range(LINK_COUNT))  # longest waiting first
        self._surface: Surface | None = None

    @property
    def point_count(self) -> int:
        """Surface points of all links."""
        return sum(len(cells.keys) for cells in self._cells)

    def add(self, cloud: PointCloud, T_world_link: Array, turn: int = 0, turns: int = 1) -> None:
        """Adds a cloud whose pose is ``T_world_link`` (L, 4, 4) [world]; each point goes to the bone it is nearest to,
        measured in that bone's radii, and near a joint to both bones. Links are taken in ``turns``: only those whose
        index leaves the remainder ``turn`` get their points."""
        first, second, _, ratio = self._nearest_bones(cloud, T_world_link)
        seam = (ratio < SEAM_RATIO) & (first != second) & _JOINED[first, second]
        rows = np.concatenate([np.arange(len(first)), np.flatnonzero(seam)])
        links = np.concatenate([first, second[seam]])
        rows, links = rows[links % turns == turn], links[links % turns == turn]
        picked = PointCloud(cloud.positions[rows], cloud.normals[rows], cloud.colours[rows])
        self.add_assigned(picked, T_world_link, links)

    def add_unseen(self, cloud: PointCloud, T_world_link: Array, certain: Array) -> None:
        """Adds points that the surface does not explain so far, a side that turned up late, to those ``certain`` (L,)
        links they are close to. They count as surface once they were seen again; what is not seen again fades."""
        first, _, near, _ = self._nearest_bones(cloud, T_world_link)
        links = np.where(certain[first] & (near < UNSEEN_REACH), first, -1)
        stale = self._stale.copy()
        self.add_assigned(cloud, T_world_link, links)
        self._stale = stale
        for link in np.unique(links[links >= 0]):
            if self._cells[link].confirm():
                self._renew_later(int(link))

    def _nearest_bones(self, cloud: PointCloud, T_world_link: Array) -> tuple[Array, Array, Array, Array]:
        starts, ends = bone_segments(self.skeleton, T_world_link)
        first, second, near, ratio = nearest_bones(cloud.positions, starts, ends, self.skeleton.radii)
        return _MOVER[first], _MOVER[second], near, ratio

    def add_assigned(self, cloud: PointCloud, T_world_link: Array, links: Array) -> None:
        """Adds points whose link is known: ``links`` (N,) int, -1 = leave out."""
        for link in np.unique(links[links >= 0]):
            chosen = links == link
            T = T_world_link[link].astype(np.float64)
            points = (cloud.positions[chosen] - T[:3, 3]) @ T[:3, :3]
            normals = cloud.normals[chosen] @ T[:3, :3]
            self._cells[link].add(points, normals, cloud.colours[chosen].astype(np.float64))
            self._renew_later(int(link))

    def _renew_later(self, link: int) -> None:
        if link not in self._stale:
            self._stale.append(link)

    def move_joints(self, in_parent: Array, in_link: Array) -> None:
        """Moves joint centres: by ``in_parent`` (L, 3) [m] in the frames of their parents and by ``in_link`` (L, 3) [m]
        in those of their own links, whose surfaces keep their place in the world's view of them: relative to the
        centre they shift the other way."""
        parents = np.array(LINK_PARENTS[1:])
        offsets = self.skeleton.offsets.astype(np.float64)
        offsets[1:] += in_parent[1:] - in_link[parents]
        tips = self.skeleton.tips - in_link
        for link in range(1, LINK_COUNT):  # a bone that ended where the next begins still does
            parent = LINK_PARENTS[int(link)]
            if np.array_equal(self.skeleton.tips[parent], self.skeleton.offsets[link]):
                tips[parent] = offsets[link]
        self.skeleton = Skeleton(offsets.astype(np.float32), tips.astype(np.float32), self.skeleton.radii)
        for row, (cells, entry) in enumerate(zip(self._cells, self._grids, strict=True)):
            if np.any(in_link[row]):
                cells.shift(-in_link[row])
                if entry is not None:
                    self._grids[row] = entry._replace(grid=shifted(entry.grid, -in_link[row]))
        self._surface = None

    def surface(self, refreshed_links: int = LINK_COUNT) -> Surface:
        """All links' points and closest-point grids. At most ``refreshed_links`` links whose points changed get a new
        grid (2 to 8 ms each), the others answer as before; a link's first grid is always built."""
        missing = [link for link in self._stale if self._grids[link] is None]
        waiting = [link for link in self._stale if self._grids[link] is not None]
        renewed = missing + waiting[: max(refreshed_links - len(missing), 0)]
        for link in renewed:
            points, normals, colours = self._cells[link].surface()
            grid = build_link_grid(points, normals, GRID_CELL_M, GRID_MARGIN_M)
            self._grids[link] = _LinkSurface(grid, tints(colours))
        self._stale = [link for link in self._stale if link not in renewed]
        if renewed or self._surface is None:
            ready = [entry for entry in self._grids if entry is not None]
            self._surface = _join(ready, self.match_colours)
        return self._surface

    def to_bytes(self) -> bytes:
        """The model as an npz archive, at most ``MAX_BYTES``; not compressed: noise does not shrink."""
        counts = np.array([len(cells.keys) for cells in self._cells], np.int32)
        sums = np.concatenate([cells.sums for cells in self._cells]).astype(np.float32)
        out = io.BytesIO()
        np.savez(
            out,
            version=np.int32(FORMAT_VERSION),
            offsets=self.skeleton.offsets,
            tips=self.skeleton.tips,
            radii=self.skeleton.radii,
            counts=counts,
            sums=sums,
        )
        return out.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> BodyModel:
        """The model ``to_bytes`` wrote.

        Raises:
            ValueError: not such an archive, another version, or sizes and values that cannot be; says which.
        """
        version, offsets, tips, radii, counts, sums = _read_archive(data)
        if version.shape != () or int(version) != FORMAT_VERSION:
            raise ValueError(f"body model: version {version}, this program reads {FORMAT_VERSION}")
        if counts.shape != (LINK_COUNT,) or counts.min() < 0 or counts.max() > MAX_POINTS_PER_LINK:
            raise ValueError(f"body model: point counts of {counts.shape} links do not fit {LINK_COUNT} links")
        if (
            sums.shape != (int(counts.sum()), COLUMNS)
            or not np.isfinite(sums).all()
            or np.abs(sums).max(initial=0) > 1e6
        ):
            raise ValueError(f"body model: points {sums.shape} do not match their counts or are not finite")
        if len(sums) and sums[:, COUNT].min() <= 0:
            raise ValueError("body model: a point without observations")
        try:
            body = cls(Skeleton(offsets, tips, radii))
        except (ValueError, TypeError) as error:
            raise ValueError(f"body model: {error}") from error
        ends = np.cumsum(counts)
        for cells, end, count in zip(body._cells, ends, counts, strict=True):
            cells.restore(sums[end - count : end].astype(np.float64))
        return body


class _LinkSurface(NamedTuple):
    """A link's grid, and the tints (M, 2) float32 of its M points."""

    grid: LinkGrid
    tints: Array


def _read_archive(data: bytes) -> tuple[Array, ...]:
    if len(data) > MAX_BYTES:
        raise ValueError(f"body model: {len(data)} bytes, at most {MAX_BYTES}")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > 4 * MAX_BYTES:
                raise ValueError("body model: unpacks to more than is plausible")
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            return tuple(stored[name] for name in ("version", "offsets", "tips", "radii", "counts", "sums"))
    except ValueError:
        raise
    except Exception as error:  # zipfile, zlib, struct and numpy each have their own way to say "broken"
        raise ValueError(f"body model: not a readable archive ({type(error).__name__}: {error})") from error


def _join(links: list[_LinkSurface], match_colours: bool) -> Surface:
    grids = [link.grid for link in links]
    counts = np.array([len(grid.points) for grid in grids])
    cells = np.array([grid.nearest.size for grid in grids])
    low, high = np.ones((LINK_COUNT, 3), np.float32), np.zeros((LINK_COUNT, 3), np.float32)
    for link, grid in enumerate(grids):
        if len(grid.points):
            low[link], high[link] = grid.low, grid.high
    return Surface(
        points=np.concatenate([grid.points for grid in grids]),
        normals=np.concatenate([grid.normals for grid in grids]),
        first_point=np.cumsum(counts) - counts,
        origin=np.stack([grid.origin for grid in grids]),
        shape=np.array([grid.nearest.shape[1:] for grid in grids], np.int64),
        cells_per_m=np.array([1.0 / grid.cell_m for grid in grids], np.float32),
        first_cell=np.cumsum(cells) - cells,
        nearest=np.concatenate([grid.nearest.ravel() for grid in grids]),
        low=low,
        high=high,
        spacing2_m2=np.array([grid.spacing2_m2 for grid in grids], np.float32),
        tints=np.concatenate([link.tints for link in links]) if match_colours else np.empty((0, 2), np.float32),
    )


def _movers() -> Array:
    movers = np.arange(LINK_COUNT)
    for side in ("left", "right"):
        for tip, link in _UNSPLIT.items():
            movers[LINK_INDEX[f"{side}_{tip}"]] = LINK_INDEX[f"{side}_{link}"]
    return movers


def _joined() -> Array:
    joined = np.zeros((LINK_COUNT, LINK_COUNT), bool)
    for link, parent in enumerate(LINK_PARENTS[1:], start=1):
        joined[link, parent] = joined[parent, link] = True
    return joined


_MOVER, _JOINED = _movers(), _joined()


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_bones(points: Array, starts: Array, ends: Array, radii: Array) -> tuple[Array, Array, Array, Array]:
    """Nearest and second nearest bone (N,), (N,) int64 of ``points`` (N, 3) [m, world] by distance ÷ radius, that
    distance [radii] (N,), and the ratio (N,) of the two distances; ``starts, ends`` (L, 3) [m, world], ``radii`` (L,)
    [m]."""
    first, second = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    near, ratio = np.empty(len(points)), np.empty(len(points))
    for n in range(len(points)):
        best, next_best = np.inf, np.inf
        first[n] = second[n] = 0
        for link in range(len(radii)):
            along, length, d = 0.0, 1e-12, 0.0
            for i in range(3):
                bone = ends[link, i] - starts[link, i]
                along += bone * (points[n, i] - starts[link, i])
                length += bone * bone
            along = min(max(along / length, 0.0), 1.0)
            for i in range(3):
                off = points[n, i] - starts[link, i] - along * (ends[link, i] - starts[link, i])
                d += off * off
            d = np.sqrt(d) / radii[link]
            if d < best:
                best, next_best, second[n], first[n] = d, best, first[n], link
            elif d < next_best:
                next_best, second[n] = d, link
        near[n] = best
        ratio[n] = next_best / max(best, 1e-6)
    return first, second, near, ratio
