"""Two network namespaces with an emulated path between them, for tests and benches; gone when the context ends.

A is where a sender runs and B a receiver; ``there`` is the direction from A to B. The emulator is the kernel's netem
where it has one, else our own. A run in which ours delivered packets too late is void: what it measured says something
of this machine and nothing of telepose; netem does not tell how late it was.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import shutil
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from scripts.link_emulator import ADDRESSES, TUN
from scripts.link_model import LinkConditions, as_values, conditions_from
from scripts.netem import NetemError, kernel_knows_netem, qdiscs, replace_command

Side = Literal["A", "B"]
Direction = Literal["there", "back", "both"]
Emulator = Literal["own", "netem"]
CongestionControl = Literal["reno", "bbr", "cubic"]
VOID_MS = 2.0  # of lateness at its 99th percentile
_WAYS: tuple[tuple[Side, Side, Direction], ...] = (("A", "B", "there"), ("B", "A", "back"))
_END_WITHIN_S = 5.0
_CLONE_NEWNET = 0x40000000
_libc = ctypes.CDLL(None, use_errno=True)


class EmulationError(Exception):
    """There is no emulation; the text says why."""


@dataclass(frozen=True, slots=True)
class EmulatorReport:
    """Lateness since the last report [ms] (NaN: not told), and what happened to packets of each direction since the
    beginning."""

    emulator: Emulator
    late_p50_ms: float
    late_p99_ms: float
    late_max_ms: float
    there: dict[str, int]
    back: dict[str, int]

    @property
    def void(self) -> bool:
        """Whether the emulator was too late for anything to be measured."""
        return self.late_p99_ms > VOID_MS

    @property
    def about(self) -> str:
        """Which emulator it was, and how late."""
        if self.emulator == "netem":
            return "netem"
        return f"own emulator, late by {self.late_p99_ms:.2f} ms at p99"


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


class EmulatedNetwork(ABC):
    """Two namespaces and the path between them. ``emulator``: whose; ``punctual``: it has real-time priority."""

    emulator: Emulator
    punctual = True
    addresses: dict[Side, str] = {"A": ADDRESSES[0], "B": ADDRESSES[1]}  # noqa: RUF012

    def __init__(self, holders: dict[Side, int]) -> None:
        self._holders = holders

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

    @abstractmethod
    def change(self, direction: Direction = "both", **conditions: Any) -> None:
        """Other conditions from now on, by the names of ``LinkConditions`` as in ``conditions_from``."""

    @abstractmethod
    def report(self) -> EmulatorReport:
        """How punctual the emulator was since it was last asked, and its counts."""


class OwnNetwork(EmulatedNetwork):
    """A running emulator of our own."""

    emulator = "own"

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        hello = self._answer()
        super().__init__({"A": hello["holders"][0], "B": hello["holders"][1]})
        self.punctual = bool(hello["punctual"])

    def change(self, direction: Direction = "both", **conditions: Any) -> None:
        self._tell({direction: conditions})

    def report(self) -> EmulatorReport:
        self._tell({"report": True})
        answer = self._answer()
        late = answer["lateness"]
        return EmulatorReport("own", late["p50_ms"], late["p99_ms"], late["max_ms"], answer["there"], answer["back"])

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


class NetemNetwork(EmulatedNetwork):
    """A pair of virtual devices with netem at both ends. ``holders``: processes that are in A and B."""

    emulator = "netem"

    def __init__(
        self, holders: dict[Side, int], there: LinkConditions, back: LinkConditions, mtu: int, control: str | None
    ) -> None:
        super().__init__(holders)
        self._path: dict[Side, LinkConditions] = {"A": there, "B": back}  # by where packets leave
        pair = ["ip", "link", "add", "path", "netns", str(holders["A"]), "type", "veth", "peer"]
        _run([*pair, "name", "path", "netns", str(holders["B"])])
        for side, other, _ in _WAYS:
            bundles = "gso_max_segs 1"  # none: packets as long as they are on a real path
            for words in (
                "link set lo up",
                f"addr add {self.addresses[side]} peer {self.addresses[other]} dev path",
                f"link set path up mtu {mtu} txqueuelen 1000 {bundles}",
            ):
                _run(self.command(side, ["ip", *words.split()]))
            if control is not None:
                file = "/proc/sys/net/ipv4/tcp_congestion_control"
                _run(self.command(side, ["sh", "-c", f"echo {control} > {file}"]))
            self._set(side)

    def change(self, direction: Direction = "both", **conditions: Any) -> None:
        for side, _, way in _WAYS:
            if direction in (way, "both"):
                self._path[side] = replace(self._path[side], **conditions_from(conditions))
                self._set(side)

    def report(self) -> EmulatorReport:
        unknown = float("nan")
        return EmulatorReport("netem", unknown, unknown, unknown, self._counts("A"), self._counts("B"))

    def _set(self, side: Side) -> None:
        try:
            told = qdiscs(self._path[side])
        except NetemError as error:
            raise EmulationError(str(error)) from error
        for where, arguments in told:
            _run(self.command(side, replace_command("path", where, arguments)))

    def _counts(self, side: Side) -> dict[str, int]:
        root, *_ = json.loads(_run(self.command(side, ["tc", "-s", "-j", "qdisc", "show", "dev", "path"])))
        return {"packets": root["packets"], "bytes": root["bytes"], "lost": root["drops"]}


def _run(command: Sequence[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=_END_WITHIN_S)
    if done.returncode != 0:
        raise EmulationError(f"{' '.join(command)}: {done.stderr.strip()}")
    return done.stdout


def _enter(namespace: int) -> None:
    if _libc.setns(namespace, _CLONE_NEWNET) != 0:
        raise EmulationError(f"a namespace cannot be entered: {os.strerror(ctypes.get_errno())}")


@contextlib.contextmanager
def emulated_network(
    there: LinkConditions,
    back: LinkConditions | None = None,
    mtu: int = 1500,
    congestion_control: CongestionControl | None = None,
    emulator: Emulator | None = None,
) -> Iterator[EmulatedNetwork]:
    """A path with these conditions, the same ``back`` unless told otherwise. End what runs in it before the context.

    ``emulator``: whose; None: the kernel's, if it knows netem and that can do what is asked for, else our own.

    Raises:
        EmulationError: ``unavailable``, or the emulator did not start.
    """
    why = unavailable()
    if why is not None:
        raise EmulationError(why)
    back = back or there
    damaged = there.damaged or back.damaged
    if emulator == "netem" or (emulator is None and not damaged and kernel_knows_netem()):
        with _holder() as a, _holder() as b:
            yield NetemNetwork({"A": a, "B": b}, there, back, mtu, congestion_control)
        return
    with _own(there, back, mtu, congestion_control) as process:
        yield OwnNetwork(process)


@contextlib.contextmanager
def _own(
    there: LinkConditions, back: LinkConditions, mtu: int, congestion_control: CongestionControl | None
) -> Iterator[subprocess.Popen[str]]:
    settings = {"there": as_values(there), "back": as_values(back), "mtu": mtu}
    if congestion_control is not None:
        settings["congestion_control"] = congestion_control
    with _until_its_input_ends([sys.executable, "-m", "scripts.link_emulator", json.dumps(settings)]) as process:
        yield process


@contextlib.contextmanager
def _holder() -> Iterator[int]:
    """The pid of a process in a namespace of its own, which is gone with it."""
    quiet = "echo 1 > /proc/sys/net/ipv6/conf/default/disable_ipv6; echo there; exec cat"  # IPv6 would chatter
    with _until_its_input_ends(["unshare", "--net", "sh", "-c", quiet]) as process:
        assert process.stdout is not None
        if process.stdout.readline() != "there\n":
            raise EmulationError("no network namespace")
        yield process.pid


@contextlib.contextmanager
def _until_its_input_ends(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, start_new_session=True)
    try:
        yield process
    finally:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        try:
            process.wait(_END_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
