"""Headless chromium steered over the DevTools protocol: opens a page, evaluates in it, photographs it."""

from __future__ import annotations

import asyncio
import base64
import itertools
import json
import shutil
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np
from numpy.typing import NDArray

START_LIMIT_S = 60.0
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)


def find_chromium() -> str | None:
    """Path of the browser, None where there is none."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


class Page:
    """One tab."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self._ids = itertools.count(1)
        self.problems: list[str] = []

    async def call(self, method: str, **parameters: Any) -> Any:
        """One DevTools call and its result; what the page's scripts throw meanwhile is kept in ``problems``."""
        identifier = next(self._ids)
        await self._socket.send_json({"id": identifier, "method": method, "params": parameters})
        while True:
            answer = json.loads(await self._socket.receive_str())
            if answer.get("method") == "Runtime.exceptionThrown":
                self.problems.append(answer["params"]["exceptionDetails"]["exception"]["description"])
            if answer.get("id") == identifier:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    async def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        result = await self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    async def wait_for(self, expression: str, accept: Callable[[Any], bool] = bool, limit_s: float = 30.0) -> Any:
        """The expression's value once it is accepted; fails with its last value after ``limit_s``."""
        deadline = asyncio.get_running_loop().time() + limit_s
        while not accept(value := await self.evaluate(expression)):
            assert asyncio.get_running_loop().time() < deadline, f"{expression} stayed {value!r}"
            await asyncio.sleep(0.1)
        return value

    async def photograph(self) -> NDArray[np.uint8]:
        """What a person sees, (H, W, 3) uint8 RGB."""
        png = base64.b64decode((await self.call("Page.captureScreenshot", format="png"))["data"])
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR_RGB)
        assert image is not None
        return np.asarray(image, np.uint8)

    async def press(self, key: str) -> None:
        """A key press, as from the keyboard."""
        for kind in ("keyDown", "keyUp"):
            await self.call("Input.dispatchKeyEvent", type=kind, key=key, text=key if kind == "keyDown" else "")


@asynccontextmanager
async def open_page(url: str, width: int = 1280, height: int = 800, phone: bool = False) -> AsyncIterator[Page]:
    """A browser of its own showing ``url``; ended, and its profile removed, on leaving."""
    executable = find_chromium()
    assert executable is not None
    with tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True) as profile:
        browser = await asyncio.create_subprocess_exec(
            executable,
            *FLAGS,
            f"--user-data-dir={profile}",
            f"--window-size={width},{height}",
            "about:blank",
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
        )
        try:
            port = await _debugging_port(Path(profile), browser)
            async with aiohttp.ClientSession() as session:
                async with session.get(f"http://127.0.0.1:{port}/json/list") as answer:
                    targets = await answer.json()
                target = next(t for t in targets if t["type"] == "page")
                async with session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                    page = Page(socket)
                    await page.call("Runtime.enable")
                    await page.call(
                        "Emulation.setDeviceMetricsOverride",
                        width=width, height=height, deviceScaleFactor=1, mobile=phone,
                    )  # fmt: skip
                    await page.call("Page.navigate", url=url)
                    await page.wait_for("document.readyState === 'complete' && location.href !== 'about:blank'")
                    yield page
        finally:
            browser.kill()
            await browser.wait()


async def _debugging_port(profile: Path, browser: asyncio.subprocess.Process) -> int:
    """The port chromium chose; it writes it into its profile."""
    file = profile / "DevToolsActivePort"
    async with asyncio.timeout(START_LIMIT_S):
        while not file.exists() or not file.read_text().strip():
            assert browser.returncode is None, f"chromium ended with {browser.returncode}"
            await asyncio.sleep(0.05)
    return int(file.read_text().splitlines()[0])
