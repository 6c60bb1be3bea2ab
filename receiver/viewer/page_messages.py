"""What goes over the page's WebSocket: little-endian binary messages, and status as JSON text.

Every binary message begins with ``version u8, kind u8, two zero bytes``; every part of it starts at a multiple of
four bytes, so that the page reads typed arrays in place (``web/src/messages.js`` is the other end).

- POSE, once per candidate pose: ``pose_id u32, vertices V u32, triangles F u32, box_min f32[3], box_size f32[3],
  position u16[V, 3]`` (0..65535 over the box), padding, ``uv u16[V, 2]`` (0..65535 over the texture, from its top left
  corner), ``link u8[V, 4]`` (its link, the neighbour that also moves it, the joint between them, the neighbour's part
  in 1/255), ``joints f32[L, 3]`` at capture, ``index u16[F, 3]`` (u32 if V > 65,536), padding, and the texture as JPEG.
- FRAME, every skeleton: ``pose_id u32, sequence u32, sigma f32, fit_confidence f32, age_ms f32, motion f32[L, 3, 4],
  joints f32[L, 3], links f32[L, 3, 4], confidence u8[L]``, padding, and for each pose that it is blended with
  ``pose_id u32, motion f32[L, 3, 4]``: 6,964 bytes with four others, 1.67 Mbit/s at 30 Hz. The first of its two zero
  bytes is 1 when it is withheld: the last good picture once more; the second, how much of the newest LIVE of its
  poses it shows, in 1/255. ``links`` (T_world_link) move points, and tell where in LIVE a vertex is.
- REMOVE: ``pose_id u32``.
- POINTS, every residual packet, to pages that show points: ``points N u32, box_min f32[3], box_size f32[3], radius f32,
  position u16[N, 3]`` (0..65535 over the box, in the frame of the point's link), padding, ``colour and link u8[N, 4]``:
  10 bytes a point. With N = 0 there are none any more.
- LIVE, of one of a FRAME's poses, before it, when there is a newer one, to pages that show it: ``pose_id u32, width W
  u32, height H u32, step f32, cylinders f32[L, 3, 3], sizes f32[L, 2], places i32[L, 4]`` (as in ``MapLayout``),
  ``offsets u8[H, W, 4]`` about 128: red, green, blue, and outwards in ``step`` [m]. 60 kB, at most with every FRAME.

The page answers each binary message with one ``u32``: how many it has taken in so far. What it shows, where that is not
HELLO's ``mode``, it says as the text "mesh", "live" or "points", and "alone" if it draws no pose but the best.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import asdict
from typing import TYPE_CHECKING, cast, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.link_points import SPLAT_RADIUS_M, LinkPoints
from common.body.live_surface import OUTWARD_STEP_M, LiveSurface
from common.body.skeleton import LINK_COUNT, LINK_PARENTS
from common.body.skinning import Skinning, captured_joints
from receiver.viewer.viewer import ShownFrame, ViewerStatus, ViewMode

if TYPE_CHECKING:
    from common.body.rigged_mesh import RiggedMesh

VERSION = 8
POSE, FRAME, REMOVE, POINTS, LIVE = 1, 2, 3, 4, 5
NO_POSE = 0xFFFFFFFF
ALONE = "alone"
QUANTIZATION_STEPS = 65535
SHORT_INDEX_VERTICES = 65536
JPEG_QUALITY = 90  # above the received views' own: a second coding should add little
TEXTURE_SIDE_MAX = 8192  # pixels; what browsers' GPUs take

_HEADER = struct.Struct("<BBxx")
_FRAME_HEADER = struct.Struct("<BB?B")
_POSE = struct.Struct("<III3f3f")
_FRAME = struct.Struct("<IIfff")
_OTHER = struct.Struct("<I")
_REMOVE = struct.Struct("<I")
_POINTS = struct.Struct("<I3f3ff")
_LIVE = struct.Struct("<IIIf")
_ACKNOWLEDGEMENT = struct.Struct("<I")


def encode_pose(mesh: RiggedMesh) -> bytes:
    """The POSE message of a rigged mesh: world vertices at capture, texture, links and unstretched triangles.

    Positions are rounded to 1/65535 of the mesh's bounding box: 0.03 mm for a person. Takes milliseconds.

    Raises:
        ValueError: an empty mesh, arrays that do not fit each other, or a texture over 8192 pixels wide or high.
    """
    vertices, faces, uv = mesh.mesh.vertices, mesh.faces_drawn, mesh.mesh.uv
    count = len(vertices)
    if count == 0 or len(faces) == 0:
        raise ValueError(f"pose {mesh.pose_id}: an empty mesh cannot be shown")
    if len(uv) != count or len(mesh.vertex_link) != count or not 0 <= int(faces.max()) < count:
        raise ValueError(f"pose {mesh.pose_id}: texture coordinates, links or faces do not match {count} vertices")
    if max(mesh.mesh.texture.shape) > TEXTURE_SIDE_MAX:
        raise ValueError(f"pose {mesh.pose_id}: a texture of {mesh.mesh.texture.shape[1::-1]} pixels is too large")
    box_min = vertices.min(axis=0)
    box_size = np.maximum(vertices.max(axis=0) - box_min, np.float32(1e-6))
    position = np.rint((vertices - box_min) * (QUANTIZATION_STEPS / box_size)).astype("<u2")
    index = faces.astype("<u2" if count <= SHORT_INDEX_VERTICES else "<u4")
    blend = mesh.blend
    skin = np.stack([mesh.vertex_link, blend.other, blend.joint, blend.share], axis=1)
    parts = (position, np.rint(uv * QUANTIZATION_STEPS).astype("<u2"), skin, captured_joints(mesh), index)
    head = _HEADER.pack(VERSION, POSE) + _POSE.pack(mesh.pose_id, count, len(faces), *box_min, *box_size)
    return b"".join((head, *(_padded(part.tobytes()) for part in parts), _jpeg(mesh.mesh.texture)))


def encode_frame(frame: ShownFrame) -> bytes:
    """The FRAME message; without a pose the motion is zeros and the page shows the joints alone."""
    pose_id = NO_POSE if frame.pose_id is None else frame.pose_id
    motion = np.zeros((LINK_COUNT, 3, 4), np.float32) if frame.motion is None else frame.motion
    head = _FRAME.pack(pose_id, frame.sequence, frame.sigma, frame.fit_confidence, frame.age_ms)
    confidence = np.rint(np.clip(frame.confidence, 0, 1) * 255).astype(np.uint8)
    links = np.zeros((LINK_COUNT, 3, 4), np.float32) if frame.links is None else frame.links
    parts = (
        _FRAME_HEADER.pack(VERSION, FRAME, frame.withheld, round(255 * frame.live)),
        head,
        _floats(motion),
        _floats(frame.joints),
        _floats(links),
        _padded(confidence.tobytes()),
        *(_OTHER.pack(other.pose_id) + _floats(other.motion) for other in frame.others),
    )
    return b"".join(parts)


def encode_points(points: LinkPoints | None) -> bytes:
    """The POINTS message, positions rounded to 1/65535 of their box: 0.02 mm."""
    if points is None or len(points) == 0:
        return _HEADER.pack(VERSION, POINTS) + _POINTS.pack(0, *(0.0,) * 7)
    box_min = points.positions.min(axis=0)
    box_size = np.maximum(points.positions.max(axis=0) - box_min, np.float32(1e-6))
    position = np.rint((points.positions - box_min) * (QUANTIZATION_STEPS / box_size)).astype("<u2")
    colour = np.concatenate([points.colours, points.links[:, None]], axis=1)
    head = _HEADER.pack(VERSION, POINTS) + _POINTS.pack(len(points), *box_min, *box_size, SPLAT_RADIUS_M)
    return b"".join((head, _padded(position.tobytes()), colour.tobytes()))


def encode_live(surface: LiveSurface) -> bytes:
    """The LIVE message."""
    layout, (height, width) = surface.layout, surface.offsets.shape[:2]
    parts = (_floats(layout.cylinders), _floats(layout.sizes), layout.places.astype("<i4").tobytes())
    head = _HEADER.pack(VERSION, LIVE) + _LIVE.pack(surface.pose_id, width, height, OUTWARD_STEP_M)
    return b"".join((head, *parts, surface.offsets.tobytes()))


def encode_remove(pose_id: int) -> bytes:
    """The REMOVE message."""
    return _HEADER.pack(VERSION, REMOVE) + _REMOVE.pack(pose_id)


def encode_status(status: ViewerStatus) -> str:
    """The figures of the HUD as JSON text; what is not finite becomes null, as JSON has no other word for it."""
    figures = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(status).items()}
    return json.dumps({"kind": "status", **figures})


def encode_hello(skinning: Skinning, mode: ViewMode = "mesh") -> str:
    """The first message to a page: protocol version, how meshes bend, what to show at first, and the link tree that the
    overlay draws."""
    about = {"version": VERSION, "skinning": skinning, "mode": mode, "link_parents": LINK_PARENTS}
    return json.dumps({"kind": "hello", **about})


def decode_acknowledgement(message: bytes) -> int:
    """How many binary messages the page has taken in.

    Raises:
        ValueError: anything but four bytes.
    """
    if len(message) != _ACKNOWLEDGEMENT.size:
        raise ValueError(f"acknowledgement of {len(message)} bytes, expected {_ACKNOWLEDGEMENT.size}")
    return int(_ACKNOWLEDGEMENT.unpack(message)[0])


def decode_mode(message: str) -> ViewMode:
    """What the page shows from now on.

    Raises:
        ValueError: none of the three.
    """
    for mode in get_args(ViewMode):
        if message == mode:
            return cast(ViewMode, mode)
    raise ValueError(f"it wants to show {message[:20]!r}")


def _floats(values: NDArray[np.float32]) -> bytes:
    return np.ascontiguousarray(values, "<f4").tobytes()


def _jpeg(texture: NDArray[np.uint8]) -> bytes:
    settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    settings += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(texture, cv2.COLOR_RGB2BGR), settings)
    return jpeg.tobytes()


def _padded(part: bytes) -> bytes:
    return part + bytes(-len(part) % 4)
