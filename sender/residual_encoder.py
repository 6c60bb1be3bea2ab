"""Residual maps on the sender: a frame's points → the packet that shows them (Lien §5.2), at any level of 0 to 100 %.

Packets come in groups: a key, then differences from it (the model P_l of §5.2 as maps, which the receiver so has
without another message) or each from the one before. A group keeps its level; a new one begins every second, when the
body changes, when the level has moved by a tenth, or on request. So whatever is lost heals within a second, and who
joins late needs nothing older than a key. At level 0 the model is sent once, and on request: the skeleton moves it.

Or (``video_frames``) N frames at a time go as one packet, coded as a video, when the last of them is there: fewer
bytes, N frames later. Each such group is by itself, with a level of its own.

Rate: what a frame takes grows as level^0.7, measured from 10 to 100 %; ``LevelControl`` follows the factor and turns
a budget in bytes into a level.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from common.body.cylindrical_map import LinkMaps, closed, project_points
from common.body.link_segmentation import nearest_link
from common.body.map_layout import LEVEL_MAX, LEVEL_MIN, MapLayout
from common.body.skeleton import Skeleton
from common.geometry.point_cloud import PointCloud
from common.wire.map_codec import MapQuality, reference_of
from common.wire.residual_packet import ResidualHeader, decode_residual, encode_residual
from common.wire.residual_video import GroupFrame, encode_group

MODEL_LEVEL = 100.0  # of the model that is sent at level 0
KEPT_WITHIN = 1.1  # a group's level as long as the wanted one differs by no more than this factor
_JPEG_LOW, _JPEG_HIGH = 50, 70  # at level 0 and 100 %
_RADIUS_STEPS = 3  # 6 mm, off by at most 3: finer steps code the sensors' noise
_EXPONENT = 0.7
_BYTES_AT_FULL = 10_000.0  # before any frame was coded
LONGEST_GROUP_NS = 2_000_000_000  # a pause ends a group
_MEMORY = 0.1  # weight of the newest frame in the factor


@dataclass(frozen=True, slots=True)
class ResidualSettings:
    """``points``: of a frame, what the full grids are sized for; ``reference``: what differences are taken from;
    ``key_interval_s``: the first frame so long after a key is one, which at 20 fps or more is within a second;
    ``radius_coding``: "huffman" or "png". ``video_frames``: so many frames in one packet, 0: each has its own."""

    points: int = 10_000
    reference: Literal["model", "previous"] = "model"
    key_interval_s: float = 0.95
    radius_coding: str = "huffman"
    video_frames: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class ResidualFrame:
    """What one packet is made of. ``skeleton``: the body of ``body_revision`` as the receiver decodes it;
    ``T_world_link`` (L, 4, 4): its links in the decoded pose of skeleton packet ``skeleton_sequence``; ``cloud``: the
    person's points of the same instant ``capture_ns`` [ns], in the world."""

    skeleton: Skeleton
    body_revision: int
    T_world_link: NDArray[np.float32]
    skeleton_sequence: int
    capture_ns: int
    cloud: PointCloud


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """The key a group began with, and the packet its next one refers to."""

    key: ResidualHeader
    skeleton: Skeleton
    reference: int
    reference_maps: LinkMaps


@dataclass(frozen=True, slots=True, eq=False)
class _Gathered:
    """The frames that are to go together so far; ``header``: the first one's."""

    header: ResidualHeader
    skeleton: Skeleton
    frames: list[GroupFrame]


class ResidualEncoder:
    """One person's residual packets in one run (``epoch``) of the sender; numbers them."""

    def __init__(self, person: int, epoch: int, settings: ResidualSettings | None = None) -> None:
        self._person = person
        self._epoch = epoch
        self._settings = settings or ResidualSettings()
        self._sequence = 0
        self._group: _Group | None = None
        self._gathered: _Gathered | None = None
        self._key_wanted = False

    def request_key(self) -> None:
        """The next packet is a key: somebody joined, or said that a key was lost."""
        self._key_wanted = True

    def encode(self, frame: ResidualFrame, level: float, together: bool = True) -> bytes | None:
        """The packet of a frame at ``level`` 0..100 % (below ``LEVEL_MIN`` is 0); None where there is nothing to send:
        no points, level 0 and the model is sent, or a group not yet complete. ``together``: frames may go in groups.

        Raises:
            WireError: more points or bytes than a packet can have, or a number outside its range.
            VideoUnavailable: ``video_frames`` are asked for, and PyAV is not installed.
        """
        level = round(min(float(level), LEVEL_MAX), 2)
        if self._settings.video_frames and together and level >= LEVEL_MIN:
            return self._gather(frame, level) if len(frame.cloud) else None
        self._gathered = None
        group = self._group if self._goes_on(frame, level) else None
        if len(frame.cloud) == 0 or (group is not None and level < LEVEL_MIN):
            return None
        kind: Literal["key", "model", "previous"] = "key" if group is None else self._settings.reference
        if group is not None:
            level = group.key.level
        elif level < LEVEL_MIN:
            level = MODEL_LEVEL
        header = ResidualHeader(
            self._person, self._epoch, self._sequence, kind,
            self._sequence if group is None else group.reference,
            frame.skeleton_sequence, frame.body_revision, frame.capture_ns, self._settings.points, level,
            quality_at(level, self._settings.radius_coding),
        )  # fmt: skip
        data = self._packet(header, frame, group)
        self._sequence += 1
        self._key_wanted = False
        return data

    def _goes_on(self, frame: ResidualFrame, level: float) -> bool:
        """Whether the frame belongs to the present group."""
        group = self._group
        if group is None or self._key_wanted or group.skeleton is not frame.skeleton:
            return False
        if group.key.body_revision != frame.body_revision:
            return False
        if level < LEVEL_MIN:
            return True
        old = frame.capture_ns - group.key.capture_ns >= self._settings.key_interval_s * 1e9
        return not old and 1 / KEPT_WITHIN <= level / group.key.level <= KEPT_WITHIN

    def _packet(self, header: ResidualHeader, frame: ResidualFrame, group: _Group | None) -> bytes:
        layout = header.layout(frame.skeleton)
        maps = _maps_of(frame, layout)
        reference = None if group is None else group.reference_maps
        data = encode_residual(header, layout, maps, reference)
        if group is None or header.kind == "previous":  # what the receiver has: differences must not add up errors
            key = header if group is None else group.key
            received = reference_of(decode_residual(data, layout, reference))
            self._group = _Group(key, frame.skeleton, header.sequence, received)
        return data

    def _gather(self, frame: ResidualFrame, level: float) -> bytes | None:
        """The packet of a group that the frame completes, or of the one before, to which it does not belong."""
        packet = None if self._is_next(frame) else self._packet_of_gathered()
        if self._gathered is None:
            header = ResidualHeader(
                self._person, self._epoch, self._sequence, "video", self._sequence, frame.skeleton_sequence,
                frame.body_revision, frame.capture_ns, self._settings.points, level, video_quality_at(level),
            )  # fmt: skip
            self._gathered = _Gathered(header, frame.skeleton, [])
        maps = _maps_of(frame, self._gathered.header.layout(frame.skeleton))
        self._gathered.frames.append(GroupFrame(frame.capture_ns, frame.skeleton_sequence, maps))
        self._sequence += 1
        return self._packet_of_gathered() if len(self._gathered.frames) >= self._settings.video_frames else packet

    def _is_next(self, frame: ResidualFrame) -> bool:
        """Whether the frame belongs to those gathered."""
        gathered = self._gathered
        if gathered is None or gathered.skeleton is not frame.skeleton:
            return False
        same_body = gathered.header.body_revision == frame.body_revision
        return same_body and frame.capture_ns - gathered.header.capture_ns < LONGEST_GROUP_NS

    def _packet_of_gathered(self) -> bytes | None:
        gathered, self._gathered, self._key_wanted = self._gathered, None, False
        if gathered is None:
            return None
        return encode_group(gathered.header, gathered.header.layout(gathered.skeleton), gathered.frames)


def _maps_of(frame: ResidualFrame, layout: MapLayout) -> LinkMaps:
    cloud = frame.cloud
    links = nearest_link(cloud.positions, frame.skeleton, frame.T_world_link)
    return closed(layout, project_points(layout, frame.T_world_link, links, cloud.positions, cloud.colours))


def quality_at(level: float, radius_coding: str = "huffman") -> MapQuality:
    """How finely maps are coded at a level [%]."""
    jpeg = round(_JPEG_LOW + (_JPEG_HIGH - _JPEG_LOW) * level / LEVEL_MAX)
    return MapQuality(jpeg, _RADIUS_STEPS, radius_coding)


def video_quality_at(level: float) -> MapQuality:
    """The same for frames coded as video: finer cells before finer radii, which a video blurs by the same byte."""
    return MapQuality(quality_at(level).jpeg, round(4 - 2 * level / LEVEL_MAX))


class LevelControl:
    """The level that fills a budget of bytes a frame."""

    def __init__(self) -> None:
        self._factor = _BYTES_AT_FULL / LEVEL_MAX**_EXPONENT

    def level(self, budget_bytes: float) -> float:
        """0..100 %: 0 where the budget is too small for any map."""
        level = float((max(budget_bytes, 0.0) / self._factor) ** (1 / _EXPONENT))
        return 0.0 if level < LEVEL_MIN else min(level, LEVEL_MAX)

    def coded(self, level: float, size_bytes: float, frames: int = 1) -> None:
        """Each of so many frames took so many bytes at ``level`` (of their packet's header, so not 0)."""
        weight = 1 - (1 - _MEMORY) ** frames
        self._factor += weight * (size_bytes / level**_EXPONENT - self._factor)
