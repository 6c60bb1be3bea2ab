"""Real daemons as processes on loopback, for tests and benches: started, asked over HTTP, signalled, always ended."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

BIN = Path(sys.executable).parent
START_LIMIT_S = 60.0


def free_port() -> int:
    """A port nobody listens on at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Running:
    """One process and the HTTP port of its daemon; ``log`` is its standard error."""

    def __init__(
        self, name: str, command: list[str], folder: Path, http_port: int | None, together: list[Running]
    ) -> None:
        self.name = name
        self.http_port = http_port
        self._together = together  # all processes of the site: when one waits in vain, another may be why
        self._log = folder / f"{name}.log"
        environment = os.environ | {"PYTHONSAFEPATH": "1"}
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, start_new_session=True
            )

    @property
    def log(self) -> str:
        return self._log.read_text(errors="replace")

    def get(self, path: str) -> tuple[int, str]:
        """Status and body of an HTTP request; (0, reason) when nobody answers."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.http_port}{path}", timeout=5) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()
        except OSError as error:
            return 0, str(error)

    def metric(self, name: str) -> float:
        """A number from /metrics, 0 while it is not there."""
        for line in self.get("/metrics")[1].splitlines():
            if line.startswith(f"{name} "):
                return float(line.rpartition(" ")[2])
        return 0.0

    def wait_for(self, name: str, least: float, limit_s: float = START_LIMIT_S) -> float:
        """Seconds until a metric reached ``least``; AssertionError with the log when it does not."""
        begin = time.monotonic()
        while self.metric(name) < least:
            assert self.process.poll() is None, f"{self.name} ended with {self.process.returncode}:\n{self.log}"
            if time.monotonic() - begin > limit_s:
                states = "\n".join(running.state() for running in self._together)
                raise AssertionError(f"{self.name}: {name} < {least} after {limit_s} s\n{states}")
            time.sleep(0.02)
        return time.monotonic() - begin

    def state(self) -> str:
        """What is known of the process when something went wrong: exit code, log with every thread's stack, metrics.

        A process that still runs is ended by this (SIGABRT: Python writes the stacks).
        """
        metrics = "" if self.http_port is None else self.get("/metrics")[1]
        alive = self.process.poll() is None
        if alive:
            self.process.send_signal(signal.SIGABRT)
            self.process.wait(10)
        how = "was running" if alive else f"ended with {self.process.returncode}"
        figures = "\n".join(line for line in metrics.splitlines() if not line.startswith("#"))
        return f"--- {self.name} {how}\n{self.log}\n{figures}"

    def end(self, number: signal.Signals = signal.SIGTERM, limit_s: float = 10.0) -> tuple[int, float]:
        """Send a signal; exit code and seconds until the end."""
        begin = time.monotonic()
        self.process.send_signal(number)
        return self.process.wait(limit_s), time.monotonic() - begin


class Site:
    """A rig, a sender and a receiver that share a folder and a Zenoh port."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.link = f"tcp/127.0.0.1:{free_port()}"
        self.rig_socket = folder / "rig.sock"
        self.running: list[Running] = []

    def rig(self, *options: str) -> Running:
        """A virtual rig that outlives the sender, as cameras do."""
        module = [sys.executable, "-m", "sender.capture.rig_process"]
        started = self._start("rig", [*module, "--socket", str(self.rig_socket), *options])
        begin = time.monotonic()
        while not self.rig_socket.exists():
            assert started.process.poll() is None, started.log
            assert time.monotonic() - begin < START_LIMIT_S
            time.sleep(0.05)
        return started

    def sender(self, *options: str) -> Running:
        """A sender; with no ``--recording`` among the options it attaches to the rig."""
        port = free_port()
        source = [] if "--recording" in options else ["--rig", str(self.rig_socket)]
        files = ["--state", str(self.folder), "--stats", str(self.folder / "sender.json")]
        command = [str(BIN / "telepose-send"), "-l", self.link, "--http-port", str(port), *source, *files, *options]
        return self._start("sender", command, port)

    def receiver(self, *options: str, name: str = "receiver", headless: bool = True) -> Running:
        """A receiver, with a page unless it is ``headless``."""
        port = free_port()
        files = ["--stats", str(self.folder / f"{name}.json"), *(["--headless"] if headless else [])]
        command = [str(BIN / "telepose-receive"), "-e", self.link, "--http-port", str(port), *files]
        return self._start(name, [*command, *options], port)

    def figures(self, name: str) -> dict[str, Any]:
        """What a daemon wrote at its end."""
        figures: dict[str, Any] = json.loads((self.folder / f"{name}.json").read_text())
        return figures

    def _start(self, name: str, command: list[str], port: int | None = None) -> Running:
        started = Running(name, command, self.folder, port, self.running)
        self.running.append(started)
        return started

    def close(self) -> None:
        """End whatever still runs."""
        for running in self.running:
            if running.process.poll() is None:
                running.process.kill()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    running.process.wait(5)


@contextlib.contextmanager
def site(folder: Path) -> Iterator[Site]:
    """A site whose processes end with the context."""
    made = Site(folder)
    try:
        yield made
    finally:
        made.close()
