"""The receiver daemon: opens its session while what shows the person is loaded, and shows until it is stopped.

NumPy, numba and the kernels take longer to load than anything else here, so they begin first, on a thread of their own,
in the order in which the picture needs them; by their end the session is open.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from common.runtime.clock import MonotonicClock
from common.runtime.daemon import Daemon
from common.runtime.threads import into_background
from common.transport.access_rules import for_receiver, receiver_name
from common.transport.link_settings import with_endpoints
from common.transport.zenoh_session import open_session, own_certificate
from receiver.config import ReceiverSettings

if TYPE_CHECKING:
    from receiver.show import Show

log = logging.getLogger(__name__)


class ReceiverDaemon:
    """Runs until it is stopped."""

    def __init__(self, settings: ReceiverSettings) -> None:
        self._settings = settings

    async def run(self, daemon: Daemon) -> None:
        """The daemon's main coroutine.

        Raises:
            DaemonError: a port or file that cannot be used; the message says which.
        """
        settings = self._settings
        loader = ThreadPoolExecutor(1, "loader")
        loaded = loader.submit(_load_show, not settings.view.headless)
        rehearsed = loader.submit(_rehearse_picture)
        rehearsed_all = loader.submit(_rehearse_the_rest)
        link = with_endpoints(settings.link, "receiver")
        certificate = own_certificate(link)
        name = settings.name or secrets.token_hex(4)
        if certificate is not None:
            name = receiver_name(certificate.name, name)
        async with open_session(link, for_receiver(settings.site, name, link.mode == "client")) as session:
            show_of = await asyncio.wrap_future(loaded)
            show = show_of(settings, name, session, MonotonicClock(), rehearsed)
            try:
                await show.run(daemon, rehearsed_all)
            finally:
                show.close()


def _load_show(page: bool) -> type[Show]:
    from receiver.show import Show

    if page:
        import receiver.viewer.web_viewer  # noqa: F401  # the show opens it: aiohttp takes a while, too
    return Show


def _rehearse_picture() -> None:
    from receiver.rehearsal import rehearse_picture

    rehearse_picture()


def _rehearse_the_rest() -> None:
    from receiver.rehearsal import rehearse

    into_background()
    rehearse()
