"""The web viewer against pages made here: what they are sent, when, and who is turned away."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import struct
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer

from common.body.live_surface import LiveSurface
from common.body.map_layout import map_layout
from common.body.rigged_mesh import RiggedMesh
from receiver.viewer import page_messages, web_viewer
from receiver.viewer.page_messages import FRAME, LIVE, POINTS, POSE, REMOVE
from receiver.viewer.viewer import ConnectionState, MovedPose, ViewerStatus
from receiver.viewer.web_viewer import MESSAGES_UNDER_WAY, WebViewer
from tests.capsule_person import SKELETON, capsule_person, link_points, shown_frame

LIMIT_S = 10.0
PERSON = capsule_person(pose_id=1)


class Served:
    """A viewer behind a real server, and a client to reach it."""

    def __init__(self, viewer: WebViewer, server: TestServer, session: aiohttp.ClientSession) -> None:
        self.viewer, self.server, self.session = viewer, server, session

    def get(self, path: str, **headers: str) -> Any:
        return self.session.get(self.server.make_url(path), headers=headers)

    @asynccontextmanager
    async def page(self, acknowledge: bool = True, **headers: str) -> AsyncIterator[FakePage]:
        url = self.server.make_url("/ws")
        async with self.session.ws_connect(url, headers=headers, max_msg_size=0, autoping=acknowledge) as socket:
            yield FakePage(socket, acknowledge)


class FakePage:
    """Reads messages as a browser does: ``(kind, pose id or sequence)`` of binary ones, the JSON of text ones."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse, acknowledge: bool) -> None:
        self.socket = socket
        self._acknowledge = acknowledge
        self._taken_in = 0

    async def next(self) -> dict[str, Any] | tuple[int, int]:
        message = await self.socket.receive(LIMIT_S)
        if message.type is aiohttp.WSMsgType.TEXT:
            text: dict[str, Any] = json.loads(message.data)
            return text
        assert message.type is aiohttp.WSMsgType.BINARY, message
        if self._acknowledge:
            await self.acknowledge(1)
        kind, pose_id, sequence = struct.unpack_from("<xBxxII", message.data + bytes(4))
        return kind, sequence if kind == FRAME else pose_id

    async def acknowledge(self, count: int) -> None:
        self._taken_in += count
        await self.socket.send_bytes(struct.pack("<I", self._taken_in))

    async def binaries(self, count: int) -> list[tuple[int, int]]:
        found: list[tuple[int, int]] = []
        while len(found) < count:
            message = await self.next()
            if isinstance(message, tuple):
                found.append(message)
        return found

    async def silent(self) -> bool:
        """Nothing binary comes for a while."""
        try:
            message = await self.socket.receive(0.1)
        except TimeoutError:
            return True
        return message.type is not aiohttp.WSMsgType.BINARY and await self.silent()


@asynccontextmanager
async def serve(viewer: WebViewer | None = None) -> AsyncIterator[Served]:
    viewer = viewer or WebViewer()
    app = web.Application()
    viewer.add_routes(app)
    async with TestServer(app) as server, aiohttp.ClientSession() as session:
        yield Served(viewer, server, session)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.01)


def built_page(folder: Path) -> Path:
    for name in ("index.html", "app.js", "app.css"):
        (folder / name).write_text(f"this is {name}")
    return folder


async def test_page_is_served_with_a_policy_for_its_own_files_alone(tmp_path: Path) -> None:
    async with serve(WebViewer(built_page(tmp_path))) as served:
        for path, name, kind in (
            ("/", "index.html", "text/html"),
            ("/app.js", "app.js", "text/javascript"),
            ("/app.css", "app.css", "text/css"),
        ):
            async with served.get(path) as answer:
                assert (answer.status, await answer.text()) == (200, f"this is {name}")
                assert answer.content_type == kind
                assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        async with served.get("/package.json") as answer:
            assert answer.status == 404


async def test_page_that_was_not_built_says_what_to_do(tmp_path: Path) -> None:
    async with serve(WebViewer(tmp_path)) as served, served.get("/") as answer:
        assert answer.status == 503
        assert "./scripts/setup" in await answer.text()


@pytest.mark.parametrize("path", ["/", "/app.js", "/ws"])
@pytest.mark.parametrize("host", ["telepose.example", "127.0.0.1.example:8080", "", "[::1"])
async def test_foreign_names_are_turned_away(tmp_path: Path, path: str, host: str) -> None:
    async with serve(WebViewer(built_page(tmp_path))) as served, served.get(path, Host=host) as answer:
        assert answer.status in (400, 403)


async def test_names_in_the_settings_are_welcome(tmp_path: Path) -> None:
    viewer = WebViewer(built_page(tmp_path), allowed_hosts=["telepose.example"])
    async with serve(viewer) as served, served.get("/", Host="telepose.example:8080") as answer:
        assert answer.status == 200


async def test_pages_of_other_sites_get_no_socket() -> None:
    async with serve() as served:
        own = str(served.server.make_url("")).rstrip("/")
        async with served.page(Origin=own) as page:
            assert (await page.next())["kind"] == "hello"  # type: ignore[call-overload]
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            async with served.page(Origin="http://other.example"):
                pass


async def test_late_page_gets_what_is_there_now() -> None:
    async with serve() as served:
        served.viewer.add_pose(capsule_person(1))
        served.viewer.add_pose(capsule_person(2))
        served.viewer.add_pose(capsule_person(3))
        served.viewer.remove_pose(3)
        served.viewer.set_status(ViewerStatus(ConnectionState.RECEIVING, repository_poses=2))
        for sequence in range(5):
            served.viewer.show(shown_frame(PERSON, 0.1 * sequence, sequence))
        async with served.page() as page:
            hello, status = await page.next(), await page.next()
            assert isinstance(hello, dict)
            assert isinstance(status, dict)
            assert (hello["kind"], hello["version"]) == ("hello", page_messages.VERSION)
            assert (status["connection"], status["repository_poses"]) == ("receiving", 2)
            binaries = await page.binaries(3)
            assert sorted(binaries) == [(POSE, 1), (POSE, 2), (FRAME, 4)]
            assert binaries.index((POSE, 1)) < binaries.index((POSE, 2))  # what is on screen comes first
            assert await page.silent()


async def test_mesh_is_uploaded_once_and_removed_once() -> None:
    async with serve() as served, served.page() as page:
        served.viewer.add_pose(PERSON)
        assert await page.binaries(1) == [(POSE, 1)]
        for sequence in range(3):
            served.viewer.show(shown_frame(PERSON, 0.0, sequence))
            assert await page.binaries(1) == [(FRAME, sequence)]
        served.viewer.remove_pose(1)
        assert await page.binaries(1) == [(REMOVE, 1)]
        assert await page.silent()


async def test_points_go_to_pages_that_show_them_newest_first() -> None:
    async with serve() as served, served.page() as of_mesh, served.page() as of_points:
        assert not served.viewer.wants_points
        await of_points.socket.send_str("points")
        assert served.viewer.wants_poses  # of the other page
        await until(lambda: served.viewer.wants_points)
        for every in (2, 3):
            served.viewer.show_points(link_points(PERSON, every))
        kind, count = (await of_points.binaries(1))[0]
        assert (kind, count) == (POINTS, len(link_points(PERSON, 3)))
        served.viewer.show(shown_frame(PERSON, 0.0, 5))
        assert await of_points.binaries(1) == [(FRAME, 5)]
        assert await of_mesh.binaries(1) == [(FRAME, 5)]
        served.viewer.show_points(None)
        assert await of_points.binaries(1) == [(POINTS, 0)]
        await of_points.socket.send_str("mesh")
        await until(lambda: not served.viewer.wants_points)


async def test_while_all_pages_show_points_no_poses_are_wanted() -> None:
    async with serve() as served:
        assert served.viewer.wants_poses  # for whoever comes
        async with served.page() as page:
            await page.socket.send_str("points")
            await until(lambda: not served.viewer.wants_poses)
            await page.socket.send_str("live")
            await until(lambda: served.viewer.wants_poses)


async def test_what_maps_show_goes_once_to_pages_that_show_it_before_its_frame() -> None:
    layout = map_layout(SKELETON, 1000, 25.0)
    offsets = np.full((layout.height, layout.width, 4), 128, np.uint8)
    frame = shown_frame(PERSON, 0.0, 5)
    frame = dataclasses.replace(frame, surfaces=(LiveSurface(1, layout, offsets),), live=0.5)
    async with serve() as served, served.page() as of_mesh, served.page() as live:
        await live.socket.send_str("live")
        await until(lambda: served.viewer.wants_live)
        served.viewer.show(frame)
        assert await live.binaries(1) == [(FRAME, 5)]  # it does not have the pose
        served.viewer.add_pose(PERSON)
        assert await live.binaries(2) == [(POSE, 1), (LIVE, 1)]
        served.viewer.show(dataclasses.replace(frame, sequence=6))
        assert await live.binaries(1) == [(FRAME, 6)]
        assert await of_mesh.binaries(3) == [(FRAME, 5), (POSE, 1), (FRAME, 6)]
        await live.socket.send_str("mesh")
        await until(lambda: not served.viewer.wants_live)


@pytest.mark.parametrize("alone", [False, True])
async def test_of_several_poses_what_maps_show_comes_one_a_round_and_goes_with_the_pose(alone: bool) -> None:
    layout = map_layout(SKELETON, 1000, 25.0)
    offsets = np.full((layout.height, layout.width, 4), 128, np.uint8)
    frame = shown_frame(PERSON, 0.0, 5)
    assert frame.motion is not None
    surfaces = tuple(LiveSurface(pose_id, layout, offsets) for pose_id in (1, 2))
    frame = dataclasses.replace(frame, others=(MovedPose(2, frame.motion),), surfaces=surfaces, live=1.0)
    async with serve() as served, served.page() as page:
        await page.socket.send_str("live")
        if alone:
            await page.socket.send_str("alone")
        await until(lambda: served.viewer.wants_live)
        for mesh in (PERSON, capsule_person(2)):
            served.viewer.add_pose(mesh)
            assert await page.binaries(1) == [(POSE, mesh.pose_id)]
        served.viewer.show(frame)
        seen = [(LIVE, 1), (FRAME, 5)] if alone else [(LIVE, 1), (FRAME, 5), (LIVE, 2)]
        assert await page.binaries(len(seen)) == seen
        newer = (surfaces[0], LiveSurface(2, layout, offsets))
        served.viewer.show(dataclasses.replace(frame, sequence=6, surfaces=newer))
        seen = [(FRAME, 6)] if alone else [(LIVE, 2), (FRAME, 6)]
        assert await page.binaries(len(seen)) == seen
        served.viewer.remove_pose(1)
        assert await page.binaries(1) == [(REMOVE, 1)]
        served.viewer.add_pose(PERSON)
        assert await page.binaries(2) == [(POSE, 1), (LIVE, 1)]


async def test_pose_id_used_again_is_uploaded_again() -> None:
    async with serve() as served, served.page() as page:
        served.viewer.add_pose(PERSON)
        assert await page.binaries(1) == [(POSE, 1)]
        served.viewer.remove_pose(1)
        served.viewer.add_pose(capsule_person(1))
        assert await page.binaries(1) == [(POSE, 1)]


async def test_pose_is_encoded_once_when_the_first_page_needs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    encoded_on = []

    def encode(mesh: RiggedMesh) -> bytes:
        encoded_on.append(threading.current_thread())
        return page_messages.encode_pose(mesh)

    monkeypatch.setattr(web_viewer, "encode_pose", encode)
    async with serve() as served:
        served.viewer.add_pose(PERSON)
        served.viewer.show(shown_frame(PERSON, 0.0))
        await asyncio.sleep(0.05)
        assert encoded_on == []
        for _ in range(2):
            async with served.page() as page:
                assert (POSE, 1) in await page.binaries(2)
        assert len(encoded_on) == 1
        assert encoded_on[0] is not threading.current_thread()


async def test_frames_do_not_wait_for_a_pose_that_is_being_encoded(monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()

    def encode(mesh: RiggedMesh) -> bytes:
        assert go_on.wait(LIMIT_S)
        return page_messages.encode_pose(mesh)

    monkeypatch.setattr(web_viewer, "encode_pose", encode)
    async with serve() as served, served.page() as page:
        served.viewer.add_pose(PERSON)
        served.viewer.add_pose(capsule_person(2))
        for sequence in range(3):
            served.viewer.show(shown_frame(PERSON, 0.0, sequence))
            assert await page.binaries(1) == [(FRAME, sequence)]
        served.viewer.remove_pose(2)  # it leaves while it is encoded: no page hears of it
        go_on.set()
        assert await page.binaries(1) == [(POSE, 1)]
        assert await page.silent()


async def test_pose_that_cannot_be_shown_is_left_out_and_the_others_come(caplog: pytest.LogCaptureFixture) -> None:
    wide = dataclasses.replace(PERSON.mesh, texture=np.zeros((8, 8193, 3), np.uint8))
    async with serve() as served, served.page() as page:
        served.viewer.add_pose(dataclasses.replace(PERSON, pose_id=9, mesh=wide))
        served.viewer.add_pose(PERSON)
        assert await page.binaries(1) == [(POSE, 1)]
        assert "pose 9" in caplog.text


async def test_slow_page_skips_to_the_newest_frame_and_delays_nobody() -> None:
    async with serve() as served, served.page(acknowledge=False) as slow, served.page() as quick:
        await until(lambda: served.viewer.page_count == 2)
        for sequence in range(20):
            served.viewer.show(shown_frame(None, 0.0, sequence))
            assert await quick.binaries(1) == [(FRAME, sequence)]
        assert await slow.binaries(MESSAGES_UNDER_WAY) == [(FRAME, s) for s in range(MESSAGES_UNDER_WAY)]
        assert await slow.silent()
        await slow.acknowledge(MESSAGES_UNDER_WAY)
        assert await slow.binaries(1) == [(FRAME, 19)]


@pytest.mark.parametrize("nonsense", [b"", b"12345", struct.pack("<I", 99), "text", bytes(1000)], ids=repr)
async def test_page_that_talks_nonsense_is_disconnected(nonsense: bytes | str) -> None:
    async with serve() as served, served.page() as page:
        assert isinstance(await page.next(), dict)
        await (page.socket.send_str(nonsense) if isinstance(nonsense, str) else page.socket.send_bytes(nonsense))
        await until(lambda: page.socket.closed or page.socket.close_code is not None or served.viewer.page_count == 0)
        assert served.viewer.page_count == 0


async def test_page_that_answers_no_ping_is_disconnected() -> None:
    async with serve(WebViewer(heartbeat_s=0.2)) as served, served.page(acknowledge=False):
        await until(lambda: served.viewer.page_count == 1)
        await until(lambda: served.viewer.page_count == 0)


async def test_there_is_an_end_to_the_number_of_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_viewer, "PAGES_MAX", 1)
    async with serve() as served, served.page():
        await until(lambda: served.viewer.page_count == 1)
        with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
            async with served.page():
                pass


async def test_pages_are_told_when_the_receiver_ends() -> None:
    async with serve() as served, served.page() as page:
        await until(lambda: served.viewer.page_count == 1)
        closing = asyncio.create_task(served.server.close())
        while (message := await page.socket.receive(LIMIT_S)).type is aiohttp.WSMsgType.TEXT:
            pass
        assert (message.type, message.data) == (aiohttp.WSMsgType.CLOSE, aiohttp.WSCloseCode.GOING_AWAY)
        await closing
        assert served.viewer.page_count == 0
