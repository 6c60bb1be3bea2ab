"""The sender's own person on a page of its own (DISPOSE §8): what one site sees of itself.

A receiver on this host, a process of its own, attached by a private Unix socket: it selects among the candidate poses
as any other does, so that what the cameras do not see now is shown from when they did. It can hold up nothing here and
is started again when it ends; it ends with the sender, however that ends.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import secrets
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from common.runtime.daemon import DaemonError
from common.transport.access_rules import Allowance
from common.transport.link_settings import LinkSettings
from sender.config import SelfViewSettings

log = logging.getLogger(__name__)

RECEIVER = Path(sys.executable).with_name("telepose-receive")
START_AGAIN_S = 3.0
END_WITHIN_S = 1.0


class SelfView:
    """The private link and the receiver at its other end, ``name``."""

    def __init__(self, settings: SelfViewSettings, site: str, person: int, realm: str, folder: Path) -> None:
        self.name = f"self-view-{secrets.token_hex(4)}"
        self._locator = f"unixsock-stream/{folder / 'link'}"
        self._settings_file = folder / "receiver.toml"
        self._page = f"http://127.0.0.1:{settings.port}/"
        lines = {"site": site, "person": person, "name": self.name}
        link = {"connect": [self._locator], "realm": realm}
        tables = (("", lines), ("[link]\n", link), ("[http]\n", {"port": settings.port}))
        text = "".join(head + "".join(f"{k} = {json.dumps(v)}\n" for k, v in table.items()) for head, table in tables)
        self._settings_file.write_text(text, "utf-8")

    def with_private_link(self, link: LinkSettings) -> LinkSettings:
        """The sender's link, listening on the private socket too."""
        return replace(link, listen=(*link.listen, self._locator))

    def allowance(self, site: str) -> Allowance:
        """What the receiver may do: it shows no certificate, but nobody else can open the socket."""
        return Allowance(site, "receiver", self.name, link="unixsock-stream")

    async def run(self) -> None:
        """Keep the receiver running until cancelled.

        Raises:
            DaemonError: there is no receiver beside this sender.
        """
        while True:
            log.info("self view on %s", self._page)
            try:
                process = await asyncio.create_subprocess_exec(
                    *(RECEIVER, "-c", self._settings_file, "--exit-with-parent"),
                    stdin=subprocess.PIPE,
                    env={k: v for k, v in os.environ.items() if k != "NOTIFY_SOCKET"},  # systemd waits for the sender
                    start_new_session=True,  # Ctrl-C reaches the sender alone, which then ends it
                )
            except OSError as error:
                raise DaemonError(f"[self_view] {RECEIVER}: {error.strerror}") from error
            try:
                code = await process.wait()
            finally:
                if process.returncode is None:
                    process.terminate()
                    with suppress(TimeoutError):
                        await asyncio.wait_for(process.wait(), END_WITHIN_S)
            log.warning("the self view ended with code %s, starting it again", code)
            await asyncio.sleep(START_AGAIN_S)


@contextmanager
def open_self_view(settings: SelfViewSettings, site: str, person: int, link: LinkSettings) -> Iterator[SelfView | None]:
    """The self view, with a folder of its own that nobody else can enter; None where it is not enabled."""
    if not settings.enabled:
        yield None
        return
    with tempfile.TemporaryDirectory(prefix="telepose-", ignore_cleanup_errors=True) as folder:
        yield SelfView(settings, site, person, link.realm, Path(folder))
