"""A receiver that joins late over an emulated network, and daemons that are started again after kill -9.

Real daemons with certificates in two namespaces, 10 Mbit/s and 50 ms between them.

``10M/50ms/secure``: a sender and a receiver have been running for a while when another receiver joins, several times.
``first_mesh_s`` is from its first skeleton to the first whole mesh message, ``first_body_s`` to the first frame with a
mesh, which this machine has to make of it first. ``sigma_over_old``: mean σ four to six seconds after that, over the
old receiver's in the same two seconds.
``killed-receiver``, ``killed-sender``: SIGKILL, and a new process at once. ``picture_s``: from its start to the first
frame of it (of its epoch) that shows a mesh; ``skeleton_s``: to the first skeleton shown; ``picture_cpu_s``: what CPU
time the new process had used by the picture. Root only.
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

RUNS, KILLS = 3, 5
BEFORE_S, WATCH_S, SETTLE_S = 25.0, 8.0, 6.0
START_LIMIT_S = 120.0
LOOK_EVERY_S, SAMPLE_EVERY_S = 0.25, 0.01
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
NS = 1e9
JOINING, KILLED_RECEIVER, KILLED_SENDER = CASES = "10M/50ms/secure", "killed-receiver", "killed-sender"
Record = tuple[str, int, Any]


def run(data: Path | None, seconds: float | None, clips: tuple[str, ...]) -> Iterator[Row]:
    """Medians of ``RUNS`` joinings and ``KILLS`` kills; ``seconds``: how long the session ran before the first."""
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
        for case, measure in zip(CASES, (joinings, killed_receivers, killed_senders), strict=True):
            if not clips or case in clips:
                network.report()
                rows = list(measure(session))
                how = f"certificates, {network.report().about}"
                for row in rows:
                    row["case"], row["source"] = case, f"{row['source']}, {how}"
                yield from rows
        end(old)


def joinings(session: Session) -> Iterator[Row]:
    late: list[list[Record]] = []
    for number in range(RUNS):
        say(f"joining {number + 1}/{RUNS}")
        process = session.receiver(f"late{number}")
        session.wait_for_body(f"late{number}")
        time.sleep(WATCH_S)
        end(process)
        late.append(session.records(f"late{number}"))
    found = [figures(records, session.records("old")) for records in late]
    goals = (("first_mesh_s", "s", None), ("first_body_s", "s", 1), ("sigma_over_old", "1", 1.2))
    yield from medians(found, goals)


def killed_receivers(session: Session) -> Iterator[Row]:
    found: list[dict[str, float]] = []
    victim = session.receiver("victim", "victim")
    session.wait_for_body("victim")
    for number in range(KILLS):
        time.sleep(SETTLE_S)
        log = f"victim{number}"
        kill(victim)
        begin_ns = time.monotonic_ns()
        victim = session.receiver("victim", log)
        cpu = session.wait_for_body(log, victim)
        found.append(started(begin_ns, session.records(log), cpu))
        say(f"receiver killed {number + 1}/{KILLS}: {found[-1]}")
    end(victim)
    yield from medians(found, STARTED_GOALS)


def killed_senders(session: Session) -> Iterator[Row]:
    found: list[dict[str, float]] = []
    for number in range(KILLS):
        time.sleep(SETTLE_S)
        kill(session.sender)
        begin_ns = time.monotonic_ns()
        session.start_sender()

        def since(begin_ns: int = begin_ns) -> list[Record]:
            return of_new_epoch(session.records("old"), begin_ns)

        cpu = session.wait_for("a body", lambda: first_frame(since(), with_mesh=True) is not None, session.sender)
        found.append(started(begin_ns, since(), cpu))
        say(f"sender killed {number + 1}/{KILLS}: {found[-1]}")
    yield from medians(found, STARTED_GOALS)


STARTED_GOALS = (("skeleton_s", "s", None), ("picture_s", "s", 2), ("picture_cpu_s", "s", None))


def medians(found: list[dict[str, float]], goals: tuple[tuple[str, str, float | None], ...]) -> Iterator[Row]:
    for metric, unit, reference in goals:
        values = sorted(each[metric] for each in found)
        source = f"median of {len(found)} ({values[0]:.2f} to {values[-1]:.2f})"
        yield Row(case="", metric=metric, value=median(values), unit=unit, reference=reference, source=source)


class Session:
    """A sender on side A that has its cameras there; receivers start on side B."""

    def __init__(self, network: EmulatedNetwork, folder: Path, stack: contextlib.ExitStack) -> None:
        self._network, self._folder, self._stack = network, folder, stack
        make(folder / "sites", [("studio", [network.addresses["A"]]), ("lobby", [])])
        self._rig = folder / "rig.sock"
        small = ("--width", "320", "--height", "240", "--fps", "15")
        self._start("A", [sys.executable, "-m", "sender.capture.rig_process", "--socket", str(self._rig), *small])
        self.wait_for("the rig", self._rig.exists)
        self.start_sender()

    def start_sender(self) -> None:
        """``sender``; it goes on with the body that the one before has kept."""
        secured = [
            "--certificates",
            str(self._folder / "sites" / "studio"),
            "-l",
            "0.0.0.0:7447",
            "--receiver",
            "lobby",
        ]
        source = ["--rig", str(self._rig), "--state", str(self._folder)]
        self.sender = self._start("A", [f"{BIN}/telepose-send", *secured, *source])

    def receiver(self, name: str, log: str = "") -> subprocess.Popen[bytes]:
        """``log``: what it shows is kept under that name, ``name`` unless told otherwise."""
        secured = [
            "--certificates",
            str(self._folder / "sites" / "lobby"),
            "-e",
            f"{self._network.addresses['A']}:7447",
        ]
        what = ["--name", name, "--headless", "--log-shown", str(self._folder / (log or name)), "--http-port", "0"]
        return self._start("B", [f"{BIN}/telepose-receive", *secured, *what])

    def records(self, name: str) -> list[Record]:
        """What a receiver logged so far."""
        file = self._folder / name
        return list(read_show_log(file)) if file.exists() else []

    def wait_for_body(self, log: str, process: subprocess.Popen[bytes] | None = None) -> list[tuple[int, float]]:
        return self.wait_for(
            f"a body at {log}", lambda: first_frame(self.records(log), with_mesh=True) is not None, process
        )

    def wait_for(
        self, what: str, condition: Callable[[], bool], process: subprocess.Popen[bytes] | None = None
    ) -> list[tuple[int, float]]:
        """Until it holds; the CPU time [s] of ``process`` meanwhile, by time [ns]."""
        begin_s = looked_s = time.monotonic()
        samples: list[tuple[int, float]] = []
        while True:
            now_s = time.monotonic()
            if now_s - looked_s >= LOOK_EVERY_S:
                if condition():
                    return samples
                looked_s = now_s
            if now_s - begin_s > START_LIMIT_S:
                raise SystemExit(f"joining: no sign of {what} after {START_LIMIT_S:.0f} s")
            if process is not None:
                samples.append((time.monotonic_ns(), cpu_s(process)))
            time.sleep(SAMPLE_EVERY_S)

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
        return float(mean(p[3] for kind, t, p in records if kind == "frame" and t in span and p[3] is not None))

    return {
        "first_mesh_s": (mesh_ns - skeleton_ns) / NS,
        "first_body_s": (body_ns - skeleton_ns) / NS,
        "sigma_over_old": sigma(late) / sigma(old),
    }


def first_frame(records: list[Record], with_mesh: bool) -> int | None:
    """When it was shown."""
    return next((t for kind, t, shown in records if kind == "frame" and (shown[2] is not None or not with_mesh)), None)


def of_new_epoch(records: list[Record], begin_ns: int) -> list[Record]:
    """The frames of a run of the sender of which there were none before ``begin_ns``."""
    frames = [record for record in records if record[0] == "frame"]
    before = {shown[0] for _, t, shown in frames if t < begin_ns}
    return [record for record in frames if record[2][0] not in before]


def started(begin_ns: int, records: list[Record], cpu: list[tuple[int, float]]) -> dict[str, float]:
    """Of one start, from what a receiver logged and the CPU time of the process that was started."""
    skeleton_ns, picture_ns = first_frame(records, with_mesh=False), first_frame(records, with_mesh=True)
    assert skeleton_ns is not None
    assert picture_ns is not None
    return {
        "skeleton_s": (skeleton_ns - begin_ns) / NS,
        "picture_s": (picture_ns - begin_ns) / NS,
        "picture_cpu_s": max((used_s for t, used_s in cpu if t <= picture_ns), default=0.0),
    }


def cpu_s(process: subprocess.Popen[bytes]) -> float:
    """User's and system's time [s] of all threads."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def say(text: str) -> None:
    print(f"joining: {text}", file=sys.stderr, flush=True)


def kill(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
