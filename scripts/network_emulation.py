"""Two network namespaces with an emulated path between them, for tests and benches; gone when the context ends.

A is where a sender runs and B a receiver; ``there`` is the direction from A to B. A run in which the emulator itself
delivered packets too late is void: what it measured says something of this machine and nothing of telepose.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from scripts.link_emulator import ADDRESSES, TUN
from scripts.link_model import LinkConditions, as_values

Side = Literal["A", "B"]
VOID_MS = 2.0  # of lateness at its 99th percentile
_END_WITHIN_S = 5.0
_CLONE_NEWNET = 0x40000000
_libc = ctypes.CDLL(None, use_errno=True)


class EmulationError(Exception):
    """There is no emulation; the text says why."""


@dataclass(frozen=True, slots=True)
class EmulatorReport:
    """Lateness since the last report [ms], and what happened to packets of each direction since the beginning."""

    late_p50_ms: float
    late_p99_ms: float
    late_max_ms: float
    there: dict[str, int]
    back: dict[str, int]

    @property
    def void(self) -> bool:
        """Whether the emulator was too late for anything to be measured."""
        return self.late_p99_ms > VOID_MS


def unavailable() -> str | None:
    """Why there can be no emulation here; None: there can."""
    if sys.platform != "linux":
        return "network namespaces are Linux's"
    if os.geteuid() != 0:
        return "network namespaces and TUN devices need root"
    if not TUN.exists():
        return f"there is no {TUN}"
    missing = [name for name in ("ip", "nsenter") if shutil.which(name) is None]
    if missing:
        return f"there is no {' and no '.join(missing)} (Debian: iproute2, util-linux)"
    try:
        subprocess.run(["unshare", "--net", "true"], check=True, capture_output=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return "network namespaces are not allowed here"
    return None


class EmulatedNetwork:
    """A running emulator. ``punctual``: it has real-time priority."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.addresses: dict[Side, str] = {"A": ADDRESSES[0], "B": ADDRESSES[1]}
        self._process = process
        hello = self._answer()
        self._holders: dict[Side, int] = {"A": hello["holders"][0], "B": hello["holders"][1]}
        self.punctual = bool(hello["punctual"])

    def command(self, side: Side, command: Sequence[str]) -> list[str]:
        """The command line that runs ``command`` on a side."""
        return ["nsenter", f"--net=/proc/{self._holders[side]}/ns/net", "--", *command]

    @contextlib.contextmanager
    def inside(self, side: Side) -> Iterator[None]:
        """Sockets that this thread makes within the context are on that side."""
        with open("/proc/thread-self/ns/net") as home, open(f"/proc/{self._holders[side]}/ns/net") as there:
            _enter(there.fileno())
            try:
                yield
            finally:
                _enter(home.fileno())

    def change(self, direction: Literal["there", "back", "both"] = "both", **conditions: Any) -> None:
        """Other conditions from now on, by the names of ``LinkConditions`` as in ``conditions_from``."""
        self._tell({direction: conditions})

    def report(self) -> EmulatorReport:
        """How punctual the emulator was since it was last asked, and its counts."""
        self._tell({"report": True})
        answer = self._answer()
        late = answer["lateness"]
        return EmulatorReport(late["p50_ms"], late["p99_ms"], late["max_ms"], answer["there"], answer["back"])

    def _tell(self, command: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise EmulationError(f"the link emulator ended with {self._process.wait(_END_WITHIN_S)}")
        answer: dict[str, Any] = json.loads(line)
        return answer


def _enter(namespace: int) -> None:
    if _libc.setns(namespace, _CLONE_NEWNET) != 0:
        raise EmulationError(f"a namespace cannot be entered: {os.strerror(ctypes.get_errno())}")


@contextlib.contextmanager
def emulated_network(
    there: LinkConditions,
    back: LinkConditions | None = None,
    mtu: int = 1500,
    congestion_control: Literal["reno", "bbr", "cubic"] | None = None,
) -> Iterator[EmulatedNetwork]:
    """A path with these conditions, the same ``back`` unless told otherwise. End what runs in it before the context.

    Raises:
        EmulationError: ``unavailable``, or the emulator did not start.
    """
    why = unavailable()
    if why is not None:
        raise EmulationError(why)
    settings = {"there": as_values(there), "back": as_values(back or there), "mtu": mtu}
    if congestion_control is not None:
        settings["congestion_control"] = congestion_control
    command = [sys.executable, "-m", "scripts.link_emulator", json.dumps(settings)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, start_new_session=True)
    try:
        yield EmulatedNetwork(process)
    finally:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        try:
            process.wait(_END_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
