"""A Zenoh router in Python, for sites that meet at a third host, and the configuration with which zenohd is the same.

Both daemons are its clients (``[link] mode = "client"``). Each site may send its own stream and receive the others'.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import zenoh

from common.runtime.daemon import Daemon, DaemonError, leave, run_daemon, set_up_logging
from common.transport.access_rules import access_control, for_router
from common.transport.link_settings import zenoh_locators
from common.transport.site_certificate import SiteCertificate, load_site_certificate

LEASE_MS = 3000
EXAMPLES = """examples:
  ./scripts/zenoh_router --certificates certificates/hub -l 0.0.0.0:7447 --site studio --site lobby
  ./scripts/zenoh_router --certificates /etc/telepose/certificates/hub -l 0.0.0.0:7447 --site studio --site lobby \\
      --print > router.json5        and then there: zenohd -c router.json5
  ./scripts/zenoh_router -c deploy/router.json5"""


def router_values(
    certificate: SiteCertificate, listen: Sequence[str], sites: Sequence[str], realm: str = "telepose"
) -> dict[str, Any]:
    """Zenoh's configuration of a router as a nested table: TLS and QUIC alone, certificates at both ends, default deny.

    Raises:
        ValueError: a site's or realm's name that cannot be part of a key.
    """
    return {
        "mode": "router",
        "listen": {"endpoints": [each for address in listen for each in zenoh_locators(address)]},
        "connect": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "unicast": {"max_links": 2, "accept_timeout": 1000},
            "link": {
                "protocols": ["tls", "quic"],
                "tls": certificate.zenoh_tls(),
                "tx": {"lease": LEASE_MS},
                "rx": {"max_message_size": 1 << 20},
            },
            "shared_memory": {"enabled": False},
        },
        "access_control": access_control(realm, for_router(sites)),
    }


def layout(value: Any, depth: int = 0) -> str:
    """JSON to be read: nested tables and lists of tables indented, all else on one line."""
    if depth < 4 and isinstance(value, dict) and any(isinstance(item, (dict, list)) for item in value.values()):
        items = [f"{json.dumps(key)}: {layout(item, depth + 1)}" for key, item in value.items()]
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        items = [json.dumps(item) for item in value]
    else:
        return json.dumps(value)
    inner = ",\n".join("  " * (depth + 1) + item for item in items)
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return f"{opening}\n{inner}\n{'  ' * depth}{closing}"


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="./scripts/zenoh_router",
        description="Lets sites meet at this host: each sends its own stream and receives the others'.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-c", "--config", type=Path, metavar="FILE", help="Zenoh's JSON5 file, instead of all below")
    parser.add_argument(
        "--certificates", type=Path, metavar="FOLDER", help="the router's, of scripts/make_certificates"
    )
    parser.add_argument("-l", "--listen", action="append", default=[], metavar="HOST:PORT", help="where it is dialled")
    parser.add_argument("--site", dest="sites", action="append", default=[], metavar="NAME", help="who may take part")
    parser.add_argument("--realm", default="telepose", help="what is in front of every key (default: %(default)s)")
    parser.add_argument("--print", action="store_true", help="print the configuration for zenohd, and end")
    options = parser.parse_args(arguments)
    if options.config is None and not (options.certificates and options.listen and options.sites):
        parser.error("either -c, or --certificates, -l and --site")
    return options


def configuration(options: argparse.Namespace) -> dict[str, Any]:
    """What the options say; DaemonError when a file cannot be used."""
    certificate = load_site_certificate(options.certificates, datetime.now(UTC))
    try:
        return router_values(certificate, options.listen, options.sites, options.realm)
    except ValueError as error:
        raise DaemonError(str(error)) from error


def open_router(options: argparse.Namespace) -> zenoh.Session:
    """The open router session; DaemonError when it cannot be."""
    try:
        if options.config is not None:
            return zenoh.open(zenoh.Config.from_file(options.config))
        return zenoh.open(zenoh.Config.from_json5(json.dumps(configuration(options))))
    except (zenoh.ZError, OSError) as error:
        raise DaemonError(f"the router cannot be opened: {error}") from error


def main() -> None:
    options = parse_arguments()
    set_up_logging()
    if options.print:
        try:
            print(layout(configuration(options)))
        except DaemonError as error:
            sys.exit(f"zenoh_router: {error}")
        return

    async def run(daemon: Daemon) -> None:
        session = await asyncio.to_thread(open_router, options)
        try:
            daemon.announce_ready()
            await asyncio.Event().wait()
        finally:
            await asyncio.to_thread(session.close)

    leave(run_daemon("zenoh_router", run))


if __name__ == "__main__":
    main()
