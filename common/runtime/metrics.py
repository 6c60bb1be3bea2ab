"""What a daemon tells about itself: Prometheus metrics, health and readiness, on one aiohttp application.

Counters live where things are counted, in plain integers; this module reads them when somebody asks.
"""

from __future__ import annotations

import asyncio
import ssl
import threading
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass

from aiohttp import web
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from common.runtime.daemon import DaemonError
from common.runtime.http_access import require_token
from common.runtime.stage_timer import StageTimer

Labelled = Mapping[str, float]  # label value → number
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class Metrics:
    """The daemon's numbers. Each is read by a function at the time of a request; names get the prefix ``telepose_``."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._names: set[str] = set()

    def counter(self, name: str, about: str, read: Callable[[], float | Labelled], label: str = "cause") -> None:
        """A number that only grows; ``read`` returns it, or a mapping from values of ``label`` to such numbers.

        Raises:
            ValueError: the name is taken.
        """
        self._add(name, lambda: _family(CounterMetricFamily, name, about, read(), label))

    def gauge(self, name: str, about: str, read: Callable[[], float | Labelled], label: str = "cause") -> None:
        """A number that goes up and down; otherwise as ``counter``."""
        self._add(name, lambda: _family(GaugeMetricFamily, name, about, read(), label))

    def stages(self, timer: StageTimer) -> None:
        """``telepose_stage_ms`` by stage and quantile, from the timer."""

        def read() -> Metric:
            family = GaugeMetricFamily("telepose_stage_ms", "Duration of a stage", labels=["stage", "quantile"])
            for stage, times in timer.statistics().items():
                family.add_metric([stage, "0.5"], times.p50_ms)
                family.add_metric([stage, "0.95"], times.p95_ms)
                family.add_metric([stage, "0.99"], times.p99_ms)
            return family

        self._add("stage_ms", read)

    def _add(self, name: str, read: Callable[[], Metric]) -> None:
        if name in self._names:
            raise ValueError(f"two metrics are called {name}")
        self._names.add(name)
        self.registry.register(_Reader(read))

    def text(self) -> bytes:
        """All metrics in Prometheus' text format, UTF-8."""
        return generate_latest(self.registry)


class _Reader:
    """What a registry wants to hold: an object whose ``collect`` returns metric families."""

    def __init__(self, read: Callable[[], Metric]) -> None:
        self._read = read

    def collect(self) -> Iterable[Metric]:
        return [self._read()]


def _family(
    kind: type[CounterMetricFamily] | type[GaugeMetricFamily],
    name: str,
    about: str,
    value: float | Labelled,
    label: str,
) -> Metric:
    if not isinstance(value, Mapping):
        return kind(f"telepose_{name}", about, value=value)
    family = kind(f"telepose_{name}", about, labels=[label])
    for key, number in value.items():
        family.add_metric([key], number)
    return family


@dataclass(slots=True)
class Health:
    """What /healthz and /readyz answer. ``ready``: the daemon does its job now; ``reason``: why it does not."""

    healthy: bool = True
    ready: bool = False
    reason: str = "starting"


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
