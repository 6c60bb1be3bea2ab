"""Certificates for tests of secured links, and raw Zenoh sessions for those who should not get in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import zenoh

from scripts.make_certificates import new_authority, new_certificate, write_site

ADDRESSES = {"studio": ["127.0.0.1"], "hub": ["127.0.0.1"], "elsewhere": ["elsewhere.example"]}


def make_sites(folder: Path) -> Path:
    """Folders ``studio lobby wall rogue hub elsewhere`` of one authority, ``expired`` (a lobby's of yesterday) and
    ``foreign`` (a lobby's of another authority)."""
    authority = new_authority()
    for name in ("studio", "lobby", "wall", "rogue", "hub", "elsewhere"):
        write_site(folder / name, authority, *new_certificate(authority, name, ADDRESSES.get(name, ())))
    write_site(folder / "expired", authority, *new_certificate(authority, "lobby", days=-1 / 48))
    other = new_authority()
    write_site(folder / "foreign", other, *new_certificate(other, "lobby", ["127.0.0.1"]))
    return folder


def pair(port: int) -> list[str]:
    """Zenoh's locators of the secure pair on loopback."""
    return [f"quic/127.0.0.1:{port}?rel=0", f"tls/127.0.0.1:{port}?rel=1"]


def outsider(connect: list[str], site: Path | None = None, ca: Path | None = None, **values: object) -> zenoh.Session:
    """A session that dials with what it has and gives up after a second; it obeys no access rules of its own.

    ``site``: the folder of its certificate; ``ca``: of the authority it trusts, else its own.

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
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_links": 2,
        "namespace": "telepose",
        **({"transport/link/tls": tls} if site or ca else {}),
        **values,
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
