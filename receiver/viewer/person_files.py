"""The person on screen as a file that other programs open: PLY with a colour per vertex, or GLB, textured and rigged.

GLB is glTF 2.0 in one file: unlit, as the cameras' colours already hold the light of the room, and bound to the links
as they stand now, so that it opens as it was shown and can be posed from there (glTF bends by linear blend).
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_NAMES, LINK_PARENTS
from receiver.viewer.page_view import PagePerson

_FLOAT, _UNSIGNED_BYTE, _UNSIGNED_INT = 5126, 5121, 5125
_VERTICES, _INDICES = 34962, 34963  # what a buffer view is for
_LINEAR, _CLAMP = 9729, 33071


class ExportError(Exception):
    """The file cannot be written; the text says why."""


def write_person(path: Path, person: PagePerson) -> None:
    """Write ``path``, whole or not at all; its ending says how.

    Raises:
        ExportError: an ending other than .glb and .ply, or a place that cannot be written.
    """
    if (write := _WRITERS.get(path.suffix.lower())) is None:
        raise ExportError(f"{path}: its name ends in none of {', '.join(_WRITERS)}")
    _write(path, write(person))


def write_points(path: Path, positions: NDArray[np.float32], colours: NDArray[np.uint8]) -> None:
    """Write points (N, 3) [m, world] with colours (N, 3) as binary PLY, whole or not at all.

    Raises:
        ExportError: a place that cannot be written.
    """
    _write(path, _ply_head(len(positions)) + b"end_header\n" + _ply_vertices(positions, colours))


def _write(path: Path, data: bytes) -> None:
    unfinished = path.with_name(path.name + ".part")
    try:
        unfinished.write_bytes(data)
        os.replace(unfinished, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            unfinished.unlink()
        raise ExportError(f"cannot write {path}: {error.strerror}") from error


def ply(person: PagePerson) -> bytes:
    """Binary PLY: vertices [m, world] with the texture's colour there, and triangles."""
    used, faces = _used(person)
    mesh = person.pose.mesh
    height, width = mesh.texture.shape[:2]
    at = mesh.uv[used] * np.array([width, height], np.float32) - np.float32(0.5)
    colour = _sampled(mesh.texture, at)
    triangles = np.empty(len(faces), np.dtype([("count", "u1"), ("vertices", "<i4", 3)]))
    triangles["count"], triangles["vertices"] = 3, faces
    head = f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n".encode("ascii")
    return _ply_head(len(used)) + head + _ply_vertices(person.vertices()[used], colour) + triangles.tobytes()


def _ply_head(vertices: int) -> bytes:
    head = (
        "ply\nformat binary_little_endian 1.0\ncomment metres, y up\n"
        f"element vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    )
    return head.encode("ascii")


def _ply_vertices(positions: NDArray[np.float32], colours: NDArray[np.uint8]) -> bytes:
    rows = np.empty(len(positions), np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    rows["xyz"], rows["rgb"] = positions, colours
    return rows.tobytes()


def glb(person: PagePerson) -> bytes:
    """glTF 2.0, binary: one textured mesh, skinned to the links' tree."""
    used, faces = _used(person)
    pose, joints = person.pose, person.frame.joints
    share = pose.blend.share[used]
    nobody = np.zeros_like(share)
    other = np.where(share > 0, pose.blend.other[used], 0).astype(np.uint8)  # an unused joint has to be 0
    to_joint = np.tile(np.eye(4, dtype=np.float32), (LINK_COUNT, 1, 1))
    to_joint[:, 3, :3] = -joints  # columns are rows in glTF
    file = _Glb()
    attributes = {
        "POSITION": file.accessor(person.vertices()[used], "VEC3", _FLOAT, _VERTICES, bounds=True),
        "TEXCOORD_0": file.accessor(pose.mesh.uv[used], "VEC2", _FLOAT, _VERTICES),
        "JOINTS_0": file.accessor(_four(pose.vertex_link[used], other, nobody), "VEC4", _UNSIGNED_BYTE, _VERTICES),
        "WEIGHTS_0": file.accessor(
            _four((255 - share).astype(np.uint8), share, nobody), "VEC4", _UNSIGNED_BYTE, _VERTICES, normalized=True
        ),
    }
    indices = file.accessor(faces.astype("<u4").reshape(-1), "SCALAR", _UNSIGNED_INT, _INDICES)
    binding = file.accessor(to_joint, "MAT4", _FLOAT)
    picture = file.view(pose.jpeg)
    document = _scene(joints) | {
        "asset": {"version": "2.0", "generator": "telepose"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "skins": [{"inverseBindMatrices": binding, "joints": list(range(LINK_COUNT)), "skeleton": 0}],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1},
                "doubleSided": True,
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": [{"bufferView": picture, "mimeType": "image/jpeg"}],
    }
    return file.bytes(document)


class _Glb:
    """Collects the binary part, and what the document says of it."""

    def __init__(self) -> None:
        self._binary = bytearray()
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """The number of a new buffer view of ``data``."""
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(data)}
        self._views.append(view | ({} if target is None else {"target": target}))
        self._binary += data + bytes(-len(data) % 4)
        return len(self._views) - 1

    def accessor(
        self,
        values: NDArray[Any],
        kind: str,
        component: int,
        target: int | None = None,
        normalized: bool = False,
        bounds: bool = False,
    ) -> int:
        """The number of a new accessor of ``values`` (N, …)."""
        entry: dict[str, Any] = {"type": kind, "componentType": component, "count": len(values)}
        entry["bufferView"] = self.view(np.ascontiguousarray(values).tobytes(), target)
        if normalized:
            entry["normalized"] = True
        if bounds:
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self._accessors.append(entry)
        return len(self._accessors) - 1

    def bytes(self, document: dict[str, Any]) -> bytes:
        """The file."""
        document |= {
            "buffers": [{"byteLength": len(self._binary)}],
            "bufferViews": self._views,
            "accessors": self._accessors,
        }
        text = json.dumps(document, separators=(",", ":")).encode("utf-8")
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self._binary), b"BIN\0") + self._binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _scene(joints: NDArray[np.float32]) -> dict[str, Any]:
    """The links' tree, each node at its joint (L, 3) [m, world] and none turned, and the mesh beside it."""
    nodes: list[dict[str, Any]] = []
    for link, parent in enumerate(LINK_PARENTS):
        place = joints[link] - (joints[parent] if parent >= 0 else 0)
        children = [child for child, its in enumerate(LINK_PARENTS) if its == link]
        node = {"name": LINK_NAMES[link], "translation": place.tolist()}
        nodes.append(node | ({"children": children} if children else {}))
    nodes.append({"name": "person", "mesh": 0, "skin": 0})
    return {"scene": 0, "scenes": [{"nodes": [0, LINK_COUNT]}], "nodes": nodes}


def _used(person: PagePerson) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Vertices that drawn triangles use (U,), and those triangles (F, 3) over them."""
    faces = person.pose.mesh.faces
    used, place = np.unique(faces, return_inverse=True)
    return used.astype(np.int64), np.reshape(place, faces.shape).astype(np.int32)


def _sampled(texture: NDArray[np.uint8], at: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours (N, 3) at pixels ``at`` (N, 2), in pieces as OpenCV's remap takes 32,767 rows."""
    pieces = [
        cv2.remap(texture, piece[:, :1], piece[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for piece in np.array_split(at, len(at) // 30_000 + 1)
    ]
    return np.concatenate(pieces)[:, 0].astype(np.uint8)


def _four(first: NDArray[np.uint8], second: NDArray[np.uint8], none: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.stack([first, second, none, none], axis=1)


_WRITERS: dict[str, Callable[[PagePerson], bytes]] = {".glb": glb, ".ply": ply}
