"""From a set of frames to the points of the person in it: by depth cameras, or by silhouettes of colour cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from common.body.view import View
from common.geometry.camera_model import Camera
from common.geometry.point_cloud import PointCloud
from common.runtime.stage_timer import StageTimer
from sender.capture.frame_set import ColourFrame, DepthFrame, FrameSet
from sender.reconstruction.background import BackgroundModel
from sender.reconstruction.foreground_points import PointSampler
from sender.reconstruction.hull_people import PersonFollower
from sender.reconstruction.hull_points import surface_points, volume_points
from sender.reconstruction.silhouette import SilhouetteModel, SilhouetteSettings
from sender.reconstruction.visual_hull import VisualHull

LONGEST_S = 0.3  # after a longer gap somebody is looked for no farther
MOST_POINTS = 4  # times the budget, when the person is only a part of the hull


@dataclass(frozen=True, slots=True, eq=False)
class PersonPoints:
    """``cloud``: the person's points. ``views``: what candidate poses are made of; none without depth.
    ``certainty``: 0..1, that the cloud is one person's and a real one's."""

    cloud: PointCloud
    views: tuple[View, ...] = ()
    certainty: float = 1.0


class Reconstruction(Protocol):
    """``last_joints`` (J, 3) [m, world]: where the tracker last saw the person, if it did."""

    def person(self, frames: FrameSet, last_joints: NDArray[np.floating] | None, timer: StageTimer) -> PersonPoints: ...


class DepthReconstruction:
    """Depth cameras: what stands before the background, sampled."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        empty_room: Sequence[NDArray[Any] | None],
        points: int = 2500,
        room_colour: Sequence[NDArray[np.uint8] | None] | None = None,
    ) -> None:
        pictures = (None,) * len(cameras) if room_colour is None else room_colour
        rooms = zip(cameras, empty_room, pictures, strict=True)
        self._backgrounds = [BackgroundModel(camera, room, room_colour=picture) for camera, room, picture in rooms]
        self._sampler = PointSampler(cameras, points)

    def person(self, frames: FrameSet, last_joints: NDArray[np.floating] | None, timer: StageTimer) -> PersonPoints:
        """See ``Reconstruction``; the whole foreground is the person."""
        with timer.stage("background"):
            pairs = zip(self._backgrounds, frames.frames, strict=True)
            found = [background.foreground(frame) for background, frame in pairs if isinstance(frame, DepthFrame)]
            views = tuple(view for view in found if view is not None)
        with timer.stage("points"):
            return PersonPoints(self._sampler.points(views), views)


class HullReconstruction:
    """Colour cameras: the visual hull of their silhouettes, and in it the one person that is followed.

    ``empty_room``: (F, H, W, 3) per camera, or None where frames bring silhouettes. ``inside``: once there is a pose,
    points in the hull's volume, as particles want them; else, and until then, on its surface, with normals.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        empty_room: Sequence[NDArray[Any] | None],
        points: int = 2500,
        inside: bool = False,
        settings: SilhouetteSettings | None = None,
    ) -> None:
        rooms = zip(cameras, empty_room, strict=True)
        self._models = [SilhouetteModel(camera, room, settings) for camera, room in rooms]
        self._points = points
        self._inside = inside
        self._follower = PersonFollower()
        self._share = 1 / MOST_POINTS  # of the hull's points that were the person's; at first there may be many people
        self._last_ns = 0

    def person(self, frames: FrameSet, last_joints: NDArray[np.floating] | None, timer: StageTimer) -> PersonPoints:
        """See ``Reconstruction``. Cameras whose frame is missing do without; from fewer than two nothing is seen."""
        with timer.stage("silhouettes"):
            pairs = zip(self._models, frames.frames, strict=True)
            silhouettes = [model.silhouette(frame) for model, frame in pairs if isinstance(frame, ColourFrame)]
        if len(silhouettes) < 2:
            empty = np.zeros((0, 3), np.float32)
            return PersonPoints(PointCloud(empty, empty, empty.astype(np.uint8)), certainty=0.0)
        with timer.stage("hull"):
            hull = VisualHull(silhouettes)
            sampled = volume_points if self._inside and last_joints is not None else surface_points
            cloud = sampled(hull, int(self._points / self._share))
        with timer.stage("person"):
            since_s = float(np.clip((frames.capture_ns - self._last_ns) / 1e9, 0.0, LONGEST_S))
            self._last_ns = frames.capture_ns
            found = self._follower.find(cloud, hull.cameras, last_joints, since_s)
            mine = np.flatnonzero(found.chosen)
            self._share = float(np.clip(len(mine) / max(len(cloud), 1), 1 / MOST_POINTS, 1.0))
            if len(mine) > self._points:
                mine = mine[np.arange(self._points) * len(mine) // self._points]
            person = PointCloud(cloud.positions[mine], cloud.normals[mine], cloud.colours[mine])
        return PersonPoints(person, certainty=found.certainty)
