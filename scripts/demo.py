"""The demo: one sender daemon and one receiver daemon as two processes, and a report of what the receiver showed."""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from scripts.daemon_processes import free_port

BIN = Path(sys.executable).parent
EXIT_DEADLINE_S = 2.5
START_DEADLINE_S = 60.0


def main() -> int:
    options = parse_arguments()
    with tempfile.TemporaryDirectory(prefix="telepose-demo-") as folder:
        run = Path(folder)
        daemons = start_daemons(options, run)
        interrupted = False
        try:
            wait_until_ready(daemons, run)
            announce(options)
            watch(daemons, options.seconds)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            codes = stop(daemons)
        if any(codes.values()):
            print(f"demo: a daemon failed: {codes}", file=sys.stderr)
            return 1
        if options.report and not interrupted:
            from scripts.demo_report import demo_report  # the report's libraries are not needed to run the demo

            report = demo_report(run, options.body, options.motion, options.data)
            options.report.write_text(json.dumps(report, indent=2) + "\n")
            print(json.dumps(report, indent=2))
    return 0


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="./scripts/demo",
        description="Show a person, captured by four virtual depth cameras, moving in a browser page. "
        "A sender and a receiver daemon talk over Zenoh on loopback. Ctrl-C ends both.",
    )
    parser.add_argument("--headless", action="store_true", help="no page: render offscreen")
    parser.add_argument("--seconds", type=float, default=None, metavar="N", help="stop after N seconds")
    parser.add_argument("--report", type=Path, metavar="FILE", help="measure the run and write the figures as JSON")
    parser.add_argument("--body", default="builtin", metavar="NAME", help="builtin, or a body of --data")
    parser.add_argument("--motion", metavar="ID", help="a motion clip of --data (default: the built-in choreography)")
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder with bodies/ and mocap/")
    parser.add_argument("--recording", type=Path, metavar="DIR", help="play a recording instead of the virtual rig")
    parser.add_argument("--cameras", type=int, default=4, metavar="N", help="cameras of the virtual rig (default 4)")
    parser.add_argument("--self-view", action="store_true", help="the sender's own page too")
    parser.add_argument("--port", type=int, default=8080, help="port of the page (default 8080, or a free one)")
    options = parser.parse_args()
    if options.report and options.recording:
        parser.error("--report compares with the virtual rig's truth; a recording has none")
    if options.report and options.seconds is None:
        options.seconds = 30.0
    options.zenoh_port = free_port()
    options.self_view_port = free_port()
    options.port = options.port if port_is_free(options.port) else free_port()
    return options


def port_is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def start_daemons(options: argparse.Namespace, run: Path) -> dict[str, subprocess.Popen[bytes]]:
    link = f"tcp/127.0.0.1:{options.zenoh_port}"
    send = [str(BIN / "telepose-send"), "-l", link, "--http-port", "0", "--state", str(run)]
    send += ["--stats", str(run / "sender.json"), "--ready-file", str(run / "sender.ready")]
    if options.recording:
        send += ["--recording", str(options.recording), *([] if options.headless else ["--loop"])]
    else:
        send += ["--body", options.body, "--cameras", str(options.cameras)]
    send += ["--self-view", "--self-view-port", str(options.self_view_port)] if options.self_view else []
    send += ["--motion", options.motion] if options.motion else []
    send += ["--data", str(options.data)] if options.data else []
    receive = [str(BIN / "telepose-receive"), "-e", link, "--http-port", str(options.port)]
    receive += ["--stats", str(run / "receiver.json"), "--ready-file", str(run / "receiver.ready")]
    receive += ["--headless"] if options.headless else []
    receive += ["--log-shown", str(run / "shown.log")] if options.report else []
    environment = os.environ | {"PYTHONSAFEPATH": "1"}
    # A group of its own each: Ctrl-C at the terminal reaches the demo alone, which then ends both in order.
    return {
        "receiver": subprocess.Popen(receive, env=environment, start_new_session=True),
        "sender": subprocess.Popen(send, env=environment, start_new_session=True),
    }


def wait_until_ready(daemons: dict[str, subprocess.Popen[bytes]], run: Path) -> None:
    deadline = time.monotonic() + START_DEADLINE_S
    while not all((run / f"{name}.ready").exists() for name in daemons):
        for name, daemon in daemons.items():
            if daemon.poll() is not None:
                raise SystemExit(f"demo: the {name} ended with code {daemon.returncode} before it was ready")
        if time.monotonic() > deadline:
            raise SystemExit(f"demo: the daemons were not ready within {START_DEADLINE_S:.0f} s")
        time.sleep(0.05)


def announce(options: argparse.Namespace) -> None:
    if not options.headless:
        print(f"\n  Open  http://127.0.0.1:{options.port}/  to see the person. Ctrl-C ends the demo.\n", flush=True)
    if options.self_view:
        print(f"  Open  http://127.0.0.1:{options.self_view_port}/  for what the sender sees of itself.\n", flush=True)


def watch(daemons: dict[str, subprocess.Popen[bytes]], seconds: float | None) -> None:
    end = None if seconds is None else time.monotonic() + seconds
    while end is None or time.monotonic() < end:
        if any(daemon.poll() is not None for daemon in daemons.values()):
            return
        time.sleep(0.1)


def stop(daemons: dict[str, subprocess.Popen[bytes]]) -> dict[str, int]:
    for daemon in daemons.values():
        if daemon.poll() is None:
            daemon.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + EXIT_DEADLINE_S
    codes = {}
    for name, daemon in daemons.items():
        try:
            codes[name] = daemon.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            print(f"demo: the {name} did not end within {EXIT_DEADLINE_S} s and is killed", file=sys.stderr)
            daemon.kill()
            codes[name] = daemon.wait()
    return codes


if __name__ == "__main__":
    for stop_signal in (signal.SIGINT, signal.SIGTERM):  # a shell starts what it puts behind with SIGINT ignored
        signal.signal(stop_signal, signal.default_int_handler)
    sys.exit(main())
