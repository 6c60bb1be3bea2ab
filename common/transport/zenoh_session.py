"""One Zenoh session: its settings, its opening and certain closing, and what happens to its links, told on the loop.

Zenoh calls back on its own threads. Callbacks here are direct ones (``indirect=False``): the others each keep a thread
that hinders the interpreter's exit. They only hand over to the loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import logging
import re
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import zenoh
from zenoh.handlers import Callback

from common.runtime.daemon import DaemonError
from common.transport.channels import check_name

log = logging.getLogger(__name__)

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # the sender listens there and the receiver dials it, unless told otherwise
CLOSE_WITHIN_S = 1.0
PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws", "unixsock-stream", "serial", "vsock", "unixpipe")
_NETWORKED = ("tcp", "tls", "quic", "udp", "ws")
_ADDRESS = re.compile(r"(?P<host>\[[0-9a-fA-F:.%\w]+\]|[^\s:\[\]]+):(?P<port>\d{1,5})")
Result = TypeVar("Result")


class TransportError(DaemonError):
    """The session cannot be opened; the text says which locator or setting is the cause."""


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """How a daemon reaches the others.

    ``mode``: None is Zenoh's file's, or peer. ``connect``: locators to dial, again and again until they answer.
    ``listen``: locators to listen on; none: this daemon cannot be dialled. ``realm``: what separates installations
    that share a network; it goes in front of every key. ``config_file``: Zenoh's own JSON5 file, for TLS, access
    control and all else; the settings here are put on top of it. ``lease_ms``: a peer silent that long is gone; longer,
    and an outage ends in a burst of stale packets. ``retry_ms``: first and longest pause between dialling attempts.
    """

    mode: Literal["peer", "client"] | None = None
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    realm: str = "telepose"
    config_file: Path | None = None
    lease_ms: int = 3000
    retry_ms: tuple[int, int] = (100, 1000)
    max_links: int = 2
    max_message_bytes: int = 1 << 20

    def __post_init__(self) -> None:
        for key, locators in (("connect", self.connect), ("listen", self.listen)):
            for locator in locators:
                check_locator(key, locator)
        for part in self.realm.split("/"):
            check_name("realm", part)
        if not 500 <= self.lease_ms <= 60_000:  # Zenoh takes any number, and 0 for a negative one
            raise ValueError(f"lease_ms: {self.lease_ms} is outside 500..60000")
        if not 1 <= self.retry_ms[0] <= self.retry_ms[1] <= 60_000:
            raise ValueError(f"retry_ms: {list(self.retry_ms)} must rise within 1..60000")
        if not 1 <= self.max_links <= 8:
            raise ValueError(f"max_links: {self.max_links} is outside 1..8")
        if not 64 << 10 <= self.max_message_bytes <= 1 << 30:
            raise ValueError(f"max_message_bytes: {self.max_message_bytes} is outside 64 KiB..1 GiB")
        if self.mode == "client" and self.listen:
            raise ValueError("listen: a client only dials")


def check_locator(key: str, locator: str) -> None:
    """Refuses what Zenoh could not use, with a text an operator understands.

    Raises:
        ValueError: not ``protocol/address``, an unknown protocol, or an address without host or port.
    """
    protocol, slash, rest = locator.partition("/")
    if not slash or protocol not in PROTOCOLS:
        raise ValueError(f"{key}: {locator!r} is not a locator such as {DEFAULT_ENDPOINT} or tls/host:7448")
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    if protocol not in _NETWORKED:
        return
    match = _ADDRESS.fullmatch(address)
    if match is None or int(match["port"]) > 65535:
        raise ValueError(f"{key}: {locator!r} needs a host and a port up to 65535, as in {DEFAULT_ENDPOINT}")


def zenoh_config(settings: LinkSettings) -> zenoh.Config:
    """Zenoh's configuration of these settings.

    Raises:
        TransportError: the file cannot be read, or a value is refused.
    """
    try:
        config = zenoh.Config.from_file(settings.config_file) if settings.config_file else zenoh.Config()
        for key, value in _values(settings, config).items():
            config.insert_json5(key, json.dumps(value))
    except (zenoh.ZError, OSError) as error:
        where = f"{settings.config_file}: " if settings.config_file else ""
        raise TransportError(f"{where}{_first_line(error)}") from error
    return config


def _values(settings: LinkSettings, file: zenoh.Config) -> dict[str, Any]:
    """What is put on top of ``file``: Zenoh's defaults and its own file."""
    values: dict[str, Any] = {
        "namespace": settings.realm,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # On by default, it would carry large payloads around the link that everything here is measured on.
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_links": settings.max_links,
        "transport/unicast/accept_timeout": 1000,
        "transport/link/tx/lease": settings.lease_ms,
        "transport/link/rx/max_message_size": settings.max_message_bytes,
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": settings.retry_ms[0],
            "period_max_ms": settings.retry_ms[1],
            "period_increase_factor": 2,
        },
    }
    if settings.mode is not None or json.loads(file.get_json("mode")) is None:
        values["mode"] = settings.mode or "peer"
    if settings.connect or not settings.config_file:
        values["connect/endpoints"] = list(settings.connect)
    if settings.listen or not isinstance(json.loads(file.get_json("listen/endpoints")), list):
        # Left to its default, a peer listens on every interface in plain TCP, whatever its TLS settings.
        values["listen/endpoints"] = list(settings.listen)
    locators = settings.connect + settings.listen
    if locators and not settings.config_file:
        values["transport/link/protocols"] = sorted({locator.partition("/")[0] for locator in locators})
    return values


@dataclass(frozen=True, slots=True)
class TransportChange:
    """A transport to another Zenoh process, ``peer`` (its random id), opened (``up``) or closed."""

    peer: str
    up: bool


class ZenohSession:
    """An open session. Its callbacks run on the loop that opened it."""

    def __init__(self, session: zenoh.Session, loop: asyncio.AbstractEventLoop) -> None:
        self.zenoh = session
        self.loop = loop
        self._declared: list[Any] = []

    def on_loop(self, action: Callable[..., None], *arguments: object) -> None:
        """Have the loop call ``action``; from any thread, also when the loop has closed (nothing happens then)."""
        with contextlib.suppress(RuntimeError):
            self.loop.call_soon_threadsafe(action, *arguments)

    def keep(self, declared: Any) -> None:
        """Hold on to something declared, so that it lives as long as the session."""
        self._declared.append(declared)

    def watch_transports(self, on_change: Callable[[TransportChange], None]) -> None:
        """Call ``on_change`` for every transport that is open now and for every change from now on."""

        def happened(event: zenoh.TransportEvent) -> None:
            up = event.kind == zenoh.SampleKind.PUT
            self.on_loop(on_change, TransportChange(str(event.transport.zid), up))

        handler = Callback(happened, indirect=False)
        self.keep(self.zenoh.info.declare_transport_events_listener(handler, history=True))

    def declare_presence(self, key: str) -> None:
        """Others that watch ``key`` see it while this session lives and can be reached."""
        self.keep(self.zenoh.liveliness().declare_token(key))

    def watch_presence(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """Call ``on_change(key, present)`` for every presence there is now and for every change from now on."""

        def happened(sample: zenoh.Sample) -> None:
            self.on_loop(on_change, str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        handler = Callback(happened, indirect=False)
        self.keep(self.zenoh.liveliness().declare_subscriber(key_expression, handler, history=True))


@asynccontextmanager
async def open_session(settings: LinkSettings) -> AsyncIterator[ZenohSession]:
    """A session for as long as the context lasts. Absent peers are no error: they are dialled until they come.

    Raises:
        TransportError: a port in use, a bad address or a bad setting; the text names it.
    """
    config = zenoh_config(settings)
    loop = asyncio.get_running_loop()
    try:
        session = await _in_thread(lambda: zenoh.open(config), too_late=_close)
    except zenoh.ZError as error:
        raise TransportError(_explained(str(error), settings)) from error
    listening, dialling = (", ".join(locators) or "none" for locators in (settings.listen, settings.connect))
    log.info("zenoh session %s, listening on: %s, dialling: %s", session.zid(), listening, dialling)
    try:
        yield ZenohSession(session, loop)
    finally:
        try:
            # Closing tells the peers, which can take long when they do not answer.
            async with asyncio.timeout(CLOSE_WITHIN_S):
                await _in_thread(lambda: _close(session))
        except TimeoutError:
            log.warning("zenoh session not closed within %s s, left behind", CLOSE_WITHIN_S)
        except zenoh.ZError as error:
            log.warning("zenoh session: %s", _first_line(error))


async def _in_thread(call: Callable[[], Result], too_late: Callable[[Result], object] | None = None) -> Result:
    """The result of a blocking call, made on a daemon thread: unlike an executor's it cannot hold up the exit.

    ``too_late`` gets the result when nobody waits for it any more.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[Result] = loop.create_future()

    def deliver(result: Result | None, error: BaseException | None) -> None:
        if error is not None and not future.done():
            future.set_exception(error)
        elif error is None and not future.done():
            future.set_result(result)  # type: ignore[arg-type]
        elif error is None and too_late is not None:
            threading.Thread(target=too_late, args=(result,), daemon=True).start()

    def work() -> None:
        result, error = None, None
        try:
            result = call()
        except BaseException as raised:  # the caller's, who awaits the future
            error = raised
        with contextlib.suppress(RuntimeError):  # the loop has closed: the process is on its way out
            loop.call_soon_threadsafe(deliver, result, error)

    threading.Thread(target=work, name="zenoh", daemon=True).start()
    return await future


def _close(session: zenoh.Session) -> None:
    session.close()  # type: ignore[no-untyped-call]


def with_endpoints(settings: LinkSettings, role: Literal["sender", "receiver"]) -> LinkSettings:
    """The settings with the role's default locator when they name none: the sender listens, the receiver dials."""
    if settings.connect or settings.listen or settings.config_file:
        return settings
    if role == "sender":
        return dataclasses.replace(settings, listen=(DEFAULT_ENDPOINT,))
    return dataclasses.replace(settings, connect=(DEFAULT_ENDPOINT,))


def _explained(error: str, settings: LinkSettings) -> str:
    named = ", ".join(settings.listen) or "the locators of its file"
    for symptom, meaning in (
        ("Address already in use", "is in use by another program"),
        ("Cannot assign requested address", "is not an address of this host"),
        ("Permission denied", "needs a privilege this daemon does not have"),
        ("lookup address", "has a name that does not resolve"),
        ("Unsupported protocol", "has a protocol that the settings do not allow"),
    ):
        if symptom in error:
            return f"cannot listen: {named} {meaning}"
    return f"cannot open the Zenoh session: {_first_line(error)}"


def _first_line(error: object) -> str:
    """Zenoh's text without the source files it names."""
    text = (str(error).splitlines() or ["unknown error"])[0]
    return re.sub(r" at /\S+\.rs:\d+\.?", "", text)
