"""``telepose-receive``: show the person of a sending site."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from common.runtime.config_file import SettingsError, load_settings
from common.runtime.daemon import leave, run_daemon, set_up_logging
from common.runtime.daemon_options import add_daemon_options, overrides
from common.runtime.threads import prepare_threads
from receiver.config import ReceiverSettings

EXAMPLES = """examples:
  telepose-receive                                    the sender on this host; the page is http://127.0.0.1:8080/
  telepose-receive -e tcp/192.0.2.7:7447              the sender on another host
  telepose-receive --headless --log-shown shown.log   no page: render offscreen and keep what was shown
"""


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Command line → options; ``--help`` explains them."""
    parser = argparse.ArgumentParser(
        prog="telepose-receive",
        description="Shows the person of a sending site in a browser page: each skeleton moves the best mesh held.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    view = parser.add_argument_group("view")
    view.add_argument(
        "--headless", dest="view.headless", action="store_true", default=None, help="no page: render offscreen"
    )
    view.add_argument(
        "--log-shown", dest="shown_log", type=Path, metavar="FILE", help="keep what was shown, for measuring"
    )
    view.add_argument("--name", dest="name", metavar="NAME", help="this receiver, in keys and logs")
    add_daemon_options(parser)
    return parser.parse_args(arguments)


def main() -> None:
    """Entry point of the console script."""
    options = parse_arguments()
    set_up_logging(options.log_level)
    prepare_threads()
    try:
        settings = load_settings(ReceiverSettings, options.config, overrides(options))
    except SettingsError as error:
        sys.exit(f"telepose-receive: {error}")
    from receiver.daemon import ReceiverDaemon  # numba and OpenCV take a second: not for --help or a wrong setting

    leave(run_daemon("telepose-receive", ReceiverDaemon(settings).run, options.ready_file))
