"""The desktop window, on a virtual display: the person is in it, as on the page, and it ends as it should."""

from __future__ import annotations

import asyncio
import ctypes.util
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from common.runtime.daemon import DaemonError
from receiver.viewer.window_process import run_window
from scripts.daemon_processes import site
from tests.capsule_person import SHIRT

ROOT = Path(__file__).parent.parent
WINDOW = [sys.executable, "-m", "receiver.viewer.desktop_window"]
PAGE = "http://127.0.0.1:9/"
LIMIT_S = 60

needs_open3d = pytest.mark.skipif(
    find_spec("open3d") is None or ctypes.util.find_library("usb-1.0") is None,
    reason="no Open3D here (pip install open3d-cpu; Debian: apt-get install libegl1 libgl1 libusb-1.0-0)",
)
needs_display = pytest.mark.skipif(shutil.which("Xvfb") is None, reason="no Xvfb here (Debian: apt-get install xvfb)")

PHOTOGRAPH = """
import sys, numpy as np
from receiver.viewer.desktop_window import DesktopWindow, _open3d
from receiver.viewer.page_messages import encode_frame, encode_pose
from receiver.viewer.page_view import PageView, Sight
from tests.capsule_person import capsule_person, shown_frame
person, view, pictures = capsule_person(7), PageView(), []
view.take(encode_pose(person))
window = DesktopWindow(_open3d())
for time_s, live in ((0.0, True), (0.8, True), (0.8, False), (None, True)):
    view.take(encode_frame(shown_frame(None if time_s is None else person, time_s or 0.0)))
    window.show(Sight(view.person, live))
    assert window.alive()
    pictures.append(window.photograph())
np.save(sys.argv[1], np.stack(pictures))
"""


@pytest.fixture(scope="module")
def display() -> Iterator[dict[str, str]]:
    """The environment of a screen of its own."""
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1024x1024x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[writing], stderr=subprocess.DEVNULL)
    os.close(writing)
    with os.fdopen(reading) as number:
        name = number.readline().strip()
    yield os.environ | {"DISPLAY": f":{name}"}
    server.terminate()
    server.wait()


@needs_open3d
@needs_display
def test_the_person_is_in_the_window_moves_and_turns_grey(display: dict[str, str], tmp_path: Path) -> None:
    command = [sys.executable, "-c", PHOTOGRAPH, str(tmp_path / "pictures.npy")]
    subprocess.run(command, env=display, cwd=ROOT, check=True, timeout=LIMIT_S)
    standing, moved, old, nobody = np.load(tmp_path / "pictures.npy").astype(int)
    shirt = [(np.abs(picture - SHIRT) <= 6).all(axis=2) for picture in (standing, moved, old, nobody)]
    assert shirt[0].sum() > 5000
    rows, columns = np.nonzero(shirt[0])
    assert 100 < rows.mean() < standing.shape[0] - 100
    assert 100 < columns.mean() < standing.shape[1] - 100
    assert (shirt[0] ^ shirt[1]).sum() > 200
    assert shirt[2].sum() == shirt[3].sum() == 0
    assert (old != nobody).any(axis=2).sum() > 5000  # still there, in grey


@needs_open3d
@pytest.mark.parametrize("display", ["", ":4711"])
def test_without_a_display_the_receiver_says_so_and_ends(
    display: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with site(tmp_path) as here:
        receiver = here.receiver("--window", headless=False)
        assert receiver.process.wait(LIMIT_S) == 1
        assert "is there a display (DISPLAY)" in receiver.log.strip().splitlines()[-1]


def program(folder: Path, script: str) -> str:
    """An executable that does this, whatever it is given."""
    path = folder / "program"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return str(path)


def test_without_open3d_the_window_says_what_to_install() -> None:
    code = "import sys; sys.modules['open3d'] = None; from receiver.viewer.desktop_window import main; main()"
    ended = subprocess.run([sys.executable, "-c", code, PAGE], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (1, 1)
    assert "telepose[open3d]" in ended.stderr


def test_a_library_that_open3d_lacks_is_told_with_its_debian_package(tmp_path: Path) -> None:
    (tmp_path / "open3d.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')")
    code = "import sys; sys.path.insert(0, sys.argv.pop()); from receiver.viewer.desktop_window import main; main()"
    command = [sys.executable, "-c", code, PAGE, str(tmp_path)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "apt-get install libegl1 libgl1 libusb-1.0-0" in ended.stderr
    assert "libGL.so.1" in ended.stderr


@pytest.mark.parametrize("arguments", [[], ["a", "b"]])
def test_the_window_wants_one_page(arguments: list[str]) -> None:
    ended = subprocess.run([*WINDOW, *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.startswith("usage:")


async def test_closing_the_window_ends_the_wait(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("sys.executable", program(tmp_path, "exit 0"))
    await run_window(PAGE)


async def test_a_window_that_breaks_down_is_an_error_with_its_last_words(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("sys.executable", program(tmp_path, "echo first; echo; echo no display >&2; exit 1"))
    with pytest.raises(DaemonError, match=r"^\[view\] window: no display$"):
        await run_window(PAGE)


async def test_a_receiver_that_ends_takes_its_window_along(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    monkeypatch.setattr("sys.executable", program(tmp_path, f"echo $$ > {pid_file}; exec sleep 60"))
    running = asyncio.create_task(run_window(PAGE))
    async with asyncio.timeout(LIMIT_S):
        while not (pid_file.exists() and pid_file.read_text().strip()):  # noqa: ASYNC110
            await asyncio.sleep(0.02)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        pid = int(pid_file.read_text())
        while os.path.exists(f"/proc/{pid}"):  # noqa: ASYNC110, ASYNC240
            await asyncio.sleep(0.02)


def test_the_daemons_do_not_load_open3d() -> None:
    code = "import sys, receiver.cli, receiver.daemon, receiver.export, sender.cli, sender.daemon, scripts.demo"
    ended = subprocess.run(
        [sys.executable, "-c", f"{code}\nprint('open3d' in sys.modules)"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert ended.stdout == "False\n"
