"""Follows a receiver's page as a browser does, from another process: what it shows, newest first, nothing queued."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncGenerator, Callable
from urllib.parse import urlsplit, urlunsplit

import aiohttp

from receiver.viewer.page_view import PageView, Sight

MESSAGE_MAX_BYTES = 256 << 20
DIAL_WITHIN_S = 5.0


class PageError(Exception):
    """The receiver's page cannot be followed; the text says why."""


def socket_address(page: str) -> str:
    """The address of a page's WebSocket, ``http://127.0.0.1:8080/`` → ``ws://127.0.0.1:8080/ws``."""
    parts = urlsplit(page)
    scheme = {"http": "ws", "https": "wss"}.get(parts.scheme, parts.scheme)
    return urlunsplit((scheme, parts.netloc, parts.path.rstrip("/") + "/ws", "", ""))


async def follow(page: str) -> AsyncGenerator[PageView, None]:
    """The one view of the page after every message, until the receiver closes the connection.

    Raises:
        PageError: nobody answers there, or what comes is no page's.
    """
    view = PageView()
    try:
        timeout = aiohttp.ClientTimeout(total=None, sock_connect=DIAL_WITHIN_S)
        async with (
            aiohttp.ClientSession(timeout=timeout) as session,
            session.ws_connect(socket_address(page), max_msg_size=MESSAGE_MAX_BYTES) as socket,
        ):
            await socket.send_str("mesh")  # more would be sent in vain
            async for message in socket:
                if message.type is aiohttp.WSMsgType.BINARY:
                    view.take(message.data)
                    await socket.send_bytes(struct.pack("<I", view.taken_in))
                elif message.type is aiohttp.WSMsgType.TEXT:
                    view.take_text(message.data)
                yield view
    except aiohttp.WSServerHandshakeError as error:
        known = {401: "needs a token", 403: "refuses this name: it is not in [view] allowed_hosts"}
        why = known.get(error.status, "is no receiver's page")
        raise PageError(f"{page} {why} (HTTP {error.status})") from error
    except (aiohttp.ClientError, OSError, TimeoutError) as error:
        raise PageError(f"no receiver answers at {page}: {str(error) or 'timeout'}") from error
    except ValueError as error:
        raise PageError(f"{page}: {error}") from error


def watch(page: str, on_sight: Callable[[Sight], None]) -> None:
    """Call ``on_sight`` after every message, on this thread, until the receiver closes the connection.

    Raises:
        PageError: as ``follow``.
    """

    async def watching() -> None:
        async for view in follow(page):
            on_sight(view.sight)

    asyncio.run(watching())
