"""What a daemon answers over HTTP: health, readiness and metrics, on one aiohttp application."""

from __future__ import annotations

import asyncio
import logging
import ssl
import threading
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from aiohttp import web

from common.runtime.daemon import DaemonError
from common.runtime.http_access import read_token, require_token, tls_context
from common.runtime.http_settings import HttpSettings
from common.runtime.metrics import Health, Metrics

log = logging.getLogger(__name__)

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


def daemon_app(metrics: Metrics, health: Health, token: str | None = None) -> web.Application:
    """An aiohttp application with /healthz, /readyz and /metrics; others may add their routes before it is served.

    With a ``token``, every request to any of them has to show it.
    """

    def verdict(good: bool) -> web.Response:
        return web.Response(status=200 if good else 503, text="ok\n" if good else f"{health.reason}\n")

    async def healthz(_: web.Request) -> web.Response:
        return verdict(health.healthy)

    async def readyz(_: web.Request) -> web.Response:
        return verdict(health.healthy and health.ready)

    async def numbers(_: web.Request) -> web.Response:
        return web.Response(body=metrics.text(), headers={"Content-Type": CONTENT_TYPE})

    metrics.gauge("tasks", "Tasks of the loop that have not ended", lambda: len(asyncio.all_tasks()))
    metrics.gauge("threads", "Threads that run Python", threading.active_count)
    refused: Counter[str] = Counter()
    app = web.Application(middlewares=[require_token(token, refused)] if token is not None else [])
    if token is not None:
        metrics.counter("http_refused_total", "Requests without the right token, by cause", lambda: refused)
    app.add_routes([web.get("/healthz", healthz), web.get("/readyz", readyz), web.get("/metrics", numbers)])
    return app


@asynccontextmanager
async def serve_app(
    app: web.Application, host: str, port: int, tls: ssl.SSLContext | None = None
) -> AsyncIterator[int]:
    """Serve the application while the context lasts; gives the port it listens on (``port`` 0: any free one).

    Raises:
        DaemonError: the address cannot be listened on; the text names it.
    """
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        try:
            await web.TCPSite(runner, host, port, ssl_context=tls).start()
        except OSError as error:
            raise DaemonError(f"cannot serve http{'s' if tls else ''}://{host}:{port}: {error.strerror}") from error
        yield int(runner.addresses[0][1])
    finally:
        await runner.cleanup()


@asynccontextmanager
async def served(
    http: HttpSettings,
    metrics: Metrics,
    health: Health,
    what: str = "metrics",
    add_routes: Callable[[web.Application], None] = lambda _: None,
) -> AsyncIterator[int]:
    """A daemon's HTTP as its settings have it, while the context lasts; gives the port. ``what`` the log calls it.

    Raises:
        DaemonError: the address, the token or the certificate cannot be used; the text names it.
    """
    app = daemon_app(metrics, health, read_token(http))
    tls = tls_context(http)
    add_routes(app)
    async with serve_app(app, http.host, http.port, tls) as port:
        log.info("%s on %s://%s:%d/", what, "https" if tls else "http", http.host, port)
        yield port
