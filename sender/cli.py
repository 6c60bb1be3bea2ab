"""``telepose-send``: capture a person and publish skeletons and candidate poses."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from common.runtime.config_file import SettingsError, load_settings
from common.runtime.daemon import leave, run_daemon, set_up_logging
from common.runtime.daemon_options import add_daemon_options, overrides
from common.runtime.threads import prepare_threads
from sender.config import SenderSettings

EXAMPLES = """examples:
  telepose-send                                       the built-in performer before four virtual cameras
  telepose-send -l tcp/0.0.0.0:7447                   the same, for receivers on other hosts
  telepose-send --certificates DIR -l 0.0.0.0:7447 --receiver lobby       secured: docs/deploy.md
  telepose-send --self-view                           and a page of one's own: http://127.0.0.1:8081/
  telepose-send --recording DIR                       a recording (its format: docs/recordings.md)
  telepose-send --data DIR --body NAME --motion ID    a body and a motion clip of your own
"""


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Command line → options; ``--help`` explains them."""
    parser = argparse.ArgumentParser(
        prog="telepose-send",
        description="Captures one person; publishes a 250-byte skeleton every frame, and meshes as bandwidth allows.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    capture = parser.add_argument_group("capture")
    capture.add_argument("--recording", dest="capture.recording", type=Path, metavar="PATH", help="play a recording")
    capture.add_argument("--rig", dest="capture.rig_socket", type=Path, metavar="SOCKET", help="attach to this rig")
    capture.add_argument("--body", dest="capture.body", metavar="NAME", help="builtin (default), or a body of --data")
    capture.add_argument("--motion", dest="capture.motion", metavar="ID", help="a motion clip of --data")
    capture.add_argument("--data", dest="capture.data", type=Path, metavar="DIR", help="folder with bodies/ and mocap/")
    capture.add_argument("--cameras", dest="capture.cameras", type=int, metavar="N", help="virtual cameras (default 4)")
    capture.add_argument(
        "--no-depth", dest="capture.depth", action="store_false", default=None, help="use a rig's colour only"
    )
    capture.add_argument("--loop", dest="capture.loop", action="store_true", default=None, help="repeat the recording")
    capture.add_argument(
        "--as-fast-as-possible", dest="capture.realtime", action="store_false", default=None, help="not at its own rate"
    )
    capture.add_argument(
        "--state", dest="state_folder", type=Path, metavar="DIR", help="where the body found is kept for a restart"
    )
    own = parser.add_argument_group("self view")
    own.add_argument(
        "--self-view", dest="self_view.enabled", action="store_true", default=None, help="show this person here too"
    )
    own.add_argument(
        "--self-view-port", dest="self_view.port", type=int, metavar="PORT", help="of its page (default 8081)"
    )
    parser.add_argument(
        "--tracker", dest="tracking.tracker", metavar="NAME", help="gauss-newton (default), articp or particles"
    )
    parser.add_argument(
        "--receiver", dest="receivers", action="append", metavar="SITE", help="with --certificates: who may receive"
    )
    add_daemon_options(parser)
    return parser.parse_args(arguments)


def source_of(given: dict[str, object]) -> dict[str, object]:
    """Settings given on the command line, with the capture source that they imply."""
    if "capture.recording" in given:
        return given | {"capture.source": "recording"}
    return given | {"capture.source": "rig"} if "capture.rig_socket" in given else given


def main() -> None:
    """Entry point of the console script."""
    options = parse_arguments()
    set_up_logging(options.log_level)
    prepare_threads()
    try:
        settings = load_settings(SenderSettings, options.config, source_of(overrides(options)))
    except SettingsError as error:
        sys.exit(f"telepose-send: {error}")
    from sender.daemon import SenderDaemon  # numba and OpenCV take a second: not for --help or a wrong setting

    leave(run_daemon("telepose-send", SenderDaemon(settings).run, options.ready_file))
