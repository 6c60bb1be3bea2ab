"""HTTP beyond loopback: the token and TLS, for the page, its WebSocket and the metrics alike."""

from __future__ import annotations

import base64
import ssl
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import aiohttp
import pytest

from common.runtime.config_file import SettingsError, load_settings
from common.runtime.daemon import DaemonError
from common.runtime.http_access import COOKIE, read_token, tls_context
from common.runtime.http_app import daemon_app, serve_app
from common.runtime.http_settings import HttpSettings, is_loopback
from common.runtime.metrics import Health, Metrics
from receiver.config import ReceiverSettings
from receiver.viewer.web_viewer import WebViewer
from scripts.make_certificates import make
from sender.config import SenderSettings

TOKEN = "0123456789abcdef" * 4
ROUTES = ("/", "/ws", "/metrics", "/healthz", "/readyz", "/nothing")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make(tmp_path / "c", [("lobby", ["127.0.0.1"])])
    (tmp_path / "token").write_text(TOKEN + "\n")
    (tmp_path / "token").chmod(0o600)
    (tmp_path / "index.html").write_text("<title>telepose</title>")
    return tmp_path


class Client:
    """A browser that trusts the site's authority, with whatever headers it is given."""

    def __init__(self, session: aiohttp.ClientSession, origin: str, tls: ssl.SSLContext) -> None:
        self.session, self.origin, self.tls = session, origin, tls

    async def status(self, route: str, scheme: str = "https", **headers: str) -> int:
        async with self.session.get(f"{scheme}://{self.origin}{route}", headers=headers, ssl=self.tls) as answer:
            return answer.status

    def page(self, **headers: str) -> aiohttp.client._WSRequestContextManager:
        return self.session.ws_connect(f"wss://{self.origin}/ws", headers=headers, ssl=self.tls)


@asynccontextmanager
async def served(folder: Path, metrics: Metrics | None = None) -> AsyncIterator[Client]:
    settings = HttpSettings("0.0.0.0", 0, folder / "token", folder / "c" / "lobby")
    app = daemon_app(metrics or Metrics(), Health(ready=True), read_token(settings))
    WebViewer(folder).add_routes(app)
    async with serve_app(app, "127.0.0.1", 0, tls_context(settings)) as port:
        tls = ssl.create_default_context(cafile=folder / "c" / "ca.pem")
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:
            yield Client(session, f"127.0.0.1:{port}", tls)


def basic(password: str) -> str:
    return "Basic " + base64.b64encode(f"anyone:{password}".encode()).decode()


async def test_nothing_is_served_without_the_token(folder: Path) -> None:
    metrics = Metrics()
    wrong = (f"Bearer {TOKEN[:-1]}", f"Bearer {TOKEN}0", "Bearer", basic("guess"), "Basic !!", f"Digest {TOKEN}")
    async with served(folder, metrics) as client:
        for route in ROUTES:
            assert await client.status(route) == 401
            for authorization in wrong:
                assert await client.status(route, Authorization=authorization) == 401
            assert await client.status(route, Cookie=f"{COOKIE}=guess") == 401
        with pytest.raises(aiohttp.WSServerHandshakeError, match="401"):
            await client.page()
    text = metrics.text().decode()
    assert f'http_refused_total{{cause="wrong token"}} {float(len(ROUTES) * 6)}' in text
    assert f'http_refused_total{{cause="no token"}} {float(len(ROUTES) * 2 + 1)}' in text


@pytest.mark.parametrize("authorization", [f"Bearer {TOKEN}", basic(TOKEN)])
async def test_the_token_opens_everything_and_a_browser_keeps_it_as_a_cookie(folder: Path, authorization: str) -> None:
    async with served(folder) as client:
        for route in ("/", "/metrics", "/healthz", "/readyz"):
            assert await client.status(route, Authorization=authorization) == 200
        async with client.page(Authorization=authorization) as socket:
            assert "hello" in (await socket.receive_str())
        cookies = {cookie.key: cookie for cookie in client.session.cookie_jar}
        assert cookies[COOKIE]["secure"]
        assert cookies[COOKIE]["httponly"]
        assert cookies[COOKIE]["samesite"] == "Strict"
        async with client.page() as socket:
            assert "hello" in (await socket.receive_str())


async def test_plain_http_is_not_answered(folder: Path) -> None:
    async with served(folder) as client:
        with pytest.raises(aiohttp.ClientError):
            await client.status("/metrics", scheme="http", Authorization=f"Bearer {TOKEN}")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "192.0.2.7", "lobby.example"])
@pytest.mark.parametrize("settings", [SenderSettings, ReceiverSettings])
def test_opening_needs_token_and_tls(host: str, settings: type, tmp_path: Path) -> None:
    assert not is_loopback(host)
    for more in ('token_file = "t"', 'certificates = "c"', ""):
        file = tmp_path / "settings.toml"
        file.write_text(f'[http]\nhost = "{host}"\n{more}\n')
        with pytest.raises(SettingsError, match=r"\[http\] host: .* needs token_file and certificates"):
            load_settings(settings, file)


def test_both_daemons_are_on_loopback_unless_told_otherwise() -> None:
    for settings in (SenderSettings(), ReceiverSettings()):
        assert is_loopback(settings.http.host)
    assert all(map(is_loopback, ("localhost", "127.0.0.2", "::1")))


@pytest.mark.parametrize(
    ("content", "mode", "complaint"),
    [
        (None, 0o600, "No such file"),
        ("short", 0o600, "32 or more"),
        ("a" * 31 + "\n", 0o600, "32 or more"),
        ("two words " * 5, 0o600, "32 or more"),
        ("é" * 40, 0o600, "not plain ASCII"),
        (TOKEN, 0o644, "chmod 600"),
    ],
)
def test_a_token_that_is_none_is_named(content: str | None, mode: int, complaint: str, tmp_path: Path) -> None:
    file = tmp_path / "token"
    if content is not None:
        file.write_text(content, "utf-8")
        file.chmod(mode)
    with pytest.raises(DaemonError, match=rf"\[http\] token_file .*{complaint}"):
        read_token(HttpSettings(token_file=file))


def test_a_certificate_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(DaemonError, match=r"\[http\] certificates .*No such file"):
        tls_context(HttpSettings(certificates=tmp_path))


def test_a_port_outside_the_range_is_refused() -> None:
    with pytest.raises(ValueError, match="65536"):
        HttpSettings(port=65536)


def test_a_window_needs_the_page_on_loopback(tmp_path: Path) -> None:
    file = tmp_path / "receiver.toml"
    file.write_text('[view]\nwindow = true\n[http]\ntoken_file = "t"\n')
    with pytest.raises(SettingsError, match="window: follows the page"):
        load_settings(ReceiverSettings, file)
