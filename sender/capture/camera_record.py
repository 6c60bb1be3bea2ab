"""A camera as plain data, for JSON files and messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from common.geometry.camera_model import Camera


def camera_to_record(camera: Camera) -> dict[str, Any]:
    """Name, size, intrinsics [pixels], distortion (5) and ``T_world_camera`` (4×4 rows) as plain values."""
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "distortion": camera.distortion.tolist(),
        "T_world_camera": camera.T_world_camera.tolist(),
    }


def camera_from_record(record: Mapping[str, Any]) -> Camera:
    """The camera of such a record; ``distortion`` may be left out.

    Raises:
        ValueError: a field is missing, has the wrong type, or the values cannot be a camera.
    """
    try:
        sizes = int(record["width"]), int(record["height"])
        fx, fy, cx, cy = (float(record[key]) for key in ("fx", "fy", "cx", "cy"))
        pose = np.asarray(record["T_world_camera"], np.float64)
        distortion = np.asarray(record.get("distortion", ()), np.float64)
        return Camera(str(record["name"]), *sizes, fx, fy, cx, cy, pose, distortion)
    except KeyError as error:
        raise ValueError(f"camera without {error}") from None
    except (TypeError, AttributeError) as error:
        raise ValueError(f"camera {record!r:.60}: {error}") from None
