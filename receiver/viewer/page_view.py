"""The page's messages read back: what a page knows, for those that are no browser (the desktop window, ``export``).

The other end of ``page_messages.py``, as ``web/src/messages.js`` and ``person.js`` are. Nothing here trusts the sender:
a message that does not fit its own counts is refused.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT
from common.body.skinning import Skinning, move
from common.body.vertex_blend import VertexBlend
from common.geometry.triangle_mesh import TriangleMesh
from receiver.viewer.page_messages import (
    FRAME,
    LIVE,
    NO_POSE,
    POINTS,
    POSE,
    QUANTIZATION_STEPS,
    REMOVE,
    SHORT_INDEX_VERTICES,
    TEXTURE_SIDE_MAX,
    VERSION,
)
from receiver.viewer.viewer import ConnectionState

VERTICES_MAX = 4_000_000
_POSE_BEGIN = 40


@dataclass(frozen=True, slots=True, eq=False)
class PageMesh:
    """A POSE message. ``mesh``: at capture, with the triangles that are drawn; ``jpeg``: its texture as it came;
    ``vertex_link`` (V,) uint8, ``blend``, ``joints`` (L, 3) float32 [m, world, at capture]: as in ``RiggedMesh``."""

    pose_id: int
    mesh: TriangleMesh
    jpeg: bytes
    vertex_link: NDArray[np.uint8]
    blend: VertexBlend
    joints: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class PageFrame:
    """A FRAME message: ``motion`` (L, 3, 4) float32 of the pose's links, ``joints`` (L, 3) float32 [m, world] now;
    ``withheld``: the last good picture again, as the newest skeleton would tear it."""

    pose_id: int | None
    sequence: int
    motion: NDArray[np.float32]
    joints: NDArray[np.float32]
    withheld: bool


@dataclass(frozen=True, slots=True, eq=False)
class PagePerson:
    """The person on screen: a mesh and the frame that moves it."""

    pose: PageMesh
    frame: PageFrame
    skinning: Skinning

    def vertices(self) -> NDArray[np.float32]:
        """(V, 3) float32 [m, world] as shown."""
        pose = self.pose
        return move(pose.mesh.vertices, pose.vertex_link, pose.blend, pose.joints, self.frame.motion, self.skinning)


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What a page shows: somebody or nobody, and whether the picture is ``live``."""

    person: PagePerson | None
    live: bool


class PageView:
    """Takes messages one after the other; ``person`` is what a page would show then."""

    def __init__(self) -> None:
        self.person: PagePerson | None = None
        self.live = False
        self.taken_in = 0  # binary messages: what an acknowledgement says
        self._skinning: Skinning = "spherical"
        self._poses: dict[int, PageMesh] = {}
        self._frame: PageFrame | None = None

    @property
    def sight(self) -> Sight:
        return Sight(self.person, self.live)

    def take_text(self, text: str) -> None:
        """HELLO or the figures.

        Raises:
            ValueError: another protocol version, or not such a message.
        """
        try:
            message = json.loads(text)
            if message["kind"] == "status":
                self.live = ConnectionState(message["connection"]) is ConnectionState.RECEIVING
            elif message["kind"] == "hello":
                if message["version"] != VERSION:
                    raise ValueError(f"the receiver's page speaks version {message['version']}, here it is {VERSION}")
                if message["skinning"] not in get_args(Skinning):
                    raise ValueError(f"skinning {message['skinning']!r}")
                self._skinning = message["skinning"]
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a message of a page: {text[:40]!r}") from error

    def take(self, message: bytes) -> None:
        """POSE, FRAME or REMOVE; POINTS and LIVE are not shown here.

        Raises:
            ValueError: malformed.
        """
        if len(message) < 8 or message[0] != VERSION:
            raise ValueError(f"not a page message of version {VERSION}: {len(message)} bytes")
        self.taken_in += 1
        kind = message[1]
        if kind == POSE:
            pose = decode_pose(message)
            self._poses[pose.pose_id] = pose
            if self._frame is not None and self._frame.pose_id == pose.pose_id:  # it waited for its mesh
                self._show(self._frame)
        elif kind == FRAME:
            self._frame = decode_frame(message)
            self._show(self._frame)
        elif kind == REMOVE:
            self._remove(struct.unpack_from("<I", message, 4)[0])
        elif kind not in (POINTS, LIVE):
            raise ValueError(f"a page message of kind {kind}")

    def _show(self, frame: PageFrame) -> None:
        """As the page: nobody without a pose; while its mesh is not here the last one stays as it was."""
        if frame.pose_id is None:
            self.person = None
        elif frame.pose_id in self._poses:
            self.person = PagePerson(self._poses[frame.pose_id], frame, self._skinning)

    def _remove(self, pose_id: int) -> None:
        self._poses.pop(pose_id, None)
        if self.person is not None and self.person.pose.pose_id == pose_id:
            self.person = None


def decode_frame(message: bytes) -> PageFrame:
    """A FRAME message; of the poses that it blends, the first.

    Raises:
        ValueError: of another size, or numbers that are not finite.
    """
    size, of_another = 24 + 108 * LINK_COUNT + _padded(LINK_COUNT), 4 + 48 * LINK_COUNT
    if len(message) < size or (len(message) - size) % of_another:
        raise ValueError(f"frame: {len(message)} bytes, expected {size} and {of_another} for each other pose")
    pose_id, sequence = struct.unpack_from("<II", message, 4)
    motion = np.frombuffer(message, "<f4", 12 * LINK_COUNT, 24).reshape(-1, 3, 4)
    joints = np.frombuffer(message, "<f4", 3 * LINK_COUNT, 24 + 48 * LINK_COUNT).reshape(-1, 3)
    if not (np.isfinite(motion).all() and np.isfinite(joints).all()):
        raise ValueError("frame: a motion or joint that is not finite")
    return PageFrame(None if pose_id == NO_POSE else pose_id, sequence, motion, joints, message[2] == 1)


def decode_pose(message: bytes) -> PageMesh:
    """A POSE message.

    Raises:
        ValueError: counts that do not fit its size, links or vertices that do not exist, a texture that is none.
    """
    if len(message) < _POSE_BEGIN:
        raise ValueError(f"pose: {len(message)} bytes are too few")
    pose_id, count, face_count, *box = struct.unpack_from("<III6f", message, 4)
    index_type = np.dtype("<u2" if count <= SHORT_INDEX_VERTICES else "<u4")
    uv_at = _POSE_BEGIN + _padded(6 * count)
    joints_at = uv_at + 8 * count
    index_at = joints_at + 12 * LINK_COUNT
    texture_at = index_at + _padded(3 * face_count * index_type.itemsize)
    if not 0 < count <= VERTICES_MAX or face_count == 0 or texture_at >= len(message):
        raise ValueError(f"pose: {count} vertices and {face_count} triangles in {len(message)} bytes")
    quantized = np.frombuffer(message, "<u2", 3 * count, _POSE_BEGIN).reshape(-1, 3)
    vertices = np.array(box[:3], np.float32) + quantized * np.array(box[3:], np.float32) / np.float32(
        QUANTIZATION_STEPS
    )
    uv = np.frombuffer(message, "<u2", 2 * count, uv_at).reshape(-1, 2) / np.float32(QUANTIZATION_STEPS)
    skin = np.frombuffer(message, np.uint8, 4 * count, uv_at + 4 * count).reshape(-1, 4)
    joints = np.frombuffer(message, "<f4", 3 * LINK_COUNT, joints_at).reshape(-1, 3)
    faces = np.frombuffer(message, index_type, 3 * face_count, index_at).reshape(-1, 3).astype(np.int32)
    if skin[:, :3].max() >= LINK_COUNT or not 0 <= faces.min() <= faces.max() < count:
        raise ValueError("pose: a link or a vertex that does not exist")
    if not (np.isfinite(vertices).all() and np.isfinite(joints).all()):
        raise ValueError("pose: a place that is not finite")
    link, other, joint, share = (np.ascontiguousarray(column) for column in skin.T)
    jpeg = message[texture_at:]
    mesh = TriangleMesh(vertices.astype(np.float32), faces, uv.astype(np.float32), _picture(jpeg))
    return PageMesh(pose_id, mesh, jpeg, link, VertexBlend(other, share, joint), joints)


def _picture(jpeg: bytes) -> NDArray[np.uint8]:
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    if picture is None or max(picture.shape) > TEXTURE_SIDE_MAX:
        raise ValueError("pose: its texture is not a picture that can be shown")
    return np.asarray(picture, np.uint8)


def _padded(length: int) -> int:
    return (length + 3) // 4 * 4
