"""What the residuals bench codes: posed frames of virtual rigs and of real RGB-D cameras, and their points.

Real recordings here are a second long: the tracker sees them twice, and the poses of the second time count.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.body.view import View
from common.geometry.camera_model import Camera
from common.geometry.point_cloud import PointCloud
from common.wire.body_message import SIZE_STEP_M, encode_skeleton_sizes, quantized_skeleton
from common.wire.skeleton_packet import quantized_pose
from scripts.fidelity import Picture
from scripts.fidelity_capture import FRAME_NS, Capture
from scripts.residual_quality import Likeness, fixed_cameras, likeness, pictures
from sender.fitting.open_tracker import open_tracker
from sender.pipeline import BODY_CHANGE_M
from sender.reconstruction.foreground_points import PointSampler
from sender.residual_encoder import ResidualFrame

POINTS, VOXEL_M = 10_000, 0.012
TRACKED_POINTS = 2500
NEAR_MM, FAR_MM = 400, 1500  # of the person in recordings
_FLIPPED = np.diag([1.0, -1.0, -1.0, 1.0])  # y down, z forward → y up, the person facing +Z


@dataclass(frozen=True, slots=True, eq=False)
class PosedViews:
    """One frame: what the cameras saw, and body and links as the receiver decodes them."""

    views: tuple[View, ...]
    skeleton: Skeleton
    body_revision: int
    T_world_link: NDArray[np.float32]


@dataclass(eq=False)
class PosedSequence:
    """Frames at 30 a second, and the points of each, sampled once."""

    name: str
    cameras: tuple[Camera, ...]
    frames: list[PosedViews]
    _sampler: PointSampler = field(init=False)
    _clouds: dict[int, PointCloud] = field(init=False, default_factory=dict)
    _pictures: dict[int, list[Picture]] = field(init=False, default_factory=dict)
    _height_m: float | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._sampler = PointSampler(self.cameras, POINTS, VOXEL_M)

    @property
    def length(self) -> int:
        """Frames."""
        return len(self.frames)

    def frame(self, k: int) -> PosedViews:
        """The k-th frame."""
        return self.frames[k]

    @property
    def raw_bytes(self) -> int:
        """Of a frame's images, 5 bytes a pixel (Lien §6.3)."""
        return sum(5 * camera.width * camera.height for camera in self.cameras)

    def points(self, views: Sequence[View]) -> PointCloud:
        """The points of views of any cameras, as those of the sequence's own are sampled."""
        known = {camera.name: (camera.width, camera.fx, camera.cx, camera.cy) for camera in self.cameras}
        seen = [
            (view.camera.name, (view.camera.width, view.camera.fx, view.camera.cx, view.camera.cy)) for view in views
        ]
        own = all(known.get(name) == lens for name, lens in seen)  # a camera that moves keeps its lens, thus its rays
        return (self._sampler if own else PointSampler([v.camera for v in views], POINTS, VOXEL_M)).points(views)

    def cloud(self, k: int) -> PointCloud:
        """What the k-th frame's points are: the truth everything is compared with."""
        if k not in self._clouds:
            self._clouds[k] = self.points(self.frames[k].views)
        return self._clouds[k]

    @property
    def height_m(self) -> float:
        """Of the person in the tallest of one frame in ten."""
        if self._height_m is None:
            self._height_m = max(float(np.ptp(self.cloud(k).positions[:, 1])) for k in range(0, self.length, 10))
        return self._height_m

    def likeness(self, k: int, shown: PointCloud) -> Likeness:
        """How like the k-th frame's points a cloud looks."""
        truth = self.cloud(k)
        if k not in self._pictures:
            self._pictures[k] = pictures(truth, fixed_cameras(truth, self.height_m))
        return likeness(truth, shown, self.height_m, self._pictures[k])

    def residual_frame(self, k: int) -> ResidualFrame:
        """The k-th frame as the residual encoder takes it."""
        f = self.frames[k]
        return ResidualFrame(f.skeleton, f.body_revision, f.T_world_link, k, k * FRAME_NS, self.cloud(k))


class _Posed:
    """Gives frames the body a receiver would hold: a new one when a size has changed by a millimetre."""

    def __init__(self) -> None:
        self._body: Skeleton | None = None
        self._steps = np.zeros(0, int)
        self._revision = 0

    def views(self, views: tuple[View, ...], found: Skeleton, pose: SkeletonPose) -> PosedViews:
        """``found``, ``pose``: the tracker's."""
        steps = np.frombuffer(encode_skeleton_sizes(found), "<i2").astype(int)
        if self._body is None or np.abs(steps - self._steps).max() * SIZE_STEP_M >= BODY_CHANGE_M:
            self._body, self._steps, self._revision = quantized_skeleton(found), steps, (self._revision + 1) % 256
        return PosedViews(views, self._body, self._revision, forward_kinematics(self._body, quantized_pose(pose)))


def captured_sequence(name: str, recorded: Capture, cameras: tuple[Camera, ...], count: int) -> PosedSequence:
    """``count`` frames of a virtual rig's performance, repeated if need be, from our tracker's first pose on."""
    frames: list[PosedViews] = []
    posed, k = _Posed(), 0
    while len(frames) < count:
        captured = recorded.frame(k)
        k += 1
        if captured.own is not None:
            frames.append(posed.views(captured.views, *captured.own[:2]))
        assert frames or k < recorded.length, f"{name}: no pose was found"
    return PosedSequence(name, cameras, frames)


def recorded_sequence(name: str, data: Path) -> PosedSequence:
    """One of the real recordings under ``data``: ``uva_turning_person`` (frames i, i+25, i+50, i+75 of a turning person
    as four cameras around one who stands still), ``ddrnet_person``, ``kinect2_laptop`` (one camera each).

    Raises:
        ValueError: no recording of that name.
    """
    folder = data / "rgbd" / name
    if name == "uva_turning_person":
        return _tracked(name, _turning(folder))
    if name == "ddrnet_person":
        camera = Camera("cam1", 640, 480, 536.628, 536.606, 310.591, 234.759, _FLIPPED)
    elif name == "kinect2_laptop":
        camera = Camera("cam1", 512, 424, 366.557, 366.557, 254.503, 205.052, _FLIPPED)
    else:
        raise ValueError(f"{name}: there is no such recording")
    numbers = sorted(file.stem for file in (folder / "depth").glob("*.png"))
    return _tracked(name, [(_view(folder, number, camera),) for number in numbers])


def _turning(folder: Path) -> list[tuple[View, ...]]:
    """Four quarters of the turn at a time; from one time to the next all four cameras go 3.6° around."""
    told = json.loads((folder / "cameras.json").read_text())
    lens = told["intrinsics"]
    quarters = [[f"{first + turned:010d}" for turned in (0, 25, 50, 75)] for first in range(25)]
    frames = []
    for names in quarters:
        if not all(name in told["frames"] for name in names):
            continue
        views = []
        for index, name in enumerate(names):
            pose = told["frames"][name]
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = pose["R_cam_to_body"], pose["t_cam_to_body_m"]
            T[:3, :3] = _orthonormal(T[:3, :3])
            camera = Camera(f"cam{index + 1}", lens["width"], lens["height"], lens["fx"], lens["fy"], lens["cx"],
                            lens["cy"], _FLIPPED @ T)  # fmt: skip
            views.append(_view(folder, name, camera))
        frames.append(tuple(views))
    return frames


def _orthonormal(R: NDArray[np.float64]) -> NDArray[np.float64]:
    U, _, Vt = np.linalg.svd(R)
    return np.asarray(U @ Vt)


def _view(folder: Path, name: str, camera: Camera) -> View:
    """One camera's person: what its mask holds, if it has one, between near and far."""
    depth = cv2.imread(str(folder / "depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    found = next(file for kind in ("png", "jpg") if (file := folder / "color" / f"{name}.{kind}").exists())
    colour = cv2.imread(str(found), cv2.IMREAD_COLOR_RGB)
    assert depth is not None
    assert colour is not None
    person = (depth > NEAR_MM) & (depth < FAR_MM)
    for mask_file in (folder / "mask").glob(f"{name}.*"):
        mask = cv2.imread(str(mask_file), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        person &= mask > 127
    rows, columns = np.flatnonzero(person.any(axis=1)), np.flatnonzero(person.any(axis=0))
    v, u = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    kept = np.where(person[v, u], depth[v, u], 0).astype(np.uint16)
    return View(camera, int(columns[0]), int(rows[0]), kept, np.ascontiguousarray(colour[v, u], np.uint8))


def _tracked(name: str, frames: list[tuple[View, ...]]) -> PosedSequence:
    """The frames with the poses our tracker finds."""
    cameras = tuple(view.camera for view in frames[0])
    sampler, tracker = PointSampler(cameras, TRACKED_POINTS), open_tracker("gauss-newton")
    fits = [tracker.track(sampler.points(views), k * FRAME_NS) for k, views in enumerate(2 * frames)]
    posed = _Posed()
    found = [posed.views(views, fit.skeleton, fit.pose) for views, fit in zip(frames, fits[len(frames) :], strict=True)
             if fit is not None]  # fmt: skip
    assert len(found) == len(frames), f"{name}: poses of {len(found)} of {len(frames)} frames were found"
    return PosedSequence(name, cameras, found)
