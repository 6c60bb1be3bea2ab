"""The page's WebSocket messages, read back here field by field as the page reads them."""

from __future__ import annotations

import dataclasses
import json
import struct
from typing import get_args

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.body.rigged_mesh import RiggedMesh, build_rigged_mesh
from common.body.rigging import Rigging
from common.body.skeleton import LINK_COUNT, LINK_PARENTS
from common.body.skinning import captured_joints
from common.body.vertex_blend import VertexBlend
from common.geometry.triangle_mesh import TriangleMesh
from receiver.viewer import page_messages
from receiver.viewer.viewer import ConnectionState, ViewerStatus, ViewMode
from tests.capsule_person import SKELETON, capsule_person, link_points, shown_frame
from tests.capsule_views import arms_down_by, capsule_views

PERSON = capsule_person(pose_id=7)
ZIPPERED = build_rigged_mesh(
    7, 0, SKELETON, arms_down_by(0.8), capsule_views(arms_down_by(0.8), 3), Rigging(views="zippered")
)


def trimmed(vertices: int) -> RiggedMesh:
    """The person's first vertices and one face, so that every remainder of the padding occurs."""
    mesh = TriangleMesh(
        PERSON.mesh.vertices[:vertices],
        np.array([[0, 1, vertices - 1]], np.int32),
        PERSON.mesh.uv[:vertices],
        PERSON.mesh.texture,
    )
    return dataclasses.replace(
        PERSON,
        mesh=mesh,
        vertex_link=PERSON.vertex_link[:vertices],
        blend=VertexBlend(PERSON.blend.other[:vertices], PERSON.blend.share[:vertices], PERSON.blend.joint[:vertices]),
        faces_drawn=mesh.faces.copy(),
    )


def large() -> RiggedMesh:
    """More vertices than 16-bit indices reach."""
    mesh, copies = PERSON.mesh, 65537 // len(PERSON.mesh.vertices) + 1
    faces = np.concatenate([mesh.faces, mesh.faces + (copies - 1) * len(mesh.vertices)]).astype(np.int32)
    many = TriangleMesh(np.tile(mesh.vertices, (copies, 1)), faces, np.tile(mesh.uv, (copies, 1)), mesh.texture)
    links = np.tile(PERSON.vertex_link, copies)
    parts = (PERSON.blend.other, PERSON.blend.share, PERSON.blend.joint)
    blend = VertexBlend(*(np.tile(part, copies) for part in parts))
    return dataclasses.replace(PERSON, mesh=many, vertex_link=links, blend=blend, faces_drawn=faces)


def padded(length: int) -> int:
    return (length + 3) // 4 * 4


@pytest.mark.parametrize(
    "mesh", [PERSON, ZIPPERED, large(), *(trimmed(n) for n in (3, 4, 5, 6))], ids=lambda m: str(len(m.vertex_link))
)
def test_pose_message_holds_the_mesh(mesh: RiggedMesh) -> None:
    message = page_messages.encode_pose(mesh)
    version, kind, zero, pose_id, vertices, faces = struct.unpack_from("<BBHIII", message)
    assert (version, kind, zero, pose_id) == (page_messages.VERSION, page_messages.POSE, 0, 7)
    assert (vertices, faces) == (len(mesh.mesh.vertices), len(mesh.faces_drawn))
    box_min, box_size = np.frombuffer(message, "<f4", 6, 16).reshape(2, 3)
    quantized = np.frombuffer(message, "<u2", 3 * vertices, 40).reshape(-1, 3)
    uv_offset = 40 + padded(6 * vertices)
    uv = np.frombuffer(message, "<u2", 2 * vertices, uv_offset).reshape(-1, 2) / 65535
    skin = np.frombuffer(message, np.uint8, 4 * vertices, uv_offset + 4 * vertices).reshape(-1, 4)
    joints = np.frombuffer(message, "<f4", 3 * LINK_COUNT, uv_offset + 8 * vertices).reshape(-1, 3)
    index_offset = uv_offset + 8 * vertices + 12 * LINK_COUNT
    index_type = np.dtype("<u2" if vertices <= 65536 else "<u4")
    index = np.frombuffer(message, index_type, 3 * faces, index_offset).reshape(-1, 3)
    jpeg = message[index_offset + padded(3 * faces * index_type.itemsize) :]
    texture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)

    assert np.abs(box_min + box_size * (quantized / 65535) - mesh.mesh.vertices).max() < 2e-5  # half a step of 1.9 m
    assert np.abs(uv - mesh.mesh.uv).max() < 1e-5
    blend = mesh.blend
    np.testing.assert_array_equal(skin, np.stack([mesh.vertex_link, blend.other, blend.joint, blend.share], axis=1))
    np.testing.assert_array_equal(joints, captured_joints(mesh))
    np.testing.assert_array_equal(index, mesh.faces_drawn)
    assert texture is not None
    assert texture.shape == mesh.mesh.texture.shape
    assert cv2.PSNR(texture, mesh.mesh.texture) > 40  # hard edges between flat colours ring a little in a JPEG


def test_texture_keeps_the_colour_of_single_pixels() -> None:
    stripes = np.tile(np.array([[200, 60, 60], [60, 60, 200]], np.uint8), (16, 16, 1))
    mesh = dataclasses.replace(PERSON, mesh=dataclasses.replace(PERSON.mesh, texture=stripes))
    message = page_messages.encode_pose(mesh)
    texture = cv2.imdecode(np.frombuffer(message[message.index(b"\xff\xd8\xff") :], np.uint8), cv2.IMREAD_COLOR_RGB)
    assert texture is not None
    assert np.abs(texture.astype(int) - stripes).max() < 20  # chroma at half resolution would give violet


def test_flat_mesh_keeps_its_plane() -> None:
    flat = PERSON.mesh.vertices.copy()
    flat[:, 1] = 0.5
    mesh = dataclasses.replace(PERSON, mesh=dataclasses.replace(PERSON.mesh, vertices=flat))
    message = page_messages.encode_pose(mesh)
    box_min, box_size = np.frombuffer(message, "<f4", 6, 16).reshape(2, 3)
    y = np.frombuffer(message, "<u2", 3 * len(flat), 40).reshape(-1, 3)[:, 1] / 65535
    np.testing.assert_allclose(box_min[1] + box_size[1] * y, 0.5, atol=1e-5)


@pytest.mark.parametrize(
    "broken",
    [
        dataclasses.replace(PERSON, faces_drawn=np.zeros((0, 3), np.int32)),
        dataclasses.replace(PERSON, vertex_link=PERSON.vertex_link[:-1]),
        dataclasses.replace(PERSON, faces_drawn=np.array([[0, 1, len(PERSON.vertex_link)]], np.int32)),
        dataclasses.replace(PERSON, mesh=dataclasses.replace(PERSON.mesh, uv=PERSON.mesh.uv[1:])),
        dataclasses.replace(PERSON, mesh=dataclasses.replace(PERSON.mesh, texture=np.zeros((8, 8193, 3), np.uint8))),
    ],
    ids=["no face", "a link short", "a face too far", "a uv short", "a texture too wide"],
)
def test_mesh_that_cannot_be_shown_is_refused(broken: RiggedMesh) -> None:
    with pytest.raises(ValueError, match="pose 7"):
        page_messages.encode_pose(broken)


def test_frame_message_holds_the_frame_in_two_thirds_of_a_megabit() -> None:
    frame = shown_frame(PERSON, time_s=1.3, sequence=90)
    frame = dataclasses.replace(frame, confidence=np.linspace(-0.5, 1.5, LINK_COUNT, dtype=np.float32))
    message = page_messages.encode_frame(frame)
    head = struct.unpack_from("<BBHIIfff", message)
    assert head[:5] == (page_messages.VERSION, page_messages.FRAME, 0, 7, 90)
    assert head[5:] == pytest.approx((frame.sigma, frame.fit_confidence, frame.age_ms))
    motion = np.frombuffer(message, "<f4", 12 * LINK_COUNT, 24).reshape(-1, 3, 4)
    joints = np.frombuffer(message, "<f4", 3 * LINK_COUNT, 24 + 48 * LINK_COUNT).reshape(-1, 3)
    confidence = np.frombuffer(message, np.uint8, LINK_COUNT, 24 + 108 * LINK_COUNT)
    np.testing.assert_array_equal(motion, frame.motion)
    np.testing.assert_array_equal(joints, frame.joints)
    assert (confidence[0], confidence[-1]) == (0, 255)
    assert np.abs(confidence / 255 - np.clip(frame.confidence, 0, 1)).max() < 1 / 255
    assert len(message) % 4 == 0
    assert len(message) * 8 * 30 < 667_000


def test_a_withheld_frame_is_marked() -> None:
    frame = shown_frame(PERSON, time_s=1.3)
    assert page_messages.encode_frame(frame)[2] == 0
    assert page_messages.encode_frame(dataclasses.replace(frame, withheld=True))[2] == 1


def test_frame_without_a_pose_says_so() -> None:
    message = page_messages.encode_frame(shown_frame(None, time_s=0.0))
    assert struct.unpack_from("<I", message, 4)[0] == page_messages.NO_POSE


def test_points_message_holds_the_points_on_their_links() -> None:
    points = link_points(capsule_person(1), every=3)
    message = page_messages.encode_points(points)
    count = len(points)
    version, kind, number, *box, radius = struct.unpack_from("<BBxxI6ff", message)
    assert (version, kind, number) == (page_messages.VERSION, page_messages.POINTS, count)
    assert radius == pytest.approx(0.012)
    position = np.frombuffer(message, "<u2", 3 * count, 36).reshape(-1, 3)
    np.testing.assert_allclose(box[:3] + position * np.array(box[3:]) / 65535, points.positions, atol=2e-5)
    begin = len(message) - 4 * count
    assert begin % 4 == 0
    colour = np.frombuffer(message, np.uint8, 4 * count, begin).reshape(-1, 4)
    np.testing.assert_array_equal(colour[:, :3], points.colours)
    np.testing.assert_array_equal(colour[:, 3], points.links)


def test_no_points_are_a_message_too() -> None:
    assert struct.unpack_from("<BBxxI", page_messages.encode_points(None))[2] == 0


@pytest.mark.parametrize("text", ["", "Points", "mesh ", "x" * 1000])
def test_a_mode_is_one_of_three_or_refused(text: str) -> None:
    assert [page_messages.decode_mode(mode) for mode in get_args(ViewMode)] == ["mesh", "live", "points"]
    with pytest.raises(ValueError, match="wants to show"):
        page_messages.decode_mode(text)


def test_remove_message_names_the_pose() -> None:
    assert page_messages.encode_remove(7) == struct.pack("<BBHI", page_messages.VERSION, page_messages.REMOVE, 0, 7)


def test_status_is_json_even_where_numbers_are_missing() -> None:
    status = ViewerStatus(
        ConnectionState.RECEIVING, "", 29.9, float("nan"), 71_000.0, sigma=float("inf"), region_sigma={"head": 0.5}
    )
    figures = json.loads(page_messages.encode_status(status), parse_constant=pytest.fail)
    assert figures["kind"] == "status"
    assert figures["connection"] == "receiving"
    assert figures["skeleton_bps"] == 71_000.0
    assert figures["pose_age_ms"] is None
    assert figures["sigma"] is None
    assert figures["region_sigma"] == {"head": 0.5}


def test_hello_tells_the_link_tree() -> None:
    hello = json.loads(page_messages.encode_hello("linear", "points"))
    version, parents = page_messages.VERSION, list(LINK_PARENTS)
    assert hello == {
        "kind": "hello", "version": version, "skinning": "linear", "mode": "points", "link_parents": parents
    }  # fmt: skip


@given(st.binary(max_size=16))
def test_acknowledgement_is_four_bytes_or_refused(message: bytes) -> None:
    if len(message) == 4:
        assert page_messages.decode_acknowledgement(message) == int.from_bytes(message, "little")
    else:
        with pytest.raises(ValueError, match="bytes"):
            page_messages.decode_acknowledgement(message)
