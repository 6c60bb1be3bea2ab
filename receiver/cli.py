"""``telepose-receive``: show the person of a sending site."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import threading
from pathlib import Path
from urllib.parse import urlsplit

from common.runtime.config_file import SettingsError, load_settings
from common.runtime.daemon import leave, run_daemon, set_up_logging
from common.runtime.daemon_options import add_daemon_options, overrides
from common.runtime.garbage import collect_later
from common.runtime.threads import prepare_threads

EXPORT_SUFFIXES = (".glb", ".ply")
EXAMPLES = """examples:
  telepose-receive                                    the sender on this host; the page is http://127.0.0.1:8080/
  telepose-receive -e tcp/192.0.2.7:7447              the sender on another host
  telepose-receive --certificates DIR -e studio.example:7447     secured: docs/deploy.md
  telepose-receive --window                           a desktop window besides the page
  telepose-receive --headless --log-shown shown.log   no page: render offscreen and keep what was shown
  telepose-receive export person.glb person.ply       the person whom a running receiver shows now, as files
  telepose-receive --record monday.mcap               keep what arrives, to be decoded afterwards
  telepose-receive decode monday.mcap monday.mp4      a session made by telepose-send encode, as a video (decode --help)
"""
DECODE_EXAMPLES = """examples:
  telepose-receive decode monday.mcap monday.mp4                      a video, from the front
  telepose-receive decode monday.mcap side.mp4 --angle 90 --size 1280x720
  telepose-receive decode monday.mcap pictures/                       000000.png, 000001.png, ... one for each frame
  telepose-receive decode monday.mcap meshes/ --as ply                the moving person as coloured meshes
  telepose-receive decode monday.mcap points.mp4 --points             the paper's way: points that residual maps update
  telepose-receive decode monday.mcap --page                          in the browser, over and over, at its own pace

Sessions are MCAP files, and need the recording extra: pip install '.[recording]'. The same file gives the same
pictures. Exit codes: 0 all of it was played, 1 nothing was, 3 it is damaged and was played up to the damage.
"""
OUT_KINDS = ("png", "ply", "glb")


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
        "--window", dest="view.window", action="store_true", default=None, help="a desktop window too (Open3D)"
    )
    view.add_argument(
        "--points", dest="view.mode", action="store_const", const="points", help="show points; P on the page switches"
    )
    view.add_argument(
        "--live", dest="view.mode", action="store_const", const="live", help="meshes follow residual maps; L switches"
    )
    view.add_argument(
        "--log-shown", dest="shown_log", type=Path, metavar="FILE", help="keep what was shown, for measuring"
    )
    view.add_argument(
        "--record", dest="session_file", type=Path, metavar="FILE.mcap", help="keep what arrives; decode plays it"
    )
    view.add_argument("--name", dest="name", metavar="NAME", help="this receiver, in keys and logs")
    parser.add_argument("--exit-with-parent", action="store_true", default=None, help="stop when standard input ends")
    add_daemon_options(parser)
    return parser.parse_args(arguments)


def parse_export_arguments(arguments: list[str]) -> argparse.Namespace:
    """What follows ``telepose-receive export`` → ``files``, ``page``, ``wait_s``."""
    parser = argparse.ArgumentParser(
        prog="telepose-receive export",
        description="Writes the person whom a running receiver shows at this moment: as GLB (textured, with the "
        "skeleton; bends by linear blend) or PLY (a colour per vertex).",
    )
    parser.add_argument("files", nargs="+", type=_export_file, metavar="FILE", help="ends in .glb or .ply")
    parser.add_argument(
        "--page",
        type=_page,
        default="http://127.0.0.1:8080/",
        metavar="URL",
        help="the receiver's (default %(default)s)",
    )
    parser.add_argument(
        "--wait", dest="wait_s", type=_seconds, default=10.0, metavar="S", help="for somebody to appear (default 10)"
    )
    return parser.parse_args(arguments)


def parse_decode_arguments(arguments: list[str]) -> argparse.Namespace:
    """What follows ``telepose-receive decode`` → ``session``, ``out`` or ``page``, and how."""
    parser = argparse.ArgumentParser(
        prog="telepose-receive decode",
        description="Plays a session that telepose-send encode has stored: each skeleton moves the best mesh there is "
        "by then, as a receiver would have shown it.",
        epilog=DECODE_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("session", type=Path, metavar="SESSION.mcap")
    parser.add_argument("out", type=Path, nargs="?", metavar="OUT", help="a video (.mp4), or a new folder")
    parser.add_argument("--as", dest="kind", choices=OUT_KINDS, default="png", help="files of a folder (default png)")
    parser.add_argument("--rate", dest="rate_hz", type=_rate, metavar="HZ", help="frames (default: the recording's)")
    parser.add_argument("--size", type=_size, default=(640, 480), metavar="WxH", help="pixels (default 640x480)")
    parser.add_argument(
        "--angle", dest="angle_deg", type=_angle, default=0.0, metavar="DEG", help="seen from there, 0: the front"
    )
    parser.add_argument(
        "--points", dest="view.mode", action="store_const", const="points", help="residual maps' points, not meshes"
    )
    parser.add_argument(
        "--live", dest="view.mode", action="store_const", const="live", help="meshes that follow residual maps"
    )
    parser.add_argument("--page", action="store_true", help="play it in the browser page instead")
    parser.add_argument("--once", action="store_true", help="with --page: end when it has been played")
    parser.add_argument("--http-port", dest="http.port", type=int, metavar="PORT", help="with --page (default 8080)")
    parser.add_argument("-c", "--config", type=Path, metavar="FILE", help="settings, TOML (see deploy/receiver.toml)")
    options = parser.parse_args(arguments)
    if options.page == (options.out is not None):
        parser.error("name a file or folder to write, or --page")
    return options


def _rate(text: str) -> float:
    return _number(text, 1, 240, "a rate in Hz")


def _angle(text: str) -> float:
    return _number(text, -360, 360, "an angle in degrees")


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isascii() and width.isdigit() and height.isascii() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size, such as 640x480")
    size = int(width), int(height)
    if not all(64 <= side <= 4096 and side % 2 == 0 for side in size):
        raise argparse.ArgumentTypeError(f"{text!r}: sides must be even, from 64 to 4096")
    return size


def _number(text: str, low: float, high: float, what: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not low <= number <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what} from {low:g} to {high:g}")
    return number


def _export_file(text: str) -> Path:
    if Path(text).suffix.lower() not in EXPORT_SUFFIXES:
        raise argparse.ArgumentTypeError(f"{text!r} does not end in {' or '.join(EXPORT_SUFFIXES)}")
    return Path(text)


def _page(text: str) -> str:
    try:
        parts = urlsplit(text)
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # a port that is no number, a bracket too many
        good = False
    if not good:
        raise argparse.ArgumentTypeError(f"{text!r} is not the address of a page, such as http://127.0.0.1:8080/")
    return text


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds <= 3600:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time of up to 3600 seconds")
    return seconds


def run_export(arguments: list[str]) -> None:
    """``telepose-receive export``; exits with a sentence and code 1 where it cannot."""
    options = parse_export_arguments(arguments)
    from receiver.export import export  # OpenCV takes a while: not for --help or a wrong option
    from receiver.viewer.person_files import ExportError

    try:
        export(options.page, options.files, options.wait_s)
    except ExportError as error:
        sys.exit(f"telepose-receive export: {error}")


def run_decode(arguments: list[str]) -> int:
    """``telepose-receive decode``: the exit code; a sentence and 1 where it cannot."""
    options = parse_decode_arguments(arguments)
    set_up_logging("INFO" if options.page else "WARNING")
    prepare_threads()
    given = {key: value for key, value in vars(options).items() if "." in key and value is not None}
    from receiver.config import ReceiverSettings  # NumPy: not before threads are prepared
    from receiver.decode import DecodeError, DecodeOptions, decode  # numba and OpenCV take a second: not for --help

    try:
        settings = load_settings(ReceiverSettings, options.config, given)
        if options.page:
            from receiver.session_page import SessionPage

            page = SessionPage(settings, options.session, options.once)
            leave(run_daemon("telepose-receive decode", page.run))
        what = options.session, options.out, options.kind, options.rate_hz, *options.size, options.angle_deg
        return decode(settings, DecodeOptions(*what), print)
    except (SettingsError, DecodeError) as error:
        sys.exit(f"telepose-receive decode: {error}")


def main() -> None:
    """Entry point of the console script."""
    if sys.argv[1:2] == ["decode"]:
        sys.exit(run_decode(sys.argv[2:]))
    if sys.argv[1:2] == ["export"]:
        return run_export(sys.argv[2:])
    collect_later()
    options = parse_arguments()
    if vars(options).pop("exit_with_parent"):
        threading.Thread(target=_stop_when_input_ends, name="parent", daemon=True).start()
    set_up_logging(options.log_level)
    prepare_threads()
    from receiver.config import ReceiverSettings  # NumPy: not before threads are prepared
    from receiver.daemon import ReceiverDaemon  # Zenoh and what reads certificates: not for --help

    try:
        settings = load_settings(ReceiverSettings, options.config, overrides(options))
    except SettingsError as error:
        sys.exit(f"telepose-receive: {error}")
    leave(run_daemon("telepose-receive", ReceiverDaemon(settings).run, options.ready_file))


def _stop_when_input_ends() -> None:
    """Whoever started this process holds the other end: it is closed when they end, however they do."""
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
