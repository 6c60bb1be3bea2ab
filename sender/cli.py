"""``telepose-send``: capture a person and publish skeletons and candidate poses."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from common.runtime.config_file import SettingsError, load_settings
from common.runtime.daemon import leave, run_daemon, set_up_logging
from common.runtime.daemon_options import add_daemon_options, overrides
from common.runtime.garbage import collect_later
from common.runtime.threads import prepare_threads

EXAMPLES = """examples:
  telepose-send                                       the built-in performer before four virtual cameras
  telepose-send -l tcp/0.0.0.0:7447                   the same, for receivers on other hosts
  telepose-send --certificates DIR -l 0.0.0.0:7447 --receiver lobby       secured: docs/deploy.md
  telepose-send --self-view                           and a page of one's own: http://127.0.0.1:8081/
  telepose-send --recording DIR                       a recording (its format: docs/recordings.md)
  telepose-send --data DIR --body NAME --motion ID    a body and a motion clip of your own
  telepose-send encode DIR OUT.mcap                   a recording into one small file, without a network (encode --help)
"""
ENCODE_EXAMPLES = """examples:
  telepose-send encode recordings/monday monday.mcap             what a link of 4 Mbit/s would carry
  telepose-send encode recordings/monday thin.mcap --mbit 0.5    a smaller file: fewer and coarser meshes
  telepose-send encode DIR skeletons.mcap --no-poses --no-residuals    skeletons alone: 7.5 KB/s
  telepose-send encode DIR video.mcap --residual-video 8         finer residual maps for the bytes
  telepose-receive decode monday.mcap monday.mp4                 and back: as a video (decode --help)

The file holds what would go over the network, as it would at that bandwidth: the same recording and settings give the
same file. It is an MCAP file (https://mcap.dev), and needs the recording extra: pip install '.[recording]'.
Ctrl-C ends early and keeps what there is.
"""
LEAST_MBIT, MOST_MBIT = 0.1, 10_000.0


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
    add_residual_video(parser)
    add_daemon_options(parser)
    return parser.parse_args(arguments)


def add_residual_video(parser: argparse.ArgumentParser) -> None:
    """The option of both commands."""
    parser.add_argument(
        "--residual-video",
        dest="residuals.video_frames",
        type=int,
        metavar="N",
        help="residual maps of N frames as a short video (2 to 30, typically 8; default 0: off): about half the bytes; "
        "live, maps are shown N frames (8 at 30 fps: 0.27 s) and what sending them takes later than skeletons, which "
        "are not delayed; in a file they are in step. Needs the video extra, here and where maps are shown",
    )


def parse_encode_arguments(arguments: list[str]) -> argparse.Namespace:
    """What follows ``telepose-send encode`` → ``recording``, ``file``, ``mbit``, ``seconds``, and settings by key."""
    parser = argparse.ArgumentParser(
        prog="telepose-send encode",
        description="Stores a recording as a receiver would get it: a skeleton of every frame, and, as the bandwidth "
        "allows, meshes and residual maps. Says what each takes, beside the raw images.",
        epilog=ENCODE_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recording", type=Path, metavar="RECORDING", help="folder or file (docs/recordings.md)")
    parser.add_argument("file", type=_session_file, metavar="OUT.mcap", help="the file to write; replaced when whole")
    parser.add_argument(
        "--mbit", type=_mbit, default=4.0, metavar="N", help="bandwidth in Mbit/s, skeletons included (default 4)"
    )
    parser.add_argument("--seconds", type=_seconds, metavar="S", help="only the first so many seconds")
    parser.add_argument("-c", "--config", type=Path, metavar="FILE", help="settings, TOML (see deploy/sender.toml)")
    parser.add_argument("--site", dest="site", metavar="NAME", help="the name in the file's keys (default: studio)")
    parser.add_argument("--person", dest="person", type=int, metavar="N", help="which person of it (default: 0)")
    parser.add_argument("--tracker", dest="tracking.tracker", metavar="NAME", help="as of telepose-send")
    parser.add_argument("--no-poses", dest="poses.enabled", action="store_false", default=None, help="no meshes")
    parser.add_argument(
        "--no-residuals", dest="residuals.mode", action="store_const", const="off", help="no maps of what is missed"
    )
    add_residual_video(parser)
    return parser.parse_args(arguments)


def _session_file(text: str) -> Path:
    if Path(text).suffix != ".mcap":
        raise argparse.ArgumentTypeError(f"{text!r} does not end in .mcap")
    return Path(text)


def _mbit(text: str) -> float:
    return _number(text, LEAST_MBIT, MOST_MBIT, "a bandwidth in Mbit/s")


def _seconds(text: str) -> float:
    return _number(text, 0.1, 1e6, "a time in seconds")


def _number(text: str, low: float, high: float, what: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = -1.0
    if not low <= number <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what} from {low:g} to {high:g}")
    return number


def run_encode(arguments: list[str]) -> int:
    """``telepose-send encode``: the exit code; a sentence and 1 where it cannot."""
    options = vars(parse_encode_arguments(arguments))
    recording, file, mbit, seconds = (options.pop(name) for name in ("recording", "file", "mbit", "seconds"))
    given = {key: value for key, value in options.items() if key != "config" and value is not None}
    set_up_logging("WARNING")
    prepare_threads()
    from sender.config import SenderSettings  # NumPy: not before threads are prepared
    from sender.encode import EncodeError, EncodeOptions, encode  # numba and OpenCV take a second: not for --help

    try:
        settings = load_settings(SenderSettings, options["config"], given)
        return encode(settings, EncodeOptions(recording, file, mbit, seconds), print)
    except (SettingsError, EncodeError) as error:
        sys.exit(f"telepose-send encode: {error}")


def source_of(given: dict[str, object]) -> dict[str, object]:
    """Settings given on the command line, with the capture source that they imply."""
    if "capture.recording" in given:
        return given | {"capture.source": "recording"}
    return given | {"capture.source": "rig"} if "capture.rig_socket" in given else given


def main() -> None:
    """Entry point of the console script."""
    if sys.argv[1:2] == ["encode"]:
        sys.exit(run_encode(sys.argv[2:]))
    collect_later()
    options = parse_arguments()
    set_up_logging(options.log_level)
    prepare_threads()
    from sender.config import SenderSettings  # NumPy: not before threads are prepared
    from sender.daemon import SenderDaemon  # Zenoh and what reads certificates: not for --help

    try:
        settings = load_settings(SenderSettings, options.config, source_of(overrides(options)))
    except SettingsError as error:
        sys.exit(f"telepose-send: {error}")
    leave(run_daemon("telepose-send", SenderDaemon(settings).run, options.ready_file))
