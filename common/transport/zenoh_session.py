"""One Zenoh session: its settings, its opening and certain closing, and what happens to its links, told on the loop.

Zenoh calls back on its own threads. Callbacks here are direct ones (``indirect=False``): the others each keep a thread
that hinders the interpreter's exit. They only hand over to the loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import threading
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import zenoh
from zenoh.handlers import Callback

from common.runtime.daemon import DaemonError
from common.transport.access_rules import Allowance, access_control
from common.transport.link_settings import LinkSettings, zenoh_locators
from common.transport.site_certificate import SiteCertificate, load_site_certificate

if TYPE_CHECKING:
    from common.runtime.metrics import Metrics

log = logging.getLogger(__name__)

CLOSE_WITHIN_S = 1.0
OPEN_TRIES, OPEN_AGAIN_S = 10, 0.5  # to open another session in place of one
WARN_DAYS = 30  # before a certificate expires
Result = TypeVar("Result")
Entity = TypeVar("Entity", bound=Any)  # what Zenoh declares; all of them can be undeclared


class TransportError(DaemonError):
    """The session cannot be opened; the text says which locator or setting is the cause."""


def own_certificate(settings: LinkSettings) -> SiteCertificate | None:
    """The certificate that the settings name, None when they name none.

    Raises:
        CertificateError: it cannot be used now; the text says why.
    """
    return load_site_certificate(settings.certificates, datetime.now(UTC)) if settings.certificates else None


def zenoh_config(
    settings: LinkSettings, certificate: SiteCertificate | None = None, allowed: Iterable[Allowance] = ()
) -> zenoh.Config:
    """Zenoh's configuration of these settings. ``certificate``: the one they name; with it only what is ``allowed`` is.

    Raises:
        TransportError: the file cannot be read, or a value is refused.
        ValueError: the settings name a certificate, and there is none.
    """
    if (certificate is None) != (settings.certificates is None):
        raise ValueError("certificate: not as the settings say")
    try:
        config = zenoh.Config.from_file(settings.config_file) if settings.config_file else zenoh.Config()
        values = _values(settings, config)
        if certificate is not None:
            values |= _secure_values(settings, certificate, allowed)
        for key, value in values.items():
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
        # A peer decides what it unpacks to, before anything is known of it.
        "transport/unicast/compression/enabled": False,
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
        values["connect/endpoints"] = _to_dial(settings)
    listening = [each for locator in settings.listen for each in zenoh_locators(locator)]
    if listening or not isinstance(json.loads(file.get_json("listen/endpoints")), list):
        # Left to its default, a peer listens on every interface in plain TCP, whatever its TLS settings.
        values["listen/endpoints"] = listening
    locators = settings.connect + settings.listen
    if locators and not settings.config_file:
        values["transport/link/protocols"] = sorted({locator.partition("/")[0] for locator in locators})
    return values


def _to_dial(settings: LinkSettings) -> list[Any]:
    """A client, unlike a peer, would be content with one link of the pair."""
    pairs = [zenoh_locators(locator) for locator in settings.connect]
    if settings.mode == "client":
        return [pair[0] if len(pair) == 1 else {"strategy": "allOf", "locators": pair} for pair in pairs]
    return [locator for pair in pairs for locator in pair]


def _secure_values(
    settings: LinkSettings, certificate: SiteCertificate, allowed: Iterable[Allowance]
) -> dict[str, Any]:
    """TLS and QUIC with certificates at both ends and nothing beside them, and what the other end may do."""
    local = [each for each in settings.connect + settings.listen if each.startswith("unixsock-stream/")]
    return {
        "transport/link/tls": certificate.zenoh_tls(),
        # A forgotten listener in plain TCP then fails at the start.
        "transport/link/protocols": ["tls", "quic", *(["unixsock-stream"] if local else [])],
        "access_control": access_control(settings.realm, allowed),
    }


@dataclass(frozen=True, slots=True)
class TransportChange:
    """A transport to another Zenoh process, ``peer`` (its random id), opened (``up``) or closed."""

    peer: str
    up: bool


class Declared(Generic[Entity]):
    """Something declared with Zenoh: ``now`` with the session there is, anew with each that takes its place."""

    def __init__(self, session: ZenohSession, declare: Callable[[zenoh.Session], Entity]) -> None:
        self.declare = declare
        self.now = declare(session.zenoh)
        self._session = session

    def undeclare(self) -> None:
        """For good."""
        self._session.declared.discard(self)
        self.now.undeclare()


class ZenohSession:
    """An open session. Its callbacks run on the loop that opened it. ``successors``: what ``reopen`` opens."""

    def __init__(
        self,
        session: zenoh.Session,
        loop: asyncio.AbstractEventLoop,
        certificate: SiteCertificate | None = None,
        successors: Sequence[Callable[[], zenoh.Session]] = (),
    ) -> None:
        self.zenoh = session
        self.certificate = certificate
        self.loop = loop
        self.declared: set[Declared[Any]] = set()
        self._successors = successors

    def on_loop(self, action: Callable[..., None], *arguments: object) -> None:
        """Have the loop call ``action``; from any thread, also when the loop has closed (nothing happens then)."""
        with contextlib.suppress(RuntimeError):
            self.loop.call_soon_threadsafe(action, *arguments)

    def declare(self, how: Callable[[zenoh.Session], Entity]) -> Declared[Entity]:
        """Declare something that lives as long as this object, whatever session Zenoh has for it."""
        made = Declared(self, how)
        self.declared.add(made)
        return made

    async def reopen(self) -> None:
        """Take another session, with another id, in place of this one.

        Raises:
            TransportError: it cannot be opened.
        """
        for successor in self._successors:
            before, self.zenoh = self.zenoh, await _opened(successor)
            for declared in self.declared:
                declared.now = declared.declare(self.zenoh)
            await _closed(before)

    def add_metrics(self, metrics: Metrics) -> None:
        """What an operator has to know of the link."""
        certificate = self.certificate
        if certificate is not None:
            about = "Until this site's certificate expires"
            metrics.gauge("certificate_days_left", about, lambda: certificate.days_left(datetime.now(UTC)))

    def watch_transports(self, on_change: Callable[[TransportChange], None]) -> None:
        """Call ``on_change`` for every transport that is open now and for every change from now on."""

        def happened(event: zenoh.TransportEvent) -> None:
            up = event.kind == zenoh.SampleKind.PUT
            self.on_loop(on_change, TransportChange(str(event.transport.zid), up))

        handler = Callback(happened, indirect=False)
        self.declare(lambda session: session.info.declare_transport_events_listener(handler, history=True))

    def watch_links(self, on_new_session: Callable[[], None], on_change: Callable[[str, bool], None]) -> None:
        """Call ``on_change(link, up)`` for every link that is open now and for every change from now on, after
        ``on_new_session``, which is called for each session. QUIC's streams and datagrams are one link, which may be
        said to be down twice."""

        def listen(session: zenoh.Session) -> zenoh.LinkEventsListener[None]:
            def happened(event: zenoh.LinkEvent) -> None:
                link: Any = event.link  # its annotations are wrong
                name = f"{link.zid} {link.src} {link.dst}"
                self.on_loop(tell, name, event.kind == zenoh.SampleKind.PUT)

            def tell(link: str, up: bool) -> None:
                if session is self.zenoh:  # one that was replaced loses all its links
                    on_change(link, up)

            on_new_session()
            return session.info.declare_link_events_listener(Callback(happened, indirect=False), history=True)

        self.declare(listen)

    def declare_presence(self, key: str) -> None:
        """Others that watch ``key`` see it while this session lives and can be reached."""
        self.declare(lambda session: session.liveliness().declare_token(key))

    def watch_presence(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """Call ``on_change(key, present)`` for every presence there is now and for every change from now on."""

        def happened(sample: zenoh.Sample) -> None:
            self.on_loop(on_change, str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        handler = Callback(happened, indirect=False)
        self.declare(lambda session: session.liveliness().declare_subscriber(key_expression, handler, history=True))


@asynccontextmanager
async def open_session(settings: LinkSettings, allowed: Iterable[Allowance] = ()) -> AsyncIterator[ZenohSession]:
    """A session for as long as the context lasts. Absent peers are no error: they are dialled until they come.

    ``allowed``: what others may do when the settings name certificates; without these nobody can be told apart.

    Raises:
        TransportError: a port in use, a bad address or a bad setting; the text names it.
        CertificateError: the certificate cannot be used.
    """
    certificate = own_certificate(settings)
    allowed = tuple(allowed)
    config = zenoh_config(settings, certificate, allowed)
    loop = asyncio.get_running_loop()
    try:
        session = await _in_thread(lambda: zenoh.open(config), too_late=_close)
    except zenoh.ZError as error:
        raise TransportError(_explained(str(error), settings)) from error
    listening, dialling = (", ".join(locators) or "none" for locators in (settings.listen, settings.connect))
    log.info("zenoh session %s, listening on: %s, dialling: %s", session.zid(), listening, dialling)
    if certificate is not None and certificate.days_left(datetime.now(UTC)) < WARN_DAYS:
        log.warning("%s: expires on %s", certificate.certificate_file, f"{certificate.expires:%Y-%m-%d %H:%M} UTC")
    listens = bool(json.loads(config.get_json("listen/endpoints")))
    alike = partial(_open, settings, certificate, allowed)
    # The port of one that listens is free when it has closed. Meanwhile there is one without links.
    without_links = partial(_open, LinkSettings(realm=settings.realm))
    opened = ZenohSession(session, loop, certificate, (without_links, alike) if listens else (alike,))
    try:
        yield opened
    finally:
        await _closed(opened.zenoh)


def _open(
    settings: LinkSettings, certificate: SiteCertificate | None = None, allowed: Iterable[Allowance] = ()
) -> zenoh.Session:
    return zenoh.open(zenoh_config(settings, certificate, allowed))


async def _opened(how: Callable[[], zenoh.Session]) -> zenoh.Session:
    """Tried again while the port of the session before is not yet free."""
    for tries_left in reversed(range(OPEN_TRIES)):
        try:
            return await _in_thread(how, too_late=_close)
        except zenoh.ZError as error:
            if not tries_left:
                raise TransportError(f"no other Zenoh session: {_first_line(error)}") from error
            await asyncio.sleep(OPEN_AGAIN_S)
    raise AssertionError


async def _closed(session: zenoh.Session) -> None:
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
