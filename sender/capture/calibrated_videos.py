"""Colour cameras calibrated with a board on the floor, as Utrecht University's computer vision course records them.

``calibration.json`` gives, by camera, ``K``, ``dist_k1k2p1p2k3``, ``R_world_to_cam`` and ``t_world_to_cam_mm``: world
in millimetres, z up, the board at z = 0. Beside it lies a folder per camera with ``video.avi``, or ready silhouettes
``silhouette/NNNN.png``, and ``background.avi``, the empty room. Here the world is in metres, y up.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from common.geometry.rigid_transform import inverse, rigid_transform
from sender.capture.frame_set import CaptureError
from sender.capture.recording_folder import read_json

_ROOM_FRAMES = 50  # of the empty room, spread over its video, that are kept
_SKIPPED = 20  # frames at most are passed over one by one; farther on it is quicker to seek
_MOST_FRAMES = 1_000_000
# x stays, z becomes y, y becomes −z
_Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


class CalibratedVideos:
    """A recording of such a rig; silhouettes go before videos where both are there.

    Raises:
        CaptureError: a file or a field is missing or malformed; the message names it.
    """

    has_depth = False
    start_joints = None

    def __init__(self, path: Path) -> None:
        file = path / "calibration.json"
        content = read_json(file)
        try:
            self.frame_rate_hz = float(content["fps"])
            if not 0.1 <= self.frame_rate_hz <= 1000:
                raise ValueError(f"{self.frame_rate_hz} frames a second")
            width, height = (int(size) for size in content["image_size"])
            self.cameras = tuple(_camera(name, width, height, of) for name, of in content["cameras"].items())
            if not self.cameras:
                raise ValueError("no cameras")
        except KeyError as error:
            raise CaptureError(f"{file}: {error} is missing") from None
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            raise CaptureError(f"{file}: {error}") from None
        self._images = [_images(path / camera.name, camera) for camera in self.cameras]
        self.empty_room: tuple[NDArray[np.uint8] | None, ...] = tuple(
            None if isinstance(images, _Silhouettes) else _room(path / camera.name / "background.avi", camera)
            for images, camera in zip(self._images, self.cameras, strict=True)
        )
        self.room_colour = (None,) * len(self.cameras)
        numbers = [(number, camera) for camera, images in enumerate(self._images) for number in images.numbers]
        first = min(numbers)[0]
        self.frames = tuple((round((n - first) * 1e9 / self.frame_rate_hz), camera, n) for n, camera in sorted(numbers))

    def load(self, camera_index: int, number: int) -> tuple[NDArray[np.uint8] | None, NDArray[np.uint8] | None]:
        """See ``recorded_rig.Recording``."""
        return self._images[camera_index].load(number)


class _Video:
    """Frames of a video file, by number; in order they are cheap."""

    def __init__(self, file: Path, camera: Camera) -> None:
        self._file = file
        self._lock = threading.Lock()  # several threads decode ahead
        video = cv2.VideoCapture(str(file)) if file.is_file() else None
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video is not None else 0
        if video is None or not 0 < count < _MOST_FRAMES:
            raise CaptureError(f"{file}: no video with frames")
        width, height = (int(video.get(what)) for what in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if (width, height) != (camera.width, camera.height):
            raise CaptureError(f"{file}: {width}×{height}, not {camera.width}×{camera.height}")
        self._video = video
        self._next = sum(1 for _ in iter(video.grab, False))  # a header may promise more than there are
        if self._next == 0:
            raise CaptureError(f"{file}: no frame can be decoded")
        self.numbers = range(self._next)

    def load(self, number: int) -> tuple[None, NDArray[np.uint8]]:
        with self._lock:
            if not self._next <= number <= self._next + _SKIPPED:
                self._video.set(cv2.CAP_PROP_POS_FRAMES, number)
                self._next = number
            for _ in range(number - self._next):
                self._video.grab()
            there, picture = self._video.read()
            self._next = number + 1
        if not there:
            raise CaptureError(f"{self._file}: no frame {number}")
        return None, np.ascontiguousarray(picture[..., ::-1], np.uint8)


class _Silhouettes:
    """Images ``NNNN.png``, white where people are."""

    def __init__(self, folder: Path, camera: Camera) -> None:
        self._files = {int(file.stem): file for file in folder.glob("*.png") if file.stem.isdigit()}
        if not self._files:
            raise CaptureError(f"{folder}: no silhouettes NNNN.png")
        self._camera = camera
        self.numbers = sorted(self._files)

    def load(self, number: int) -> tuple[NDArray[np.uint8], None]:
        file = self._files[number]
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None or image.shape != (self._camera.height, self._camera.width):
            raise CaptureError(f"{file}: not an image of {self._camera.width}×{self._camera.height}")
        return np.asarray(image, np.uint8), None


def _images(folder: Path, camera: Camera) -> _Video | _Silhouettes:
    silhouettes = folder / "silhouette"
    return _Silhouettes(silhouettes, camera) if silhouettes.is_dir() else _Video(folder / "video.avi", camera)


def _room(file: Path, camera: Camera) -> NDArray[np.uint8]:
    """Frames (F, H, W, 3) uint8 RGB."""
    video = _Video(file, camera)
    return np.stack([video.load(n)[1] for n in video.numbers[:: -(-len(video.numbers) // _ROOM_FRAMES) or 1]])


def _camera(name: str, width: int, height: int, record: dict[str, Any]) -> Camera:
    matrix, rotation = np.array(record["K"], float), np.array(record["R_world_to_cam"], float)
    along_mm, distortion = np.array(record["t_world_to_cam_mm"], float), np.array(record["dist_k1k2p1p2k3"], float)
    if matrix.shape != (3, 3) or rotation.shape != (3, 3) or along_mm.shape != (3,):
        raise ValueError(f"camera {name}: K, R_world_to_cam or t_world_to_cam_mm has the wrong size")
    if Path(name).name != name or name in ("", ".", ".."):
        raise ValueError(f"camera {name!r} is not a folder's name")
    pose = _Y_UP_FROM_Z_UP @ inverse(rigid_transform(rotation, along_mm / 1000))
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(name, width, height, fx, fy, cx, cy, np.asarray(pose, np.float64), distortion)
