"""Where a daemon serves HTTP, and when that may be open to other hosts."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class HttpSettings:
    """Where /healthz, /readyz, /metrics and the page are served. ``host``: beyond loopback only with both others.

    ``token_file``: its one line is what a client has to show. ``certificates``: a folder with ``certificate.pem`` and
    ``key.pem``, as ``scripts/make_certificates`` makes it.
    """

    host: str = "127.0.0.1"
    port: int = 0  # 0: any free port, named in the log
    token_file: Path | None = None
    certificates: Path | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port: {self.port} is outside 0..65535")
        if not is_loopback(self.host) and not (self.token_file and self.certificates):
            raise ValueError(f"host: {self.host!r} is open to others: that needs token_file and certificates, too")


def is_loopback(host: str) -> bool:
    """Whether only this host can reach what listens there."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
