"""The built page in a real browser (Debian's chromium, drawing in software): what a person would see."""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import get_args

import numpy as np
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer, unused_port
from numpy.typing import NDArray

from common.body.body_regions import REGION_COUNT
from common.body.cylindrical_map import closed, project_points
from common.body.live_surface import live_surface, vertex_colours
from common.body.map_layout import map_layout
from common.body.rigged_mesh import RiggedMesh, build_rigged_mesh
from common.body.skeleton_pose import forward_kinematics
from common.body.skinning import Skinning, animate
from common.body.view import View
from common.geometry.camera_model import Camera
from common.geometry.rasterizer import render
from common.geometry.rigid_transform import look_at
from receiver.viewer.offscreen_viewer import OffscreenViewer
from receiver.viewer.viewer import ConnectionState, MovedPose, ShownFrame, ViewerStatus, ViewMode
from receiver.viewer.web_viewer import PAGE_FOLDER, WebViewer
from tests.capsule_person import (
    SHIRT,
    SKELETON,
    SKIN,
    TROUSERS,
    capsule_person,
    link_points,
    pose_at,
    shown_frame,
)  # fmt: skip
from tests.changing_shirt import RED, SHIRT_LINKS
from tests.chromium import Page, find_chromium, open_page

pytestmark = [
    pytest.mark.skipif(find_chromium() is None, reason="no chromium here (Debian: apt-get install chromium)"),
    pytest.mark.skipif(not (PAGE_FOLDER / "index.html").is_file(), reason="the page is not built (./scripts/setup)"),
]

RECEIVING = ViewerStatus(
    ConnectionState.RECEIVING,
    frame_rate_hz=30,
    skeleton_bps=71_300,
    bulk_bps=1_913_000,
    repository_poses=12,
    chosen_pose=7,
    sigma=0.0314,
    region_sigma={"head": 0.01, "left_forearm": 0.52, "right_thumb": 0.2},
)
STATE = "document.body.dataset.state"
HEADLINE = "document.getElementById('banner-title').textContent"


def figure(name: str) -> str:
    return f"document.querySelector('[data-figure={name}]').textContent"


@asynccontextmanager
async def receiver(
    port: int | None = None, skinning: Skinning = "spherical", mode: ViewMode = "mesh"
) -> AsyncIterator[tuple[WebViewer, str]]:
    """A viewer and the address of its page."""
    viewer = WebViewer(skinning=skinning, mode=mode)
    app = web.Application()
    viewer.add_routes(app)
    async with TestServer(app, port=port) as server:
        yield viewer, str(server.make_url("/"))


@asynccontextmanager
async def person_moving(viewer: WebViewer) -> AsyncIterator[None]:
    """Shows the capsule person at 30 frames a second."""
    person = capsule_person(pose_id=7)

    async def move() -> None:
        for sequence in itertools.count():
            viewer.show(shown_frame(person, sequence / 30, sequence))
            await asyncio.sleep(1 / 30)

    viewer.add_pose(person)
    viewer.set_status(RECEIVING)
    moving = asyncio.create_task(move())
    try:
        yield
    finally:
        moving.cancel()


def coloured(picture: NDArray[np.uint8], rgb: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Pixels (H, W) of that colour as it was sent, but for what JPEG changes."""
    return (np.abs(picture.astype(int) - rgb) <= 4).all(axis=2)


async def photograph_when(page: Page, accept: Callable[[NDArray[np.uint8]], object]) -> NDArray[np.uint8]:
    """The first picture that is accepted."""
    async with asyncio.timeout(30):
        while not accept(picture := await page.photograph()):  # noqa: ASYNC110
            await asyncio.sleep(0.1)
    return picture


@pytest.mark.parametrize(("width", "height", "phone"), [(1000, 700, False), (390, 844, True)], ids=["desktop", "phone"])
async def test_person_moves_on_the_canvas(width: int, height: int, phone: bool) -> None:
    async with receiver() as (viewer, url), person_moving(viewer), open_page(url, width, height, phone) as page:
        await page.wait_for(STATE, lambda state: state == "receiving")
        first = await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
        for rgb in (SHIRT, SKIN, TROUSERS):
            assert coloured(first, rgb).sum() > 0.002 * width * height
        rows, columns = np.nonzero(coloured(first, SHIRT) | coloured(first, SKIN) | coloured(first, TROUSERS))
        assert 0 < columns.min() < columns.max() < width - 1  # all of the person is in the picture
        assert 0 < rows.min() < rows.max() < height - 1
        arms = coloured(first, SKIN)
        await photograph_when(page, lambda p: (coloured(p, SKIN) ^ arms).sum() > 200)  # they have moved
        assert page.problems == []


def captured_person(pose_id: int) -> RiggedMesh:
    """The person as four depth cameras see them: views with seams, occlusions and an atlas."""
    person = capsule_person(0)
    views = []
    for angle in np.arange(4) * np.pi / 2:
        eye = np.array([2.4 * np.sin(angle), 1.2, 2.4 * np.cos(angle)])
        camera = Camera(f"{angle:.1f}", 320, 240, 230.0, 230.0, 159.5, 119.5, look_at(eye, np.array([0.0, 0.9, 0.0])))
        colour, depth = render(person.mesh.vertices, person.faces_drawn, person.mesh.surface, camera)
        views.append(View(camera, 0, 0, np.rint(1000 * depth).astype(np.uint16), colour))
    return build_rigged_mesh(pose_id, 0, person.skeleton, person.pose, views)


@pytest.mark.parametrize("person", [capsule_person(7), captured_person(7)], ids=["one surface", "captured views"])
@pytest.mark.parametrize("skinning", get_args(Skinning))
async def test_page_and_offscreen_renderer_agree(skinning: Skinning, person: RiggedMesh) -> None:
    """The same mesh, bent far, by the page's vertex shader and by the offscreen renderer, from the page's camera."""
    frame = shown_frame(person, 2.3)
    async with receiver(skinning=skinning) as (viewer, url), open_page(url, 800, 600) as page:
        viewer.add_pose(person)
        viewer.set_status(RECEIVING)
        viewer.show(frame)
        await page.press("h")
        picture = await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
        camera = await camera_of(page, 800, 600)
    offscreen = OffscreenViewer(skinning)
    offscreen.add_pose(person)
    offscreen.show(frame)
    expected = offscreen.render([camera])[0][0]
    assert difference_db(picture, expected) >= 35
    assert page.problems == []


async def test_page_and_offscreen_renderer_agree_on_several_poses_mean() -> None:
    """Two poses whose colours are each other's inverse: their mean is grey. Without a GPU only if asked for."""
    person = captured_person(7)
    inverse = dataclasses.replace(person.mesh, texture=255 - person.mesh.texture)
    frame = shown_frame(person, 2.3)
    assert frame.motion is not None
    frame = dataclasses.replace(frame, others=(MovedPose(8, frame.motion),))
    async with receiver() as (viewer, url):
        viewer.add_pose(person)
        viewer.add_pose(dataclasses.replace(person, pose_id=8, mesh=inverse))
        viewer.set_status(RECEIVING)
        viewer.show(frame)
        async with open_page(url, 800, 600) as page:
            await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)  # one of them
        async with open_page(url + "?blend", 800, 600) as page:
            await page.press("h")
            picture = await photograph_when(page, lambda p: coloured(p, (127, 127, 127)).sum() > 500)
            camera = await camera_of(page, 800, 600)
            assert page.problems == []
    offscreen = OffscreenViewer()
    offscreen.add_pose(person)
    offscreen.add_pose(dataclasses.replace(person, pose_id=8, mesh=inverse))
    offscreen.show(frame)
    assert difference_db(picture, offscreen.render([camera])[0][0]) >= 35


def following(person: RiggedMesh, time_s: float, strength: float) -> ShownFrame:
    """The person at that time, whose shirt has turned red and is 2 cm wider, in stripes."""
    frame = shown_frame(person, time_s)
    assert frame.motion is not None
    T_world_link = forward_kinematics(SKELETON, pose_at(time_s))
    vertices, colours = animate(person, frame.motion), vertex_colours(person.mesh)
    shirt = np.isin(person.vertex_link, SHIRT_LINKS)
    newer, wider = colours.copy(), vertices.copy()
    newer[shirt & (np.sin(60 * vertices[:, 1]) > 0)] = RED
    wider[shirt] += 0.02 * (vertices[shirt] - vertices[shirt].mean(axis=0)) / 0.15
    layout = map_layout(SKELETON, 10_000, 60.0)
    maps = closed(layout, project_points(layout, T_world_link, person.vertex_link, wider, newer))
    surface = live_surface(person.pose_id, layout, maps, T_world_link, person.vertex_link, vertices, colours)
    return dataclasses.replace(frame, surfaces=(surface,), live=strength)


@pytest.mark.parametrize(("strength", "count"), [(1.0, 1), (0.4, 1), (1.0, 2)])
async def test_page_and_offscreen_renderer_agree_on_a_live_surface(strength: float, count: int) -> None:
    """The same meshes tinted and moved by the page's shaders and by the offscreen renderer; L on the page switches it.
    Of two, whose colours are each other's inverse, both follow."""
    person = captured_person(7)
    inverse = dataclasses.replace(person.mesh, texture=255 - person.mesh.texture)
    meshes = [person, dataclasses.replace(person, pose_id=8, mesh=inverse)][:count]
    frame, *others = [following(mesh, 2.3, strength) for mesh in meshes]
    for other in others:
        assert other.motion is not None
        moved, surfaces = MovedPose(8, other.motion), frame.surfaces + other.surfaces
        frame = dataclasses.replace(frame, others=(moved,), surfaces=surfaces)
    shirt = SHIRT if count == 1 else (127, 127, 127)
    async with receiver() as (viewer, url), open_page(url + "?blend", 800, 600) as page:
        for mesh in meshes:
            viewer.add_pose(mesh)
        viewer.set_status(RECEIVING)
        viewer.show(frame)
        await page.press("h")
        plain = await photograph_when(page, lambda p: coloured(p, shirt).sum() > 500)
        assert not viewer.wants_live
        await page.press("l")
        await until(lambda: viewer.wants_live)
        viewer.show(dataclasses.replace(frame, sequence=1))  # the same pose, and no other mesh
        picture = await photograph_when(page, lambda p: (p != plain).any(axis=2).sum() > 500)
        camera = await camera_of(page, 800, 600)
    errors = {}
    for mode in get_args(ViewMode)[:2]:
        offscreen = OffscreenViewer(mode=mode)
        for mesh in meshes:
            offscreen.add_pose(mesh)
        offscreen.show(frame)
        for name, seen in (("page plain", plain), ("page live", picture)):
            errors[mode, name] = difference_db(seen, offscreen.render([camera])[0][0])
    assert min(errors["live", "page live"], errors["mesh", "page plain"]) >= 35
    assert errors["mesh", "page live"] < errors["live", "page live"]
    assert errors["live", "page plain"] < errors["mesh", "page plain"]
    assert page.problems == []


def difference_db(picture: NDArray[np.uint8], expected: NDArray[np.uint8]) -> float:
    """PSNR of a photograph of the page against a picture on white."""
    room = (picture[..., 0] < 78) & (picture[..., 2] < 112)  # dark grey, as nothing of the person is
    error = (np.where(room[..., None], 255, picture).astype(float) - expected) ** 2
    return float(10 * np.log10(255**2 / error.mean()))


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(5):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.02)


async def test_page_and_offscreen_renderer_agree_on_points() -> None:
    """The same points, moved by the page's vertex shader and drawn as its sprites, and by the offscreen renderer."""
    frame = shown_frame(None, 2.3)
    points = link_points(captured_person(7))
    async with receiver(mode="points") as (viewer, url), open_page(url, 800, 600) as page:
        viewer.set_status(RECEIVING)
        viewer.show_points(points)
        viewer.show(frame)
        await page.press("h")
        picture = await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
        camera = await camera_of(page, 800, 600)
        assert viewer.wants_points
    offscreen = OffscreenViewer(mode="points")
    offscreen.show_points(points)
    offscreen.show(frame)
    expected = offscreen.render([camera])[0][0]
    assert difference_db(picture, expected) >= 40
    assert page.problems == []


async def test_points_are_moved_switched_and_gone() -> None:
    person = captured_person(7)
    note = "document.getElementById('note').textContent"
    async with receiver() as (viewer, url), person_moving(viewer), open_page(url, 800, 600) as page:
        await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
        assert not viewer.wants_points
        await page.press("p")
        await photograph_when(page, lambda p: coloured(p, SHIRT).sum() == 0)
        assert "No points yet" in await page.evaluate(note)
        await until(lambda: viewer.wants_points)
        viewer.show_points(link_points(person))
        first = await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
        await photograph_when(page, lambda p: (coloured(p, SKIN) ^ coloured(first, SKIN)).sum() > 200)  # they move
        assert await page.evaluate(note) == ""
        viewer.show_points(None)
        await photograph_when(page, lambda p: coloured(p, SHIRT).sum() == 0)
        await page.press("p")
        await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
        assert page.problems == []


async def camera_of(page: Page, width: int, height: int) -> Camera:
    """The page's camera as it stands."""

    async def matrix(name: str) -> NDArray[np.float64]:
        elements = await page.evaluate(f"document.getElementById('stage').camera.{name}.elements")
        return np.reshape(elements, (4, 4)).T  # by columns

    focal = height / 2 * (await matrix("projectionMatrix"))[1, 1]
    T_world_camera = await matrix("matrixWorld") @ np.diag([1.0, -1.0, -1.0, 1.0])  # WebGL looks along -z, y up
    return Camera("page", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, T_world_camera)


async def test_page_that_comes_late_shows_the_last_frame() -> None:
    """The frame reaches it before the mesh's texture is decoded, and no other follows."""
    person = capsule_person(pose_id=7)
    async with receiver() as (viewer, url):
        viewer.add_pose(person)
        viewer.set_status(RECEIVING)
        viewer.show(shown_frame(person, 0.0))
        async with open_page(url, 800, 600) as page:
            await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
            viewer.remove_pose(7)
            await photograph_when(page, lambda p: coloured(p, SHIRT).sum() == 0)
            assert page.problems == []


async def test_figures_and_keys() -> None:
    async with receiver() as (viewer, url), person_moving(viewer), open_page(url, 1000, 700) as page:
        await page.wait_for(figure("fps"), lambda text: text.endswith(" fps") and int(text.split()[0]) > 0)
        age = await page.wait_for(figure("age"), lambda text: text.endswith(" ms"))
        assert int(age.split()[0]) >= 42  # the frame's own age, and the time it waited here
        shown = [
            await page.evaluate(figure(name)) for name in ("skeleton", "bulk", "repository", "pose", "sigma", "region")
        ]
        assert shown == ["71.3 kbit/s", "1913 kbit/s", "12 poses", "#7", "0.031", "left forearm 0.520"]

        overlay = (127, 216, 255)
        assert coloured(await page.photograph(), overlay).sum() == 0
        await page.press("s")
        await photograph_when(page, lambda p: coloured(p, overlay).sum() > 50)

        visible = "getComputedStyle(document.getElementById('hud')).display !== 'none'"
        assert await page.evaluate(visible)
        await page.press("h")
        await page.wait_for(f"!({visible})")
        assert page.problems == []


async def test_regions_are_coloured_by_their_distortion() -> None:
    async with receiver() as (viewer, url), person_moving(viewer), open_page(url, 1000, 700) as page:
        strokes = "[...document.querySelectorAll('#regions line')].map((line) => line.getAttribute('stroke'))"
        shown = await page.wait_for(strokes)
        assert len(shown) == REGION_COUNT
        hues = sorted(int(stroke[4:].split()[0]) for stroke in shown if stroke.startswith("hsl"))
        assert hues == [43, 78, 148]  # red for the forearm, green for the head; the others were not seen
        assert page.problems == []


async def test_a_withheld_frame_is_marked_and_the_next_is_not() -> None:
    person = capsule_person(pose_id=7)
    good = shown_frame(person, 0.8)
    mark = "Number(getComputedStyle(document.getElementById('withheld')).opacity)"
    async with receiver() as (viewer, url), open_page(url, 800, 600) as page:
        viewer.add_pose(person)
        viewer.set_status(RECEIVING)
        viewer.show(good)
        await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
        assert await page.evaluate(mark) == 0
        viewer.show(dataclasses.replace(good, withheld=True))
        await page.wait_for(mark, lambda opacity: opacity == 1)
        faded = await page.photograph()
        assert coloured(faded, SHIRT).sum() == 0
        viewer.show(shown_frame(person, 0.9))
        await page.wait_for(mark, lambda opacity: opacity == 0)
        await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
        assert page.problems == []


async def test_waiting_lost_and_back() -> None:
    port = unused_port()
    async with AsyncExitStack() as browser:
        async with receiver(port) as (viewer, url):
            page = await browser.enter_async_context(open_page(url, 800, 600))
            await page.wait_for(HEADLINE, lambda text: text == "Waiting for sender…")
            async with person_moving(viewer):
                await page.wait_for(STATE, lambda state: state == "receiving")
                await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
            viewer.set_status(ViewerStatus(ConnectionState.LOST, "The sender is silent for 3 s."))
            await page.wait_for(HEADLINE, lambda text: text == "Connection lost")
            assert "silent for 3 s" in await page.evaluate("document.getElementById('banner').innerText")
            await photograph_when(page, lambda p: coloured(p, SHIRT).sum() == 0)  # an old picture is grey
        await page.wait_for(STATE, lambda state: state == "disconnected")
        async with receiver(port) as (viewer, _), person_moving(viewer):
            await page.wait_for(STATE, lambda state: state == "receiving")
            await photograph_when(page, lambda p: coloured(p, SHIRT).sum() > 500)
        assert page.problems == []
