"""Recordings as folders of images: our own format (docs/recordings.md) and a decoded Depthkit clip.

Per camera a folder with ``depth/NNNNNN.png`` (16 bit, mm, 0 = no reading) and ``color/NNNNNN.png`` or ``.jpg``, or
without depth; one JSON file says the rest.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import NAMED_JOINTS
from common.geometry.camera_model import Camera
from sender.capture.assumed_pose import assumed_pose
from sender.capture.camera_record import camera_from_record, camera_to_record
from sender.capture.frame_set import CaptureError, DepthFrame, Frame

FORMAT, VERSION = "telepose recording", 1
_LOOKED_AT = 10  # frames that an unknown camera pose is estimated from


@dataclass(frozen=True, slots=True)
class _CameraFolder:
    """The images of one camera; ``near_mm``, ``far_mm``: other readings are cut. ``kind``: the folder whose images
    are its frames, depth/, or without it mask/ or color/."""

    camera: Camera
    folder: Path
    near_mm: int
    far_mm: int
    kind: str

    def numbers(self) -> list[int]:
        """The frames there are, in order."""
        suffixes = (".png",) if self.kind == "depth" else (".png", ".jpg")
        files = [file for file in (self.folder / self.kind).iterdir() if file.suffix in suffixes]
        numbers = sorted({int(file.stem) for file in files if file.stem.isdigit()})
        if not numbers:
            raise CaptureError(f"{self.folder / self.kind}: no frames NNNNNN.png")
        return numbers

    def load(self, number: int) -> tuple[NDArray[Any] | None, NDArray[np.uint8] | None]:
        """Depth with cut and mask applied, or the mask alone of a camera without depth; and colour."""
        mask, colour = _find(self.folder / "mask", number), _find(self.folder / "color", number)
        first: NDArray[Any] | None = None
        if self.kind == "depth":
            first = self.depth(number)
        elif mask is not None:
            first = _read(mask, cv2.IMREAD_GRAYSCALE, self.camera)
        if colour is None:
            return first, None
        return first, read_colour(colour, self.camera)

    def depth(self, number: int) -> NDArray[np.uint16]:
        """Depth [mm] with cut and mask applied."""
        depth = read_depth(_numbered(self.folder / "depth", number, ".png"), self.camera)
        depth[(depth < self.near_mm) | (depth > self.far_mm)] = 0
        mask = _find(self.folder / "mask", number)
        if mask is not None:
            depth[_read(mask, cv2.IMREAD_GRAYSCALE, self.camera) < 128] = 0
        return depth


class RecordingFolder:
    """A recording in our own format.

    Raises:
        CaptureError: recording.json or the folders are not as docs/recordings.md says.
    """

    def __init__(self, path: Path) -> None:
        file = path / "recording.json"
        content = read_json(file)
        try:
            if content["format"] != FORMAT or content["version"] != VERSION:
                raise ValueError(f"not {FORMAT!r} version {VERSION}")
            self.frame_rate_hz = _frame_rate(content["frame_rate_hz"])
            self._folders = [_camera_folder(path, record) for record in content["cameras"]]
            if not self._folders:
                raise ValueError("no cameras")
            self.cameras = tuple(folder.camera for folder in self._folders)
            self.has_depth = _all_have_depth(self._folders)
            pairs = zip(self._folders, content["cameras"], strict=True)
            self.empty_room = tuple(_empty_room(path, record, folder) for folder, record in pairs)
            pairs = zip(self._folders, content["cameras"], strict=True)
            self.room_colour = tuple(_room_colour(path, record, folder) for folder, record in pairs)
            self.start_joints = _start_joints(content.get("start_joints"))
            times = [_times(f, r, self.frame_rate_hz) for f, r in zip(self._folders, content["cameras"], strict=True)]
        except KeyError as error:
            raise CaptureError(f"{file}: {error} is missing") from None
        except (ValueError, TypeError, OverflowError) as error:
            raise CaptureError(f"{file}: {error}") from None
        self.frames = _index(times)

    def load(self, camera_index: int, number: int) -> tuple[NDArray[Any] | None, NDArray[np.uint8] | None]:
        """See ``recorded_rig.Recording``."""
        return self._folders[camera_index].load(number)


class DepthkitFolder:
    """A decoded Depthkit clip of one camera: intrinsics.json, color/, depth/; its pose is assumed.

    Raises:
        CaptureError: a field or the frames are missing.
    """

    has_depth = True

    def __init__(self, path: Path) -> None:
        file = path / "intrinsics.json"
        content = read_json(file)
        try:
            record = {"name": path.name, "T_world_camera": np.eye(4), **content}
            if not np.isclose(float(content.get("depth_unit_m", 0.001)), 0.001):
                raise ValueError("depth_unit_m is not 0.001")
            self.frame_rate_hz = _frame_rate(content["fps"])
            folder = _camera_folder(path, record | {"folder": "."})
            numbers = folder.numbers()
            if folder.kind != "depth":
                raise ValueError("no folder depth/")
            looked_at = [folder.depth(number) for number in numbers[:: max(len(numbers) // _LOOKED_AT, 1)]]
            camera = folder.camera
            pose = assumed_pose(looked_at, camera.fx, camera.fy, camera.cx, camera.cy)
            self.cameras: tuple[Camera, ...] = (camera_from_record(record | {"T_world_camera": pose}),)
        except KeyError as error:
            raise CaptureError(f"{file}: {error} is missing") from None
        except (ValueError, TypeError, OverflowError) as error:
            raise CaptureError(f"{file}: {error}") from None
        self._folder = folder
        self.start_joints: NDArray[np.floating] | None = None
        self.empty_room: tuple[NDArray[np.uint16] | None, ...] = (None,)
        self.room_colour = (None,)
        self.frames = _index([{n: round((n - numbers[0]) * 1e9 / self.frame_rate_hz) for n in numbers}])

    def load(self, camera_index: int, number: int) -> tuple[NDArray[Any] | None, NDArray[np.uint8] | None]:
        """See ``recorded_rig.Recording``."""
        return self._folder.load(number)


def _start_joints(record: Any) -> NDArray[np.float64] | None:
    """Joints (16, 3) [m, world] by name.

    Raises:
        ValueError: a joint is missing, or is not three finite numbers.
    """
    if record is None:
        return None
    missing = [name for name, _ in NAMED_JOINTS if name not in record]
    if missing:
        raise ValueError(f"start_joints: {', '.join(missing)} missing")
    joints = np.array([record[name] for name, _ in NAMED_JOINTS], np.float64)
    if joints.shape != (len(NAMED_JOINTS), 3) or not np.isfinite(joints).all():
        raise ValueError("start_joints: a joint is not three finite numbers")
    return joints


def write_recording(
    path: Path,
    cameras: Sequence[Camera],
    frames: Iterable[Frame],
    frame_rate_hz: float,
    empty_room: Sequence[NDArray[Any] | None] = (),
    room_colour: Sequence[NDArray[np.uint8] | None] = (),
) -> None:
    """Write frames as a recording in our format into the new or empty folder ``path``; times are kept.

    Raises:
        CaptureError: the folder is not empty or cannot be written.
    """
    if path.exists() and any(path.iterdir()):
        raise CaptureError(f"{path}: not empty")
    records: list[dict[str, Any]] = []
    for index, camera in enumerate(cameras):
        records.append({**camera_to_record(camera), "folder": camera.name, "timestamps_ns": {}})
        room = empty_room[index] if index < len(empty_room) else None
        if room is not None:
            records[-1]["empty_room"] = f"{camera.name}/empty_room.png"
            _write(path / records[-1]["empty_room"], room if room.ndim == 2 else _reversed(room[0]))
        picture = room_colour[index] if index < len(room_colour) else None
        if picture is not None:
            records[-1]["room_colour"] = f"{camera.name}/room_colour.png"
            _write(path / records[-1]["room_colour"], _reversed(picture))
    start_ns: int | None = None
    for frame in frames:
        start_ns = frame.capture_ns if start_ns is None else start_ns
        record = records[frame.camera_index]
        record["timestamps_ns"][str(frame.sequence)] = frame.capture_ns - start_ns
        folder, file = path / record["folder"], f"{frame.sequence:06d}.png"
        if isinstance(frame, DepthFrame):
            _write(folder / "depth" / file, frame.depth_mm)
        elif frame.silhouette is not None:
            _write(folder / "mask" / file, frame.silhouette)
        if frame.colour is not None:
            _write(folder / "color" / file, _reversed(frame.colour))
    content = {"format": FORMAT, "version": VERSION, "frame_rate_hz": frame_rate_hz, "cameras": records}
    (path / "recording.json").write_text(json.dumps(content, indent=1))


def read_depth(file: Path, camera: Camera) -> NDArray[np.uint16]:
    """A depth image (H, W) uint16 [mm] of the camera's size.

    Raises:
        CaptureError: missing, corrupt, of another kind or size.
    """
    image = _read(file, cv2.IMREAD_UNCHANGED, camera)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise CaptureError(f"{file}: {image.dtype} with {image.ndim} axes, not a 16-bit grey image")
    return image.astype(np.uint16, copy=False)


def read_colour(file: Path, camera: Camera) -> NDArray[np.uint8]:
    """A picture (H, W, 3) uint8 RGB of the camera's size; CaptureError when it cannot be read."""
    return _reversed(_read(file, cv2.IMREAD_COLOR, camera))


def _reversed(picture: NDArray[Any]) -> NDArray[np.uint8]:
    """RGB from BGR, or the other way round."""
    return np.ascontiguousarray(picture[..., ::-1], np.uint8)


def read_json(file: Path) -> dict[str, Any]:
    """The JSON object in a file; CaptureError when there is none."""
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise CaptureError(f"{file}: {error}") from None
    if not isinstance(content, dict):
        raise CaptureError(f"{file}: not a JSON object")
    return content


def _frame_rate(value: Any) -> float:
    rate = float(value)
    if not 0.1 <= rate <= 1000:
        raise ValueError(f"frame rate {rate} Hz")
    return rate


def _camera_folder(path: Path, record: dict[str, Any]) -> _CameraFolder:
    camera = camera_from_record(record)
    folder = inside(path, record.get("folder", camera.name))
    kind = next((kind for kind in ("depth", "mask", "color") if (folder / kind).is_dir()), None)
    if kind is None:
        raise CaptureError(f"{folder}: no folder depth/, mask/ or color/ of camera {camera.name}")
    near_mm = round(1000 * float(record.get("near_m") or 0))
    return _CameraFolder(camera, folder, near_mm, round(1000 * float(record.get("far_m") or 65.535)), kind)


def _all_have_depth(folders: Sequence[_CameraFolder]) -> bool:
    without = [folder.camera.name for folder in folders if folder.kind != "depth"]
    if without and len(without) < len(folders):
        raise ValueError(f"cameras {', '.join(without)} have no depth/, but others do")
    return not without


def _empty_room(path: Path, record: dict[str, Any], folder: _CameraFolder) -> NDArray[Any] | None:
    name = record.get("empty_room")
    if name is None:
        if folder.kind == "color":
            raise ValueError(f"camera {folder.camera.name}: colour alone needs an empty_room, or silhouettes in mask/")
        return None
    file = inside(path, name)
    return read_depth(file, folder.camera) if folder.kind == "depth" else read_colour(file, folder.camera)[None]


def _room_colour(path: Path, record: dict[str, Any], folder: _CameraFolder) -> NDArray[np.uint8] | None:
    name = record.get("room_colour")
    return None if name is None else read_colour(inside(path, name), folder.camera)


def _times(folder: _CameraFolder, record: dict[str, Any], rate_hz: float) -> dict[int, int]:
    """Capture time [ns] after the start by frame number."""
    numbers = folder.numbers()
    stamps = record.get("timestamps_ns")
    if stamps is None:
        return {number: round(number * 1e9 / rate_hz) for number in numbers}
    if not isinstance(stamps, dict):
        raise ValueError(f"camera {folder.camera.name}: timestamps_ns is not an object of frame number: time")
    without = [number for number in numbers if str(number) not in stamps]
    if without:
        raise ValueError(f"camera {folder.camera.name}: no timestamp for frame {without[0]}")
    return {number: int(stamps[str(number)]) for number in numbers}


def _index(times: Sequence[dict[int, int]]) -> tuple[tuple[int, int, int], ...]:
    """(time [ns] from the first frame, camera, number) of all frames, in order."""
    frames = sorted((time, camera, number) for camera, of in enumerate(times) for number, time in of.items())
    return tuple((time - frames[0][0], camera, number) for time, camera, number in frames)


def inside(path: Path, name: Any) -> Path:
    """A path below ``path``: a recording from elsewhere must not name files outside its folder."""
    file = path / str(name)
    if not file.resolve().is_relative_to(path.resolve()):
        raise ValueError(f"{name!r} lies outside the recording")
    return file


def _numbered(folder: Path, number: int, suffix: str) -> Path:
    """The file of a frame: six digits, or four as Depthkit's."""
    six = folder / f"{number:06d}{suffix}"
    return six if six.exists() else folder / f"{number:04d}{suffix}"


def _find(folder: Path, number: int) -> Path | None:
    files = (_numbered(folder, number, suffix) for suffix in (".png", ".jpg"))
    return next((file for file in files if file.exists()), None)


def _read(file: Path, flags: int, camera: Camera) -> NDArray[Any]:
    try:
        image = cv2.imread(str(file), flags)
    except cv2.error as error:
        raise CaptureError(f"{file}: {error}") from None
    if image is None:
        raise CaptureError(f"{file}: cannot be decoded")
    if image.shape[:2] != (camera.height, camera.width):
        raise CaptureError(f"{file}: {image.shape[1]}×{image.shape[0]}, not {camera.width}×{camera.height}")
    return image


def _write(file: Path, image: Any) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(file), image):
        raise CaptureError(f"{file}: cannot be written")
