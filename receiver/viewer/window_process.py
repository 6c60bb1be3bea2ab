"""Starts and watches the desktop window: a process, since Open3D keeps Python's lock while it draws."""

from __future__ import annotations

import asyncio
import logging
import sys

from common.runtime.daemon import DaemonError

log = logging.getLogger(__name__)


async def run_window(page: str) -> None:
    """Show the page at ``page`` in a window until somebody closes it; cancelled, it closes the window.

    Raises:
        DaemonError: it cannot be opened, or broke down; with its own last words.
    """
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", "receiver.viewer.desktop_window", page),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,  # Ctrl-C reaches the receiver alone, which then ends it
    )
    assert process.stdout is not None
    last_words = ""
    try:
        async for line in process.stdout:
            last_words = line.decode(errors="replace").strip() or last_words
            log.debug("window: %s", last_words)
        code = await process.wait()
    finally:
        if process.returncode is None:
            process.kill()
    if code:
        raise DaemonError(f"[view] window: {last_words or f'it ended with code {code}'}")
    log.info("the window was closed")
