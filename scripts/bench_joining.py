"""A receiver that joins late over an emulated network: when it sees a body, and how its σ compares with an old one's.

Real daemons with certificates in two namespaces, 10 Mbit/s and 50 ms between them; a sender and a receiver have been
running for a while when another receiver joins, several times. ``first_mesh_s`` is from its first skeleton to the first
whole mesh message, ``first_body_s`` to the first frame with a mesh, which this machine has to make of it first.
``sigma_over_old``: mean σ four to six seconds after that, over the old receiver's in the same two seconds. Root only.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import mean, median
from typing import Any

from receiver.show_log import read_show_log
from scripts.daemon_processes import BIN
from scripts.link_model import LinkConditions
from scripts.make_certificates import make
from scripts.network_emulation import EmulatedNetwork, Side, emulated_network, unavailable
from scripts.run_bench import Row

RUNS = 3
BEFORE_S, WATCH_S = 25.0, 8.0
START_LIMIT_S = 120.0
NS = 1e9
Record = tuple[str, int, Any]


def run(data: Path | None, seconds: float | None, clips: tuple[str, ...]) -> Iterator[Row]:
    """Medians of ``RUNS`` joinings; ``seconds``: how long the session ran before the first."""
    why = unavailable()
    if why is not None:
        raise SystemExit(f"joining: {why}")
    with (
        tempfile.TemporaryDirectory(prefix="telepose-bench-") as folder,
        emulated_network(LinkConditions(rate_bps=10e6, delay_ms=25)) as network,
        contextlib.ExitStack() as stack,
    ):
        session = Session(network, Path(folder), stack)
        old = session.receiver("old")
        session.wait_for_body("old")
        time.sleep(seconds or BEFORE_S)
        late: list[list[Record]] = []
        for number in range(RUNS):
            print(f"joining: {number + 1}/{RUNS}", file=sys.stderr, flush=True)
            process = session.receiver(f"late{number}")
            session.wait_for_body(f"late{number}")
            time.sleep(WATCH_S)
            end(process)
            late.append(session.records(f"late{number}"))
        end(old)
        emulator = network.report()
        source = f"median of {RUNS}, certificates, user-space emulator late by {emulator.late_p99_ms:.2f} ms at p99"
        found = [figures(records, session.records("old")) for records in late]
        goals = (("first_mesh_s", "s", None), ("first_body_s", "s", 1), ("sigma_over_old", "1", 1.2))
        for metric, unit, reference in goals:
            value = median(each[metric] for each in found)
            yield Row(case="10M/50ms/secure", metric=metric, value=value, unit=unit, reference=reference, source=source)


class Session:
    """A sender on side A that has its cameras there; receivers start on side B."""

    def __init__(self, network: EmulatedNetwork, folder: Path, stack: contextlib.ExitStack) -> None:
        self._network, self._folder, self._stack = network, folder, stack
        make(folder / "sites", [("studio", [network.addresses["A"]]), ("lobby", [])])
        rig = folder / "rig.sock"
        small = ("--width", "320", "--height", "240", "--fps", "15")
        self._start("A", [sys.executable, "-m", "sender.capture.rig_process", "--socket", str(rig), *small])
        wait_until(rig.exists, "the rig")
        secured = ["--certificates", str(folder / "sites" / "studio"), "-l", "0.0.0.0:7447", "--receiver", "lobby"]
        self._start("A", [f"{BIN}/telepose-send", *secured, "--rig", str(rig), "--state", str(folder)])

    def receiver(self, name: str) -> subprocess.Popen[bytes]:
        secured = [
            "--certificates",
            str(self._folder / "sites" / "lobby"),
            "-e",
            f"{self._network.addresses['A']}:7447",
        ]
        what = ["--name", name, "--headless", "--log-shown", str(self._folder / name), "--http-port", "0"]
        return self._start("B", [f"{BIN}/telepose-receive", *secured, *what])

    def records(self, name: str) -> list[Record]:
        """What a receiver logged so far."""
        file = self._folder / name
        return list(read_show_log(file)) if file.exists() else []

    def wait_for_body(self, name: str) -> None:
        def seen() -> bool:
            return any(kind == "frame" and payload[2] is not None for kind, _, payload in self.records(name))

        wait_until(seen, f"a body at {name}")

    def _start(self, side: Side, command: list[str]) -> subprocess.Popen[bytes]:
        environment = os.environ | {"PYTHONSAFEPATH": "1"}
        log = self._stack.enter_context((self._folder / f"{len(list(self._folder.iterdir()))}.log").open("wb"))
        process = subprocess.Popen(
            self._network.command(side, command), env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log
        )
        self._stack.callback(end, process)
        return process


def figures(late: list[Record], old: list[Record]) -> dict[str, float]:
    """Of one joining, from what both receivers logged."""
    skeleton_ns, mesh_ns = (next(t for kind, t, _ in late if kind == wanted) for wanted in ("skeleton", "pose"))
    body_ns = next(t for kind, t, payload in late if kind == "frame" and payload[2] is not None)

    def sigma(records: list[Record]) -> float:
        span = range(body_ns + 4 * 10**9, body_ns + 6 * 10**9)
        return mean(p[3] for kind, t, p in records if kind == "frame" and t in span and p[3] is not None)

    return {
        "first_mesh_s": (mesh_ns - skeleton_ns) / NS,
        "first_body_s": (body_ns - skeleton_ns) / NS,
        "sigma_over_old": sigma(late) / sigma(old),
    }


def wait_until(condition: Callable[[], bool], what: str) -> None:
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > START_LIMIT_S:
            raise SystemExit(f"joining: no sign of {what} after {START_LIMIT_S:.0f} s")
        time.sleep(0.1)


def end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
