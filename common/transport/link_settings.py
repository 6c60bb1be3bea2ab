"""How a daemon reaches the others: one table of its settings, and what Zenoh's locators come of it.

With ``certificates`` an address is dialled or listened on twice, as the secure pair on one port number of UDP and TCP:
QUIC, with datagrams for skeletons and reports, which a lost packet must not hold up, and TLS for bulk.
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from common.transport.channels import check_name

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # the sender listens there and the receiver dials it, unless told otherwise
PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws", "unixsock-stream", "serial", "vsock", "unixpipe")
SECURE_PROTOCOLS = ("tls", "quic", "unixsock-stream")  # the last stays on this host, behind its file's permissions
_NETWORKED = ("tcp", "tls", "quic", "udp", "ws")
_ADDRESS = re.compile(r"(?P<host>\[[0-9a-fA-F:.%\w]+\]|[^\s:\[\]/]+):(?P<port>\d{1,5})")


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """How a daemon reaches the others.

    ``mode``: None is Zenoh's file's, or peer. ``connect``: locators to dial, again and again until they answer.
    ``listen``: locators to listen on; none: this daemon cannot be dialled. ``realm``: what separates installations
    that share a network; it goes in front of every key. ``config_file``: Zenoh's own JSON5 file, for TLS, access
    control and all else; the settings here are put on top of it. ``certificates``: a folder of ``make_certificates``;
    with it every link to another host is secured, both ends show a certificate, and addresses are plain ``host:port``.
    ``lease_ms``: a peer silent that long is gone; longer, and an outage ends in a burst of stale packets. ``retry_ms``:
    first and longest pause between dialling attempts.
    """

    mode: Literal["peer", "client"] | None = None
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    realm: str = "telepose"
    config_file: Path | None = None
    certificates: Path | None = None
    lease_ms: int = 3000
    retry_ms: tuple[int, int] = (100, 1000)
    max_links: int = 2
    max_message_bytes: int = 1 << 20

    def __post_init__(self) -> None:
        for key, locators in (("connect", self.connect), ("listen", self.listen)):
            for locator in locators:
                (_check_secure if self.certificates else check_locator)(key, locator)
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


def _check_secure(key: str, locator: str) -> None:
    if _ADDRESS.fullmatch(locator):
        check_locator(key, f"tls/{locator}")
        return
    if locator.partition("/")[0] not in SECURE_PROTOCOLS:
        raise ValueError(f"{key}: {locator!r} would not be secured; with certificates write host:port, as host:7447")
    check_locator(key, locator)


def zenoh_locators(locator: str) -> tuple[str, ...]:
    """Zenoh's locators for one of ``LinkSettings``: of a plain ``host:port`` the secure pair.

    QUIC has datagrams for skeletons and reports, and streams for all that must not get lost: whichever link comes
    first, what either end declares then arrives. TLS carries bulk (its priorities) alone, which fills it.
    """
    if _ADDRESS.fullmatch(locator):
        return f"quic/{locator}?mixed_rel=1;prio=0-5", f"tls/{locator}?rel=1;prio=6-7"
    return (locator,)


def with_endpoints(settings: LinkSettings, role: Literal["sender", "receiver"]) -> LinkSettings:
    """The settings with the role's default locator when they name none: the sender listens, the receiver dials."""
    if settings.connect or settings.listen or settings.config_file:
        return settings
    default = DEFAULT_ENDPOINT.removeprefix("tcp/") if settings.certificates else DEFAULT_ENDPOINT
    if role == "sender" and settings.mode != "client":
        return dataclasses.replace(settings, listen=(default,))
    return dataclasses.replace(settings, connect=(default,))
