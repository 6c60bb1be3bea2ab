"""``telepose-receive export`` against a page served here, and everything that can be wrong with it."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from hypothesis import given
from hypothesis import strategies as st

from receiver.cli import parse_export_arguments
from receiver.export import export
from receiver.viewer.person_files import ExportError
from receiver.viewer.web_viewer import WebViewer
from tests.capsule_person import capsule_person, shown_frame

COMMAND = [str(Path(sys.executable).parent / "telepose-receive"), "export"]


async def exported(viewer: WebViewer, *files: Path, wait_s: float = 10.0, path: str = "/") -> None:
    app = web.Application()
    viewer.add_routes(app)
    async with TestServer(app) as server:
        await asyncio.to_thread(export, str(server.make_url(path)), files, wait_s)


async def test_the_person_shown_is_written(tmp_path: Path) -> None:
    viewer, person = WebViewer(), capsule_person(7)
    viewer.add_pose(person)
    viewer.show(shown_frame(person, 0.8))
    await exported(viewer, tmp_path / "a.glb", tmp_path / "b.ply")
    assert (tmp_path / "a.glb").read_bytes().startswith(b"glTF")
    assert (tmp_path / "b.ply").read_bytes().startswith(b"ply\n")
    assert viewer.page_count == 0


async def test_somebody_who_comes_late_is_waited_for_and_nobody_is_an_error(tmp_path: Path) -> None:
    viewer, person = WebViewer(), capsule_person(7)
    with pytest.raises(ExportError, match=r"showed nobody for 0\.3 s"):
        await exported(viewer, tmp_path / "a.glb", wait_s=0.3)
    writing = asyncio.create_task(exported(viewer, tmp_path / "a.glb"))
    await asyncio.sleep(0.1)
    viewer.add_pose(person)
    viewer.show(shown_frame(person, 0.8))
    await writing
    assert (tmp_path / "a.glb").exists()


async def test_a_server_without_a_page_is_told_from_a_refusal(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"is no receiver's page \(HTTP 404\)"):
        await exported(WebViewer(), tmp_path / "a.glb", path="/elsewhere")


def run(*arguments: str) -> tuple[int, str]:
    ended = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, check=False, timeout=60)
    assert ended.stdout == ""
    return ended.returncode, ended.stderr


def test_no_receiver_is_one_line_and_code_1(tmp_path: Path) -> None:
    code, error = run("--page", "http://127.0.0.1:9/", str(tmp_path / "a.glb"))
    assert (code, error.count("\n")) == (1, 1)
    assert "no receiver answers at http://127.0.0.1:9/" in error


def test_a_folder_that_is_not_there_is_told_before_anything_else(tmp_path: Path) -> None:
    code, error = run(str(tmp_path / "nowhere" / "a.glb"))
    assert (code, error.count("\n")) == (1, 1)
    assert f"there is no folder {tmp_path / 'nowhere'}" in error


@pytest.mark.parametrize(
    "arguments",
    [[], ["a.obj"], ["a"], ["a.glb", "--page", "127.0.0.1:8080"], ["a.glb", "--page", "http://[::1/"],
     ["a.glb", "--page", "http://x:port/"], ["a.glb", "--wait", "soon"], ["a.glb", "--wait", "0"],
     ["a.glb", "--wait", "nan"], ["a.glb", "--headless"]],
)  # fmt: skip
def test_wrong_arguments_are_refused_with_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parse_export_arguments(arguments)
    assert ended.value.code == 2
    assert "telepose-receive export: error:" in capsys.readouterr().err


@given(st.text(max_size=30), st.text(max_size=30))
def test_any_arguments_are_taken_or_refused(page: str, wait: str) -> None:
    try:
        options = parse_export_arguments(["a.glb", f"--page={page}", f"--wait={wait}"])
    except SystemExit as ended:
        assert ended.code == 2  # noqa: PT017
    else:
        assert options.page.startswith("http")
        assert 0 < options.wait_s <= 3600
