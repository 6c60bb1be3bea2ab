"""Serves the page and keeps every browser that shows it up to date.

Nothing is queued for a page. The viewer holds what should be seen now (the repository's poses, the newest frame, the
newest status); each page's own task sends the difference between that and what the page has, and never has more than
a few messages under way. So a slow page skips frames, a late one catches up by itself, and memory is bounded by the
repository. A pose is encoded on a thread when the first page lacks it; without a page none is.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from aiohttp import WSCloseCode, WSMsgType, web

from common.body.skinning import Skinning
from receiver.viewer.page_messages import (
    ALONE,
    decode_acknowledgement,
    decode_mode,
    encode_frame,
    encode_hello,
    encode_live,
    encode_points,
    encode_pose,
    encode_remove,
    encode_status,
)
from receiver.viewer.viewer import ShownFrame, ViewerStatus, ViewMode

if TYPE_CHECKING:
    from common.body.link_points import LinkPoints
    from common.body.live_surface import LiveSurface
    from common.body.rigged_mesh import RiggedMesh

log = logging.getLogger(__name__)

PAGE_FOLDER = Path(__file__).parent / "web" / "dist"
LOOPBACK_HOSTS = frozenset({"localhost", "127.0.0.1", "::1"})
MESSAGES_UNDER_WAY = 4  # 130 ms of frames: enough for a round trip, too few to become stale in a socket's buffer
HEARTBEAT_S = 10.0  # a page that answers no ping within half of it is disconnected; it dials again by itself
CLOSE_LIMIT_S = 0.5
PAGES_MAX = 16

_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; connect-src 'self'; style-src 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
_FILE_TYPES = {"index.html": "text/html", "app.js": "text/javascript", "app.css": "text/css"}


class WebViewer:
    """A ``Viewer`` whose screens are browsers. All methods are called on the event loop.

    ``allowed_hosts``: names a browser may use for this server besides the loopback ones, as ``telepose.lan``.
    ``skinning``: how meshes bend at their joints. ``mode``: what a page shows until somebody switches.
    """

    def __init__(
        self,
        page_folder: Path = PAGE_FOLDER,
        allowed_hosts: Iterable[str] = (),
        heartbeat_s: float = HEARTBEAT_S,
        skinning: Skinning = "spherical",
        mode: ViewMode = "mesh",
    ) -> None:
        self._page_folder = page_folder
        self._allowed_hosts = LOOPBACK_HOSTS | frozenset(allowed_hosts)
        self._heartbeat_s = heartbeat_s
        self._skinning: Skinning = skinning
        self._poses: dict[int, _HeldPose] = {}
        self._mode: ViewMode = mode
        self._points: LinkPoints | None = None
        self._points_message: bytes | None = None  # of these points, once a page needed it
        self._frame: bytes | None = None
        self._surfaces: tuple[LiveSurface, ...] = ()  # of that frame
        self._surface_messages: dict[LiveSurface, bytes] = {}  # of these, once a page needed them
        self._pose_on_screen: int | None = None
        self._status = encode_status(ViewerStatus())
        self._pages: set[_Page] = set()

    @property
    def page_count(self) -> int:
        """Browsers connected now."""
        return len(self._pages)

    @property
    def wants_points(self) -> bool:
        """Whether a page shows points."""
        return any(page.mode == "points" for page in self._pages)

    @property
    def wants_live(self) -> bool:
        """Whether a page shows a mesh that follows maps."""
        return any(page.mode == "live" for page in self._pages)

    @property
    def wants_poses(self) -> bool:
        """Whether a page shows meshes; while there is none, whoever comes may."""
        return not self._pages or any(page.mode != "points" for page in self._pages)

    def add_pose(self, mesh: RiggedMesh) -> None:
        """Uploads the mesh to every page once; one that cannot be shown (too large a texture) is logged."""
        self._poses[mesh.pose_id] = _HeldPose(mesh)
        for page in self._pages:
            page.poses.discard(mesh.pose_id)  # sent again if the id is used again
        self._wake()

    def remove_pose(self, pose_id: int) -> None:
        """Frees the mesh on every page."""
        self._poses.pop(pose_id, None)
        self._wake()

    def show_points(self, points: LinkPoints | None) -> None:
        """Newest wins, as with frames, for pages that show points."""
        self._points, self._points_message = points, None
        self._wake()

    def show(self, frame: ShownFrame) -> None:
        """Newest wins: a page that is not ready for this frame will get a later one."""
        self._frame = encode_frame(frame)
        messages = self._surface_messages
        self._surfaces = frame.surfaces
        self._surface_messages = {surface: messages[surface] for surface in frame.surfaces if surface in messages}
        self._pose_on_screen = frame.pose_id
        self._wake()

    def set_status(self, status: ViewerStatus) -> None:
        """The HUD's figures; newest wins."""
        self._status = encode_status(status)
        self._wake()

    def add_routes(self, app: web.Application) -> None:
        """Adds the page and its WebSocket to the daemon's application; its shutdown disconnects the pages."""
        app.router.add_get("/", self._serve_page)
        app.router.add_get("/{file:app\\.(?:js|css)}", self._serve_page)
        app.router.add_get("/ws", self._serve_socket)
        app.on_shutdown.append(self._disconnect)

    def _wake(self) -> None:
        for page in self._pages:
            page.wake.set()

    async def _disconnect(self, _: web.Application) -> None:
        closing = (page.socket.close(code=WSCloseCode.GOING_AWAY) for page in self._pages)
        await asyncio.gather(*closing, return_exceptions=True)

    async def _serve_page(self, request: web.Request) -> web.StreamResponse:
        self._check_host(request)
        name = request.match_info.get("file", "index.html")
        file = self._page_folder / name
        if not file.is_file():
            raise web.HTTPServiceUnavailable(text="The page is not built. Run ./scripts/setup and try again.\n")
        return web.FileResponse(file, headers={**_HEADERS, "Content-Type": f"{_FILE_TYPES[name]}; charset=utf-8"})

    async def _serve_socket(self, request: web.Request) -> web.WebSocketResponse:
        self._check_host(request)
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != request.headers.get("Host"):
            raise web.HTTPForbidden(text="This page may only be opened from its own address.\n")
        if len(self._pages) >= PAGES_MAX:
            raise web.HTTPServiceUnavailable(text=f"{PAGES_MAX} pages are open already.\n")
        socket = web.WebSocketResponse(
            max_msg_size=64, heartbeat=self._heartbeat_s, timeout=CLOSE_LIMIT_S, compress=False
        )
        await socket.prepare(request)
        page = _Page(socket, self._mode)
        self._pages.add(page)
        sending = asyncio.create_task(self._keep_up_to_date(page))
        try:
            await page.read_acknowledgements()
        finally:
            self._pages.discard(page)
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
        return socket

    def _check_host(self, request: web.Request) -> None:
        """Refuses names that are not ours, so that no foreign site can point its own name here (DNS rebinding)."""
        try:
            name = urlsplit(f"//{request.headers.get('Host', '')}").hostname
        except ValueError:
            name = None
        if name not in self._allowed_hosts:
            raise web.HTTPForbidden(text="This name is not in the receiver's list of allowed hosts.\n")

    async def _keep_up_to_date(self, page: _Page) -> None:
        """Sends the page what it lacks, for as long as it is there."""
        try:
            await page.socket.send_str(encode_hello(self._skinning, self._mode))
            while True:
                page.wake.clear()
                if page.under_way >= MESSAGES_UNDER_WAY or not await self._send_difference(page):
                    await page.wake.wait()
        except ConnectionError:
            pass  # the reading side sees the same end and tidies up

    async def _send_difference(self, page: _Page) -> bool:
        """One round: what left, the newest figures, at most one mesh and one LIVE, the newest frame. False if nothing
        was due."""
        sent_before = page.sent
        for pose_id in page.poses - self._poses.keys():
            page.poses.discard(pose_id)
            page.surfaces.pop(pose_id, None)
            await page.send(encode_remove(pose_id))
        if page.status is not self._status:
            page.status = self._status
            await page.socket.send_str(page.status)
        missing = self._next_missing(page)
        message = None if missing is None else self._pose_message(missing)
        if missing is not None and message is not None:
            page.poses.add(missing)
            await page.send(message)
        if page.mode == "points" and page.points is not self._points:
            page.points = self._points
            self._points_message = self._points_message or encode_points(self._points)
            await page.send(self._points_message)
        frame, surface = self._frame, self._next_surface(page)
        if surface is not None:
            page.surfaces[surface.pose_id] = surface
            await page.send(self._surface_message(surface))
        if frame is not None and page.frame is not frame:
            page.frame = frame
            await page.send(frame)
        return page.sent > sent_before

    def _next_surface(self, page: _Page) -> LiveSurface | None:
        """What the page lacks of what maps show beyond the poses it draws and has, the best pose first."""
        if page.mode != "live":
            return None
        for surface in self._surfaces[:1] if page.alone else self._surfaces:
            if surface.pose_id in page.poses and page.surfaces.get(surface.pose_id) is not surface:
                return surface
        return None

    def _surface_message(self, surface: LiveSurface) -> bytes:
        if surface not in self._surface_messages:
            self._surface_messages[surface] = encode_live(surface)
        return self._surface_messages[surface]

    def _next_missing(self, page: _Page) -> int | None:
        """The pose to upload next: the one on screen first, then the newest."""
        missing = self._poses.keys() - page.poses
        return self._pose_on_screen if self._pose_on_screen in missing else max(missing, default=None)

    def _pose_message(self, pose_id: int) -> bytes | None:
        """The POSE message; None until it is encoded, which the first call starts and whose end wakes the pages."""
        pose = self._poses[pose_id]
        if pose.encoding is None:
            pose.encoding = asyncio.create_task(asyncio.to_thread(encode_pose, pose.mesh))
            pose.encoding.add_done_callback(lambda _: self._wake())
        if not pose.encoding.done():
            return None
        try:
            return pose.encoding.result()
        except ValueError as error:
            log.warning("a pose is not shown: %s", error)
            del self._poses[pose_id]
            self._wake()  # for the next one
            return None


@dataclass(slots=True, eq=False)
class _HeldPose:
    """A pose of the repository, and its message once a page lacked it."""

    mesh: RiggedMesh
    encoding: asyncio.Task[bytes] | None = None


class _Page:
    """One browser: what it shows, what it has, and how many messages are under way to it."""

    def __init__(self, socket: web.WebSocketResponse, mode: ViewMode) -> None:
        self.socket = socket
        self.mode = mode
        self.points: LinkPoints | None = None
        self.alone = False  # it draws the best pose alone
        self.surfaces: dict[int, LiveSurface] = {}  # the newest it has, by pose
        self.wake = asyncio.Event()
        self.poses: set[int] = set()
        self.frame: bytes | None = None
        self.status: str | None = None
        self.sent = 0
        self._taken_in = 0

    @property
    def under_way(self) -> int:
        return self.sent - self._taken_in

    async def send(self, message: bytes) -> None:
        self.sent += 1
        await self.socket.send_bytes(message)

    async def read_acknowledgements(self) -> None:
        """Until the page leaves, or says something this protocol has no word for."""
        async for message in self.socket:
            try:
                if message.type is WSMsgType.TEXT:
                    if message.data == ALONE:
                        self.alone = True
                    else:
                        self.mode = decode_mode(message.data)
                    self.wake.set()
                    continue
                if message.type is not WSMsgType.BINARY:
                    raise ValueError(f"a {message.type.name} message")
                taken_in = decode_acknowledgement(message.data)
                if not self._taken_in <= taken_in <= self.sent:
                    raise ValueError(f"{taken_in} messages taken in, of {self.sent} sent")
            except ValueError as error:
                log.warning("a page was disconnected: %s", error)
                await self.socket.close(code=WSCloseCode.PROTOCOL_ERROR)
                return
            self._taken_in = taken_in
            self.wake.set()
