"""The routes a daemon answers, read over real HTTP on loopback."""

from __future__ import annotations

import re
from collections import Counter

import aiohttp
import pytest
from aiohttp import web

from common.runtime.clock import ManualClock
from common.runtime.daemon import DaemonError
from common.runtime.http_app import daemon_app, serve_app
from common.runtime.metrics import Health, Metrics
from common.runtime.stage_timer import StageTimer


async def get(port: int, path: str) -> tuple[int, str]:
    async with aiohttp.ClientSession() as client, client.get(f"http://127.0.0.1:{port}{path}") as answer:
        return answer.status, await answer.text()


def test_numbers_are_read_when_asked_for() -> None:
    metrics, dropped = Metrics(), Counter(late=1)
    metrics.counter("dropped", "Frames dropped", lambda: dropped)
    metrics.gauge("age_ms", "Age of the shown pose", lambda: 12.5)
    dropped["late"] += 4
    text = metrics.text().decode()
    assert 'telepose_dropped_total{cause="late"} 5.0' in text
    assert "telepose_age_ms 12.5" in text
    assert "# HELP telepose_dropped_total Frames dropped" in text


def test_stage_times_appear_by_stage_and_quantile() -> None:
    metrics, timer = Metrics(), StageTimer(ManualClock())
    metrics.stages(timer)
    timer.add("fit", 9_000_000)
    assert 'telepose_stage_ms{quantile="0.99",stage="fit"} 9.0' in metrics.text().decode()


def test_a_name_is_given_once() -> None:
    metrics = Metrics()
    metrics.gauge("age_ms", "Age", lambda: 1.0)
    with pytest.raises(ValueError, match="two metrics are called age_ms"):
        metrics.gauge("age_ms", "Age again", lambda: 2.0)


async def test_health_and_readiness_follow_the_daemon() -> None:
    health = Health()
    async with serve_app(daemon_app(Metrics(), health), "127.0.0.1", 0) as port:
        assert await get(port, "/healthz") == (200, "ok\n")
        assert await get(port, "/readyz") == (503, "starting\n")
        health.ready = True
        assert await get(port, "/readyz") == (200, "ok\n")
        health.healthy, health.reason = False, "cameras gone"
        assert await get(port, "/healthz") == (503, "cameras gone\n")
        assert await get(port, "/readyz") == (503, "cameras gone\n")


async def test_others_may_add_routes_to_the_same_application() -> None:
    async def page(_: web.Request) -> web.Response:
        return web.Response(text="page")

    metrics = Metrics()
    metrics.gauge("age_ms", "Age", lambda: 1.0)
    app = daemon_app(metrics, Health())
    app.router.add_get("/", page)
    async with serve_app(app, "127.0.0.1", 0) as port:
        assert await get(port, "/") == (200, "page")
        status, text = await get(port, "/metrics")
    assert status == 200
    assert "telepose_age_ms 1.0" in text
    assert re.search(r"(?m)^telepose_tasks [1-9]", text)
    assert re.search(r"(?m)^telepose_threads [1-9]", text)


async def test_a_port_in_use_is_named() -> None:
    async with serve_app(daemon_app(Metrics(), Health()), "127.0.0.1", 0) as port:
        with pytest.raises(DaemonError, match=rf"cannot serve http://127\.0\.0\.1:{port}: .*in use"):
            async with serve_app(daemon_app(Metrics(), Health()), "127.0.0.1", port):
                pass
