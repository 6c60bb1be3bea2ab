"""The sender daemon: opens its session while what follows a person is loaded, and sends until its source ends.

NumPy, numba and what uses them take longer to load than anything else here, so that begins first, on a thread of its
own. By its end receivers that know this site have dialled it, and their reports are coming.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from common.runtime.daemon import Daemon, DaemonError
from common.transport.access_rules import Allowance, for_sender
from common.transport.link_settings import LinkSettings, with_endpoints
from common.transport.zenoh_session import open_session, own_certificate
from sender.config import SenderSettings
from sender.self_view import SelfView, open_self_view

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable


class SenderDaemon:
    """Runs until its source ends or it is stopped."""

    def __init__(self, settings: SenderSettings) -> None:
        self._settings = settings

    async def run(self, daemon: Daemon) -> None:
        """The daemon's main coroutine.

        Raises:
            DaemonError: a camera, port or file that cannot be used; the message says which.
        """
        settings = self._settings
        loaded = ThreadPoolExecutor(1, "loader").submit(_load_stream)  # not the loop's, for which its end would wait
        link = with_endpoints(settings.link, "sender")
        self._check_site(link)
        with open_self_view(settings.self_view, settings.site, settings.person, link) as self_view:
            link = link if self_view is None else self_view.with_private_link(link)
            async with open_session(link, self._allowed(self_view)) as session:
                run_stream = await asyncio.wrap_future(loaded)
                await run_stream(settings, session, daemon, self_view)

    def _check_site(self, link: LinkSettings) -> None:
        certificate, site = own_certificate(link), self._settings.site
        if certificate is not None and certificate.name != site:
            raise DaemonError(f"site: {site!r}, but the certificate in [link] certificates is of {certificate.name!r}")

    def _allowed(self, self_view: SelfView | None) -> tuple[Allowance, ...]:
        """Who may receive, when there are certificates to tell."""
        settings = self._settings
        allowed = for_sender(settings.site, settings.receivers, settings.link.mode == "client")
        return allowed if self_view is None else (*allowed, self_view.allowance(settings.site))


def _load_stream() -> Callable[..., Awaitable[None]]:
    from sender.stream import run_stream

    return run_stream
