"""Residual maps on the receiver: packets → the newest maps → the person's points in any pose (Lien §5.2).

Maps lie in the links' own frames, so points follow a skeleton that is newer than they are. Whatever level they come at,
they are interpolated to the full grid: splats of one size close the surface at every level.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.body.cylindrical_map import LinkMaps, resampled, unproject, unproject_to_links
from common.body.link_points import LinkPoints
from common.body.map_layout import LEVEL_MAX, POINTS_MAX, MapLayout, map_layout
from common.body.skeleton import Skeleton
from common.geometry.point_cloud import PointCloud
from common.wire.header import WireError
from common.wire.map_codec import reference_of
from common.wire.residual_packet import ALONE, ResidualHeader, decode_residual, decode_residual_header
from common.wire.residual_video import decode_group


@dataclass(frozen=True, slots=True, eq=False)
class ResidualMaps:
    """The maps of one frame, with the body they are of."""

    header: ResidualHeader
    skeleton: Skeleton
    layout: MapLayout
    maps: LinkMaps


class ResidualDecoder:
    """One person's residual packets in the order they arrive. Packets that are late or whose reference is not here give
    nothing and are counted: ``late``, ``without_reference``."""

    def __init__(self, most_points: int = POINTS_MAX) -> None:
        self.newest: ResidualMaps | None = None
        self.late = 0
        self.without_reference = 0
        self._referred: tuple[ResidualMaps, LinkMaps] | None = None
        self._most_points = most_points

    def decode(self, data: bytes, bodies: Mapping[int, Skeleton]) -> list[ResidualMaps]:
        """The maps of a packet, one frame's or a group's in order; the last are then ``newest``. ``bodies``: skeletons
        by body revision of the packet's epoch.

        [] where there is nothing newer to show: the packet is late, its body is not known, or the packet it refers to
        is not here; the next key, within a second, helps.

        Raises:
            WireError: not a packet, or of more points than ``most_points``; PyAV is not installed, for a video.
        """
        header = decode_residual_header(data)
        if header.points > self._most_points:
            raise WireError(f"residual packet: for {header.points} points, at most {self._most_points} are allowed")
        newest = self.newest
        if newest is not None and newest.header.epoch == header.epoch and header.sequence <= newest.header.sequence:
            self.late += 1
            return []
        skeleton = bodies.get(header.body_revision)
        reference = self._reference(header, skeleton)
        if skeleton is None or (reference is None and header.kind not in ALONE):
            self.without_reference += 1
            return []
        layout = header.layout(skeleton)
        if header.kind == "video":
            found = [ResidualMaps(own, skeleton, layout, maps) for own, maps in decode_group(data, layout)]
        else:
            found = [ResidualMaps(header, skeleton, layout, decode_residual(data, layout, reference))]
        self.newest = found[-1]
        if header.kind in ("key", "previous"):
            self._referred = self.newest, reference_of(self.newest.maps)
        return found

    def _reference(self, header: ResidualHeader, skeleton: Skeleton | None) -> LinkMaps | None:
        """What a packet is the difference from, if it is here."""
        if header.kind in ALONE or self._referred is None:
            return None
        known, maps = self._referred
        refers = (known.header.epoch, known.header.sequence, known.header.points, known.header.level)
        wanted = (header.epoch, header.reference, header.points, header.level)
        return maps if refers == wanted and known.skeleton is skeleton else None


def cloud(shown: ResidualMaps, T_world_link: NDArray[np.float32]) -> PointCloud:
    """The person's points, as dense at every level, moved to the links ``T_world_link`` (L, 4, 4) of any pose of the
    same body. Normals are the directions away from the bones."""
    return PointCloud(*unproject(*at_level(shown, LEVEL_MAX), T_world_link))


def link_points(shown: ResidualMaps) -> LinkPoints:
    """The same points on their links: worked out once, moved by every skeleton."""
    return unproject_to_links(*at_level(shown, LEVEL_MAX))


def at_level(shown: ResidualMaps, level: float) -> tuple[MapLayout, LinkMaps]:
    """The same surface on the grids of another ``level``."""
    other = map_layout(shown.skeleton, shown.header.points, level)
    return other, shown.maps if shown.layout is other else resampled(shown.layout, shown.maps, other)
