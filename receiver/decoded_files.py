"""What a played session becomes: a video, or a folder of pictures or of persons, one for each display tick."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_PARENTS
from common.body.skinning import Skinning
from common.geometry.camera_model import Camera, project
from common.geometry.rigid_transform import look_at
from receiver.viewer.offscreen_viewer import OffscreenViewer
from receiver.viewer.page_messages import encode_frame, encode_hello, encode_pose, encode_remove
from receiver.viewer.page_view import PageView
from receiver.viewer.person_files import ExportError, write_person, write_points
from receiver.viewer.viewer import NullViewer, ShownFrame, Viewer, ViewerStatus, ViewMode

if TYPE_CHECKING:
    from common.body.link_points import LinkPoints
    from common.body.rigged_mesh import RiggedMesh

log = logging.getLogger(__name__)

DISTANCE_M, EYE_HEIGHT_M, SEEN_HEIGHT_M = 3.5, 1.2, 1.0
NEAR_M = 0.1
BONE_COLOUR = (140, 110, 90)
FOCAL_OF_HEIGHT = 7 / 6  # wide enough for a person with raised arms


class Output(Protocol):
    """``viewer`` is shown the session; ``write`` keeps what it shows at a tick; ``finish`` says what was made of it,
    ``discard`` leaves nothing unfinished behind."""

    @property
    def viewer(self) -> Viewer: ...
    def write(self, tick: int) -> None: ...
    def finish(self) -> str: ...
    def discard(self) -> None: ...


def camera_before(pelvis: NDArray[np.floating], width: int, height: int, angle_deg: float) -> Camera:
    """Sees a person whose pelvis (3,) [m, world] is there, whole, from ``angle_deg`` to the left of their front."""
    angle = np.deg2rad(angle_deg)
    target = np.array([pelvis[0], SEEN_HEIGHT_M, pelvis[2]], np.float64)
    eye = target + DISTANCE_M * np.array([np.sin(angle), 0, np.cos(angle)])
    eye[1] = EYE_HEIGHT_M
    focal = FOCAL_OF_HEIGHT * height
    return Camera("decoded", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, look_at(eye, target))


class _Pictures:
    """The person rendered offscreen on white, as bones while there is no mesh (or no points) to show; the camera stands
    before where they are first seen."""

    def __init__(self, width: int, height: int, angle_deg: float, skinning: Skinning, mode: ViewMode) -> None:
        self.viewer = OffscreenViewer(skinning, mode)
        self.pictures = self.bones_only = 0
        self._size = width, height
        self._angle_deg = angle_deg
        self._camera: Camera | None = None

    def _picture(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 BGR."""
        self.pictures += 1
        newest = self.viewer.newest
        if newest is None:
            self.bones_only += 1
            return np.full((*self._size[::-1], 3), 255, np.uint8)
        if self._camera is None:
            self._camera = camera_before(newest.joints[0], *self._size, self._angle_deg)
        ((colour, _),) = self.viewer.render([self._camera])
        picture = np.ascontiguousarray(colour[..., ::-1])
        if self.viewer.frame is None:
            self.bones_only += 1
            draw_bones(picture, newest.joints, self._camera)
        return picture

    def _words(self) -> str:
        bones = f", {self.bones_only} of them of bones alone" if self.bones_only else ""
        return f"{self.pictures} pictures{bones}"


def draw_bones(picture: NDArray[np.uint8], joints: NDArray[np.floating], camera: Camera) -> None:
    """Lines between joints (L, 3) [m, world] that belong together, into a picture (H, W, 3)."""
    pixels, z = project(camera, joints)
    for link, parent in enumerate(LINK_PARENTS):
        if parent >= 0 and min(z[link], z[parent]) > NEAR_M:
            ends = [tuple(round(value * 16) for value in pixels[joint]) for joint in (parent, link)]
            cv2.line(picture, ends[0], ends[1], BONE_COLOUR, 2, cv2.LINE_AA, 4)


class VideoFile(_Pictures):
    """An MPEG-4 video, under a temporary name until it is whole.

    Raises:
        ExportError: it cannot be written.
    """

    def __init__(
        self,
        file: Path,
        rate_hz: float,
        width: int,
        height: int,
        angle_deg: float,
        skinning: Skinning,
        mode: ViewMode = "mesh",
    ) -> None:
        super().__init__(width, height, angle_deg, skinning, mode)
        self._file = file
        self._unfinished = file.with_name(f"{file.stem}.part{file.suffix}")
        _check_writable(self._unfinished)
        code = cv2.VideoWriter.fourcc(*"mp4v")
        self._video = cv2.VideoWriter(str(self._unfinished), code, rate_hz, (width, height))
        if not self._video.isOpened():
            raise ExportError(f"cannot write {file}: OpenCV here makes no MPEG-4 video")

    def write(self, tick: int) -> None:
        """The picture of a tick."""
        self._video.write(self._picture())

    def finish(self) -> str:
        """The video is whole."""
        self._video.release()
        os.replace(self._unfinished, self._file)
        return f"{self._file}: {self._words()}"

    def discard(self) -> None:
        """Nothing was worth keeping."""
        self._video.release()
        self._unfinished.unlink(missing_ok=True)


class PictureFolder(_Pictures):
    """``000000.png`` …

    Raises:
        ExportError: the folder is not empty or cannot be made.
    """

    def __init__(
        self, folder: Path, width: int, height: int, angle_deg: float, skinning: Skinning, mode: ViewMode = "mesh"
    ) -> None:
        super().__init__(width, height, angle_deg, skinning, mode)
        self._folder = _empty_folder(folder)

    def write(self, tick: int) -> None:
        """The picture of a tick.

        Raises:
            ExportError: it cannot be written.
        """
        file = self._folder / f"{tick:06d}.png"
        if not cv2.imwrite(str(file), self._picture()):
            raise ExportError(f"cannot write {file}")

    def finish(self) -> str:
        """What there is."""
        return f"{self._folder}: {self._words()}"

    def discard(self) -> None:
        """Every file is whole."""


class PersonFolder:
    """``000000.ply`` … or ``.glb``: the person as ``telepose-receive export`` writes them; ticks without one are left
    out.

    Raises:
        ExportError: the folder is not empty or cannot be made.
    """

    def __init__(self, folder: Path, suffix: str, skinning: Skinning) -> None:
        self.viewer = _PageReader(skinning)
        self._folder = _empty_folder(folder)
        self._suffix = suffix
        self._persons = self._ticks = 0

    def write(self, tick: int) -> None:
        """The person at a tick.

        Raises:
            ExportError: it cannot be written.
        """
        self._ticks += 1
        person = self.viewer.view.person
        if person is not None:
            write_person(self._folder / f"{tick:06d}{self._suffix}", person)
            self._persons += 1

    def finish(self) -> str:
        """What there is."""
        return f"{self._folder}: {self._persons} persons, of {self._ticks} instants"

    def discard(self) -> None:
        """Every file is whole."""


class PointFolder:
    """``000000.ply`` …: the person as coloured points; ticks without any are left out.

    Raises:
        ExportError: the folder is not empty or cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.viewer = _NewestPoints()
        self._folder = _empty_folder(folder)
        self._clouds = self._ticks = 0

    def write(self, tick: int) -> None:
        """The points at a tick.

        Raises:
            ExportError: they cannot be written.
        """
        self._ticks += 1
        points, frame = self.viewer.points, self.viewer.frame
        if points is not None and frame is not None and frame.links is not None:
            write_points(self._folder / f"{tick:06d}.ply", points.posed(frame.links), points.colours)
            self._clouds += 1

    def finish(self) -> str:
        """What there is."""
        return f"{self._folder}: {self._clouds} clouds of points, of {self._ticks} instants"

    def discard(self) -> None:
        """Every file is whole."""


class _NewestPoints(NullViewer):
    """A viewer that knows the newest points and the frame that moves them."""

    def __init__(self) -> None:
        self.points: LinkPoints | None = None
        self.frame: ShownFrame | None = None

    def show_points(self, points: LinkPoints | None) -> None:
        self.points = points

    def show(self, frame: ShownFrame) -> None:
        self.frame = frame


class _PageReader:
    """A viewer that shows what a browser's page is told, to a ``PageView``."""

    def __init__(self, skinning: Skinning) -> None:
        self.view = PageView()
        self.view.take_text(encode_hello(skinning))

    def add_pose(self, mesh: RiggedMesh) -> None:
        try:
            self.view.take(encode_pose(mesh))
        except ValueError as error:  # a mesh that no page could show either
            log.warning("a pose is not shown: %s", error)

    def remove_pose(self, pose_id: int) -> None:
        self.view.take(encode_remove(pose_id))

    def show_points(self, points: LinkPoints | None) -> None:
        """Meshes are what is shown here."""

    def show(self, frame: ShownFrame) -> None:
        self.view.take(encode_frame(frame))

    def set_status(self, status: ViewerStatus) -> None:
        """Figures are of no use here."""


def _empty_folder(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise ExportError(f"{folder}: not empty")
    except OSError as error:
        raise ExportError(f"cannot write into {folder}: {error.strerror}") from error
    return folder


def _check_writable(file: Path) -> None:
    """OpenCV does not say why it cannot write."""
    try:
        file.open("wb").close()
    except OSError as error:
        raise ExportError(f"cannot write {file}: {error.strerror}") from error
