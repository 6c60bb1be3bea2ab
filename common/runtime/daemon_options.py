"""The command-line options both daemons share, named as in Zenoh's own examples where they are Zenoh's."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_daemon_options(parser: argparse.ArgumentParser) -> None:
    """Options for settings, links, HTTP, files and logging; their ``dest`` is the dotted settings key they override."""
    parser.add_argument("-c", "--config", type=Path, metavar="FILE", help="settings, TOML (see deploy/)")
    parser.add_argument("--site", dest="site", metavar="NAME", help="the sending site's name (default: studio)")
    parser.add_argument("--person", dest="person", type=int, metavar="N", help="which person of the site (default: 0)")
    link = parser.add_argument_group("Zenoh")
    link.add_argument("-m", "--mode", dest="link.mode", choices=("peer", "client"), help="peer (default) or client")
    link.add_argument(
        "-e", "--connect", dest="link.connect", action="append", metavar="LOCATOR", help="dial, as tcp/192.0.2.7:7447"
    )
    link.add_argument(
        "-l", "--listen", dest="link.listen", action="append", metavar="LOCATOR", help="listen, as tcp/0.0.0.0:7447"
    )
    link.add_argument(
        "--certificates", dest="link.certificates", type=Path, metavar="FOLDER",
        help="secure every link with this site's certificate (scripts/make_certificates); -e and -l are then HOST:PORT",
    )  # fmt: skip
    link.add_argument(
        "--zenoh-config", dest="link.config_file", type=Path, metavar="FILE", help="Zenoh's own JSON5 settings"
    )
    files = parser.add_argument_group("service")
    files.add_argument("--http-port", dest="http.port", type=int, metavar="PORT", help="0: any free port")
    files.add_argument("--stats", dest="stats_file", type=Path, metavar="FILE", help="write figures here at the end")
    files.add_argument("--ready-file", type=Path, metavar="FILE", help="exists while the daemon does its job")
    files.add_argument("--log-level", default="INFO", choices=("DEBUG", "INFO", "WARNING", "ERROR"))


def overrides(options: argparse.Namespace) -> dict[str, object]:
    """The settings given on the command line, by dotted key."""
    own = {"config", "ready_file", "log_level"}
    return {key: value for key, value in vars(options).items() if key not in own and value is not None}
