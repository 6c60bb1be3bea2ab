"""The files that ``export`` writes: read back here field by field, and by Open3D where it is installed."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, LINK_NAMES, LINK_PARENTS
from receiver.viewer.page_messages import encode_frame, encode_pose
from receiver.viewer.page_view import PagePerson, PageView
from receiver.viewer.person_files import ExportError, glb, ply, write_person
from tests.capsule_person import SHIRT, SKIN, TROUSERS, capsule_person, shown_frame

COMPONENTS = {5126: "<f4", 5121: "u1", 5125: "<u4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def person() -> PagePerson:
    view, mesh = PageView(), capsule_person(7)
    view.take(encode_pose(mesh))
    view.take(encode_frame(shown_frame(mesh, 0.8)))
    assert view.person is not None
    return view.person


PERSON = person()


def read_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, length, text_length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    binary_at = 20 + text_length
    binary_length, kind = struct.unpack_from("<I4s", data, binary_at)
    assert (kind, binary_at + 8 + binary_length) == (b"BIN\0", len(data))
    assert text_length % 4 == binary_length % 4 == 0
    return json.loads(data[20:binary_at]), data[binary_at + 8 :]


def values(document: dict[str, Any], binary: bytes, number: int) -> NDArray[Any]:
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    width, kind = WIDTHS[accessor["type"]], np.dtype(COMPONENTS[accessor["componentType"]])
    assert view["byteOffset"] % 4 == 0
    assert view["byteLength"] == accessor["count"] * width * kind.itemsize
    return np.frombuffer(binary, kind, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)


def test_glb_holds_the_person_as_shown_with_its_texture() -> None:
    document, binary = read_glb(glb(PERSON))
    primitive = document["meshes"][0]["primitives"][0]
    places = values(document, binary, primitive["attributes"]["POSITION"])
    faces = values(document, binary, primitive["indices"]).reshape(-1, 3)
    uv = values(document, binary, primitive["attributes"]["TEXCOORD_0"])
    drawn = PERSON.pose.mesh.faces
    np.testing.assert_array_equal(places[faces], PERSON.vertices()[drawn])
    np.testing.assert_array_equal(uv[faces], PERSON.pose.mesh.uv[drawn])
    bounds = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_allclose([bounds["min"], bounds["max"]], [places.min(axis=0), places.max(axis=0)])
    picture = document["bufferViews"][document["images"][0]["bufferView"]]
    jpeg = binary[picture["byteOffset"] : picture["byteOffset"] + picture["byteLength"]]
    texture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(texture, PERSON.pose.mesh.texture)


def test_glb_opens_as_shown_and_its_bones_move_it() -> None:
    """The bones as they stand leave every vertex where it is; a turned forearm takes its own vertices along."""
    document, binary = read_glb(glb(PERSON))
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    places = values(document, binary, attributes["POSITION"])
    joints = values(document, binary, attributes["JOINTS_0"])
    weights = values(document, binary, attributes["WEIGHTS_0"]) / 255
    binding = values(document, binary, document["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    assert (joints[weights == 0] == 0).all()
    assert [node["name"] for node in document["nodes"][:LINK_COUNT]] == list(LINK_NAMES)

    def posed(turned: int | None) -> NDArray[Any]:
        world: list[NDArray[Any]] = []
        for link, parent in enumerate(LINK_PARENTS):
            assert parent < 0 or link in document["nodes"][parent]["children"]
            local = np.eye(4)
            local[:3, 3] = document["nodes"][link]["translation"]
            if link == turned:
                local[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
            world.append(local if parent < 0 else world[parent] @ local)
        skin = np.stack(world) @ binding.transpose(0, 2, 1)
        mixed = np.einsum("vk,vkij->vij", weights, skin[joints])
        return mixed[:, :3, :3] @ places[:, :, None] + mixed[:, :3, 3:]

    np.testing.assert_allclose(posed(None)[..., 0], places, atol=1e-5)
    forearm = LINK_NAMES.index("left_forearm")
    moved = np.linalg.norm(posed(forearm)[..., 0] - places, axis=1) > 0.01
    own = (joints[:, 0] == forearm) & (weights[:, 0] > 0.5)
    assert moved[own].mean() > 0.9
    assert not moved[joints[:, 0] == LINK_NAMES.index("right_forearm")].any()


def test_ply_holds_places_colours_and_triangles() -> None:
    data = ply(PERSON)
    head, _, body = data.partition(b"end_header\n")
    counts = [int(line.split()[-1]) for line in head.decode().splitlines() if line.startswith("element")]
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)], counts[0])
    faces = np.frombuffer(body, [("n", "u1"), ("v", "<i4", 3)], counts[1], rows.nbytes)
    assert rows.nbytes + faces.nbytes == len(body)
    assert (faces["n"] == 3).all()
    np.testing.assert_array_equal(rows["xyz"][faces["v"]], PERSON.vertices()[PERSON.pose.mesh.faces])
    for colour in (SHIRT, SKIN, TROUSERS):
        assert (np.abs(rows["rgb"].astype(int) - colour) <= 4).all(axis=1).sum() > 100


def test_open3d_reads_both(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="no Open3D here (pip install open3d-cpu)", exc_type=ImportError)
    for name in ("person.ply", "person.glb"):
        write_person(tmp_path / name, PERSON)
    model = open3d.io.read_triangle_model(str(tmp_path / "person.glb"))
    shown = PERSON.vertices()[PERSON.pose.mesh.faces]
    for mesh in (model.meshes[0].mesh, open3d.io.read_triangle_mesh(str(tmp_path / "person.ply"))):
        np.testing.assert_allclose(np.asarray(mesh.vertices)[np.asarray(mesh.triangles)], shown, atol=1e-6)
    assert np.asarray(model.materials[0].albedo_img).shape == PERSON.pose.mesh.texture.shape


def test_files_are_written_whole_or_not_at_all(tmp_path: Path) -> None:
    write_person(tmp_path / "person.GLB", PERSON)
    assert (tmp_path / "person.GLB").read_bytes() == glb(PERSON)
    (tmp_path / "folder.ply").mkdir()
    for bad in (tmp_path / "folder.ply", tmp_path / "nowhere" / "person.ply"):
        with pytest.raises(ExportError, match="cannot write"):
            write_person(bad, PERSON)
    with pytest.raises(ExportError, match=r"\.glb, \.ply"):
        write_person(tmp_path / "person.obj", PERSON)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder.ply", "person.GLB"]
