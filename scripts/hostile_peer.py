"""Those who should not get in, or should do no harm inside: for tests and the bench of hostile peers. Loopback only."""

from __future__ import annotations

import contextlib
import json
import os
import random
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zenoh

from common.wire.receiver_report import ReceiverReport, encode_report


def pair(port: int) -> list[str]:
    """Zenoh's locators of the secure pair on loopback."""
    return [f"quic/127.0.0.1:{port}?mixed_rel=1;prio=0-5", f"tls/127.0.0.1:{port}?rel=1;prio=6-7"]


def outsider(
    connect: list[str], site: Path | None = None, ca: Path | None = None, patient: bool = False
) -> zenoh.Session:
    """A session that dials with what it has and gives up after a second; it obeys no access rules of its own.

    ``site``: the folder of its certificate; ``ca``: of the authority it trusts, else its own. ``patient``: it is open
    at once and dials for ever, as the daemons do.

    Raises:
        zenoh.ZError: it did not get in.
    """
    tls: dict[str, Any] = {"root_ca_certificate": str((ca or site or Path()) / "ca.pem")}
    if site is not None:
        files = {"connect_certificate": str(site / "certificate.pem"), "connect_private_key": str(site / "key.pem")}
        tls |= files | {"enable_mtls": True}
    settings = {
        "mode": "peer",
        "connect/endpoints": connect,
        "connect/timeout_ms": -1 if patient else 1000,
        "connect/exit_on_failure": not patient,
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_links": 2,
        "namespace": "telepose",
        **({"transport/link/tls": tls} if site or ca else {}),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def closed(session: zenoh.Session) -> contextlib.AbstractContextManager[zenoh.Session]:
    """The session, closed when the context ends."""

    @contextlib.contextmanager
    def closing() -> Iterator[zenoh.Session]:
        try:
            yield session
        finally:
            session.close()  # type: ignore[no-untyped-call]

    return closing()


def connect_and_talk(port: int, count: int, bytes_each: int) -> None:
    """``count`` TCP connections one after the other, each with so many random bytes, and as many datagrams."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams:
        for _ in range(count):
            connection = socket.create_connection(("127.0.0.1", port), timeout=10)
            with connection, contextlib.suppress(OSError):  # it may have been closed on us
                connection.sendall(os.urandom(bytes_each))
            datagrams.sendto(os.urandom(min(bytes_each, 1400)), ("127.0.0.1", port))


@contextlib.contextmanager
def idle_connections(port: int, count: int) -> Iterator[None]:
    """So many TCP connections that say nothing while the context lasts."""
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
        yield


def fuzzed(chance: random.Random, real: bytes) -> bytes:
    """``real`` with bytes changed, cut or added, or other bytes altogether."""
    kind = chance.randrange(4)
    if kind == 0:
        return chance.randbytes(chance.randint(1, 400))
    changed = bytearray(real)
    if kind == 1:
        return bytes(changed[: chance.randrange(1, len(changed))])
    if kind == 2:
        return bytes(changed) + chance.randbytes(chance.randint(1, 100))
    for _ in range(chance.randint(1, 8)):
        changed[chance.randrange(len(changed))] = chance.randrange(256)
    return bytes(changed)


def forged_report(chance: random.Random, number: int, sender_epoch: int | None = None) -> bytes:
    """A well-formed report with impossible acknowledgements."""
    next_chunk = chance.choice([0, 1, 1 << 20, 1 << 52])
    return encode_report(
        ReceiverReport(
            number=number,
            receiver_id=chance.getrandbits(64),
            receiver_epoch=chance.choice([1, chance.getrandbits(32)]),
            sender_epoch=sender_epoch,
            clock_ns=time.monotonic_ns(),
            skeleton_send_ns=chance.choice([None, 0, 1 << 62]),
            skeleton_hold_ns=chance.choice([0, 1 << 62]),
            skeleton_delay_ns=chance.choice([None, -(1 << 62), 1 << 62]),
            bulk_delay_ns=chance.choice([None, -(1 << 62), 1 << 62]),
            bulk_bytes=chance.choice([0, 1 << 53]),
            next_chunk=next_chunk,
            missing_chunks=tuple(range(max(next_chunk - 128, 0), next_chunk)),
            body_revision=None,
            repository_poses=chance.choice([0, 0xFFFF]),
        )
    )
