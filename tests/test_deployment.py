"""The ten commands of docs/deploy.md between two network namespaces, as they stand there.

Cloning and set-up are left out (the checkout here is used), copying to the other host is copying to another folder, and
host names are addresses; two cameras instead of four leave the machine time for the rest. Root only, and since both
daemons start from nothing it takes long: ``-m network_long``, or TELEPOSE_NETWORK_LONG in the environment.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from scripts.link_model import LinkConditions
from scripts.network_emulation import EmulatedNetwork, emulated_network, unavailable
from tests.listening_sockets import listening_ports

WHY_NOT = unavailable()
pytestmark = [
    pytest.mark.network,
    pytest.mark.network_long,
    pytest.mark.skipif(WHY_NOT is not None, reason=WHY_NOT or ""),
]
LONG = "TELEPOSE_NETWORK_LONG"

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
SIDES = {"studio": "A", "lobby": "B"}
START_LIMIT_S = 90.0
DAEMONS = ("telepose-send", "telepose-receive")


def commands() -> list[tuple[str, str]]:
    """Host and command of the document's first block."""
    block = (ROOT / "docs" / "deploy.md").read_text().split("```")[1]
    return re.findall(r"(?m)^(\w+)\$ +(.*)$", block)


class Hosts:
    """The two hosts; what was typed and what came of it is kept in ``transcript``."""

    def __init__(self, network: EmulatedNetwork, folder: Path) -> None:
        self.network, self.folder = network, folder
        self.transcript: list[str] = []
        self.daemons: dict[str, subprocess.Popen[bytes]] = {}
        self._environment = os.environ | {"PYTHONPATH": str(ROOT), "HOME": str(folder / "lobby")}
        for host in SIDES:
            (folder / host).mkdir()

    def run(self, host: str, typed: str) -> str:
        """The output of a command; of a daemon, which goes on, nothing."""
        command = typed.replace("studio.example", self.network.addresses["A"])
        command = command.replace("scp -r", "cp -r").replace("lobby.example:", str(self.folder / "lobby"))
        command = command.replace(".venv/bin/", f"{BIN}/")
        command = re.sub(r"\./scripts/(\w+)", rf"{sys.executable} -m scripts.\1", command)
        command = command.replace("--receiver lobby", "--receiver lobby --cameras 2")
        whole = self.network.command(SIDES[host], ["bash", "-c", f"exec {command}" if "|" not in command else command])
        daemon = next((name for name in DAEMONS if name in command), None)
        if daemon is not None:
            with (self.folder / f"{daemon}.log").open("wb") as log:
                self.daemons[daemon] = subprocess.Popen(
                    whole, cwd=self.folder / host, env=self._environment, stdout=log, stderr=log
                )
            self.transcript.append(f"{host}$ {typed} &")
            return ""
        done = subprocess.run(
            whole,
            cwd=self.folder / host,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        return done.stdout + done.stderr

    def note(self, host: str, typed: str, output: str) -> None:
        self.transcript += [f"{host}$ {typed}", *output.replace(str(self.folder), "").splitlines()]

    def log(self, daemon: str) -> str:
        return (self.folder / f"{daemon}.log").read_text(errors="replace")

    def close(self) -> None:
        for process in self.daemons.values():
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self.daemons.values():
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@pytest.fixture
def hosts(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Hosts]:
    if not os.environ.get(LONG) and "network_long" not in request.config.option.markexpr:
        pytest.skip(f"takes long: -m network_long, or {LONG}=1")
    with emulated_network(LinkConditions(rate_bps=10e6, delay_ms=25)) as network:
        made = Hosts(network, tmp_path)
        try:
            yield made
        finally:
            made.close()


@pytest.mark.skipif(shutil.which("curl") is None, reason="there is no curl")
def test_two_sites_come_from_nothing_to_a_secured_session_in_the_ten_commands(hosts: Hosts) -> None:
    typed = commands()
    assert len(typed) == 10
    for host, command in typed:
        if "git clone" in command or command == "./scripts/setup":
            continue
        begin = time.monotonic()
        output = hosts.run(host, command)
        wanted = {"readyz": r"^ok$", "metrics": r"(?s)receivers 1\.0.*days_left 39\d\."}
        pattern = next((pattern for word, pattern in wanted.items() if word in command), "")
        while not re.search(pattern, output):
            states = {name: process.poll() for name, process in hosts.daemons.items()}
            alive = set(states.values()) == {None} and time.monotonic() - begin < START_LIMIT_S
            assert alive, (states, output, hosts.transcript, *map(hosts.log, hosts.daemons))
            time.sleep(0.2)
            output = hosts.run(host, command)
        if not any(name in command for name in DAEMONS):
            hosts.note(host, command, output)
    ports = {name: listening_ports(process.pid) for name, process in hosts.daemons.items()}
    assert ports["telepose-send"] == {("tcp", 7447), ("udp", 7447), ("tcp", 9101)}  # the last for this host alone
    assert {port for protocol, port in ports["telepose-receive"] if protocol == "tcp"} == {8080}  # likewise
    plain = [sys.executable, "-c", PLAIN, f"tcp/{hosts.network.addresses['A']}:7447"]
    tried = subprocess.run(hosts.network.command("B", plain), capture_output=True, text=True, timeout=20, check=False)
    assert "refused" in tried.stdout
    print("\n".join(hosts.transcript))  # noqa: T201 (what docs/deploy.md shows)


PLAIN = """
import sys, zenoh
config = zenoh.Config()
for key, value in {"mode": '"client"', "connect/endpoints": f'["{sys.argv[1]}"]', "connect/timeout_ms": "2000",
                   "scouting/multicast/enabled": "false"}.items():
    config.insert_json5(key, value)
try:
    zenoh.open(config)
except zenoh.ZError:
    print("refused")
"""
