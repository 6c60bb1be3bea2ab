"""UTD-MHAD: Kinect v1 depth of one person per sequence, background removed, in MAT v5 files (Chen et al., ICIP 2015).

The Kinect SDK delivers mirrored images (the person's right hand is on the right); they are turned round here.
The data set records no calibration: nominal intrinsics, and a level camera with the soles on the floor.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.geometry.camera_model import Camera
from common.geometry.rigid_transform import transform_points
from sender.capture.assumed_pose import assumed_pose
from sender.capture.frame_set import CaptureError

FRAME_RATE_HZ = 30.0
_FOCAL_PX, _CX, _CY = 285.63, 160.0, 120.0  # Kinect SDK v1, nominal for 320×240
_LOOKED_AT = 10  # frames that the camera's height is estimated from
_MAX_FRAMES = 10_000

_HEAD, _NECK, _SPINE, _HIP_CENTRE = 0, 1, 2, 3
_LIMBS = [4, 5, 6, 12, 13, 14, 8, 9, 10, 16, 17, 18]  # shoulder, elbow, wrist, hip, knee, ankle; left, right
_HEAD_SHARE = 0.4  # of the way from the neck to the middle of the head lies the joint of the head


class UtdMhadSequence:
    """One sequence; ``path`` is a depth file, or a folder with ``Depth/``, whose first sequence is taken.

    Raises:
        CaptureError: no such file, or not a UTD-MHAD depth file.
    """

    frame_rate_hz = FRAME_RATE_HZ
    has_depth = True

    def __init__(self, path: Path) -> None:
        self.path = path if path.is_file() else _first(path / "Depth")
        stored = _read(self.path, "d_depth")
        if stored.dtype != np.uint16 or stored.ndim != 3 or not 1 <= stored.shape[2] <= _MAX_FRAMES:
            raise CaptureError(f"{self.path}: d_depth is {stored.dtype} {stored.shape}, not uint16 (H, W, frames)")
        self._depth = np.ascontiguousarray(np.moveaxis(stored, 2, 0)[:, :, ::-1], np.uint16)
        count, height, width = self._depth.shape
        scale = width / 320
        focal, cx, cy = _FOCAL_PX * scale, width - 1 - _CX * scale, _CY * scale
        try:
            pose = assumed_pose(self._depth[:: max(count // _LOOKED_AT, 1)], focal, focal, cx, cy)
            self.cameras: tuple[Camera, ...] = (Camera(self.path.stem, width, height, focal, focal, cx, cy, pose),)
        except ValueError as error:
            raise CaptureError(f"{self.path}: {error}") from None
        self.empty_room: tuple[NDArray[np.uint16] | None, ...] = (None,)
        self.room_colour = (None,)
        self.frames = tuple((round(number * 1e9 / FRAME_RATE_HZ), 0, number) for number in range(count))

    def load(self, camera_index: int, number: int) -> tuple[NDArray[np.uint16], None]:
        """See ``recorded_rig.Recording``; the data set as kept has no colour."""
        return self._depth[number], None

    @property
    def start_joints(self) -> NDArray[np.float64] | None:
        """The sixteen named joints (16, 3) [m, world] of the first frame by the SDK, None without a skeleton file.

        What the SDK calls spine lies lower than our chest, its head in the middle of the head.
        """
        try:
            sdk = self.joints(0)
        except CaptureError:
            return None
        neck, head = sdk[_NECK], sdk[_HEAD]
        chest = (sdk[_SPINE] + neck) / 2
        trunk = [sdk[_HIP_CENTRE], chest, neck, neck + _HEAD_SHARE * (head - neck)]
        return np.array([*trunk, *sdk[_LIMBS]])

    def joints(self, number: int) -> NDArray[np.float64]:
        """The SDK's estimate of the 20 joints (20, 3) float64 [m, world] in the order of Skeleton_joint_order.txt.

        Raises:
            CaptureError: there is no skeleton file beside the depth.
        """
        name = self.path.name.replace("_depth.mat", "_skeleton.mat")
        beside = (self.path.parent.parent / "Skeleton" / name, self.path.parent / name)
        file = next((candidate for candidate in beside if candidate.exists()), beside[0])
        skeleton = _read(file, "d_skel")
        if skeleton.shape[:2] != (20, 3) or not 0 <= number < skeleton.shape[2]:
            raise CaptureError(f"{file}: d_skel {skeleton.shape} has no frame {number} of 20 joints")
        sdk_to_camera = np.array([-1.0, -1.0, 1.0])  # unmirrored, and y down
        joints = np.asarray(skeleton[..., number], np.float64) * sdk_to_camera
        return transform_points(self.cameras[0].T_world_camera, joints).astype(np.float64)


def _first(folder: Path) -> Path:
    files = sorted(folder.glob("*_depth.mat"))
    if not files:
        raise CaptureError(f"{folder}: no *_depth.mat")
    return files[0]


def _read(file: Path, variable: str) -> NDArray[Any]:
    import scipy.io  # takes a while: nobody waits for it who plays no such recording

    try:
        content = scipy.io.loadmat(file, variable_names=[variable])
    except Exception as error:  # the reader raises whatever the bytes lead it to
        raise CaptureError(f"{file}: not a MAT v5 file: {error}") from None
    if variable not in content or not isinstance(content[variable], np.ndarray):
        raise CaptureError(f"{file}: no variable {variable}")
    values: NDArray[Any] = content[variable]
    return values
