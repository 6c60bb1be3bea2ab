"""One run of a stream across an emulated network: started, disturbed as a case says, and what came of it."""

from __future__ import annotations

import bisect
import contextlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

from scripts.link_emulator import ADDRESSES
from scripts.link_model import LinkConditions
from scripts.make_certificates import new_authority, new_certificate, write_site
from scripts.network_emulation import CongestionControl, EmulatedNetwork, EmulatorReport, Side, emulated_network
from scripts.network_probe import ProbeSettings

Kind = Literal["tcp", "secure"]
NS, MS = 1e9, 1e6
PORT = 7447
START_LIMIT_S, END_LIMIT_S = 30.0, 20.0
IDLE_S = 4.0
_SINK = (
    f"import socket; s = socket.create_server(('{ADDRESSES[1]}', 5000)); print('up', flush=True); c, _ = s.accept()\n"
    "while c.recv(65536): pass"
)
_SOURCE = f"import socket; s = socket.create_connection(('{ADDRESSES[1]}', 5000))\nwhile True: s.sendall(bytes(65536))"
PROBE_PRIORITY = 10  # what is measured is the network, not who else computes on this host


@dataclass(frozen=True, slots=True)
class Change:
    """``at_s`` after bulk began, other conditions in a direction."""

    at_s: float
    conditions: dict[str, Any]
    direction: Literal["there", "back", "both"] = "both"


@dataclass(frozen=True, slots=True)
class NetworkCase:
    """A path, the kind of links across it, and what happens to it. ``settle_s``: after bulk began, until figures count;
    ``seconds``: of bulk in all. ``bulk``: False measures skeletons alone. ``download_s``: from when until when another
    TCP connection takes all it can get."""

    path: LinkConditions
    kind: Kind
    changes: tuple[Change, ...] = ()
    settle_s: float = 5.0
    seconds: float = 15.0
    bulk: bool = True
    download_s: tuple[float, float] | None = None
    back: LinkConditions | None = None
    mtu: int = 1500
    congestion_control: CongestionControl = "reno"  # namespaces may have it on every host


@dataclass(frozen=True, slots=True)
class Seen:
    """What a run saw; times are ns of the host's monotonic clock. ``sent``: sequence number → when. ``shown``: (when
    sent, when shown). ``bulk``: (when, bytes so far). ``meshes``: (when, bytes) of whole ones. ``taken``: (from when, 1
    in how many skeletons the receiver took). ``began_ns``: bulk."""

    sent: dict[int, int]
    shown: list[tuple[int, int]]
    bulk: list[tuple[int, int]]
    meshes: list[tuple[int, int]]
    taken: list[tuple[int, int]]
    counts: dict[str, int]
    window: dict[str, int]
    began_ns: int
    idle_from_ns: int
    ended_ns: int
    emulator: EmulatorReport
    changed_ns: list[int] = field(default_factory=list)
    trace: list[list[float]] = field(default_factory=list)

    def delays_ms(self, begin_ns: float, end_ns: float) -> list[float]:
        """Of skeletons sent in a span, ascending [ms]."""
        return sorted((shown - sent) / MS for sent, shown in self.shown if begin_ns <= sent < end_ns)

    def idle_ms(self) -> float:
        """The median delay before bulk began [ms]."""
        return percentile(self.delays_ms(self.idle_from_ns, self.began_ns), 50)

    def goodput_bps(self, begin_ns: float, end_ns: float) -> float:
        """Of chunks [bit/s]."""
        inside = [(when, total) for when, total in self.bulk if begin_ns <= when < end_ns]
        if len(inside) < 2:
            return 0.0
        (first_ns, first), (last_ns, last) = inside[0], inside[-1]
        return (last - first) * 8 / (last_ns - first_ns) * NS

    def divisor_at(self, when_ns: float) -> int:
        """1 in how many skeletons the receiver took at a time."""
        return self.taken[bisect.bisect_right(self.taken, when_ns, key=itemgetter(0)) - 1][1]

    def lost_share(self, begin_ns: float, end_ns: float) -> float:
        """Of the skeletons sent in a span that the receiver took, those that were not shown."""
        sent = self._sent_in(begin_ns, end_ns)
        shown = {when for when, _ in self.shown}
        return sum(self.sent[sequence] not in shown for sequence in sent) / len(sent) if sent else 0.0

    def unseen_share(self, begin_ns: float, end_ns: float) -> float:
        """Of the same, those that no packet after them repeated either."""
        sent = self._sent_in(begin_ns, end_ns)
        shown = {when for when, _ in self.shown}
        unseen = (self.sent[s] not in shown and self.sent.get(s + 1) not in shown for s in sent)
        return sum(unseen) / len(sent) if sent else 0.0

    def _sent_in(self, begin_ns: float, end_ns: float) -> list[int]:
        return [s for s, when in self.sent.items() if begin_ns <= when < end_ns and s % self.divisor_at(when) == 0]

    def back_to_ns(self, share_bps: float, from_ns: float, span_s: float = 1.0) -> float | None:
        """When goodput over the next second first reaches ``share_bps`` from a time on."""
        for when, _ in self.bulk:
            if when >= from_ns and self.goodput_bps(when, when + span_s * NS) >= share_bps:
                return when
        return None


def percentile(ascending: list[float], percent: float) -> float:
    """NaN of nothing."""
    return ascending[min(len(ascending) - 1, int(len(ascending) * percent / 100))] if ascending else float("nan")


class Probes:
    """The two ends as processes in their namespaces."""

    def __init__(self, network: EmulatedNetwork, kind: Kind, folder: Path) -> None:
        self._network, self._folder = network, folder
        self._certificates = _certificates(folder, network.addresses["A"]) if kind == "secure" else None
        self._address = f"{network.addresses['A']}:{PORT}"
        self.running: dict[str, subprocess.Popen[str]] = {}
        self._others: list[subprocess.Popen[str]] = []

    def start(
        self, role: Literal["sender", "receiver"], name: str = "wall", side: Side | None = None
    ) -> subprocess.Popen[str]:
        """Start one end and wait until its session is open. ``side``: a receiver's may be the sender's own."""
        site = {"sender": "studio", "receiver": "lobby"}[role]
        certificates = None if self._certificates is None else str(self._certificates / site)
        label = role if role == "sender" else name
        settings = ProbeSettings(role, self._address, str(self._folder / f"{label}.json"), certificates, name)
        command = [sys.executable, "-m", "scripts.network_probe", json.dumps(asdict(settings))]
        if self._network.punctual and shutil.which("chrt"):
            command = ["chrt", "-f", str(PROBE_PRIORITY), *command]
        side = side or ("A" if role == "sender" else "B")
        pipe = subprocess.PIPE
        process = subprocess.Popen(self._network.command(side, command), stdin=pipe, stdout=pipe, text=True)
        self.running[label] = process
        assert process.stdout is not None
        if process.stdout.readline().strip() != "up":
            raise RuntimeError(f"the {label} did not start: it ended with {process.wait(START_LIMIT_S)}")
        return process

    def tell(self, line: str) -> None:
        """A line for the sender."""
        stream = self.running["sender"].stdin
        assert stream is not None
        stream.write(line + "\n")
        stream.flush()

    def end(self) -> dict[str, dict[str, Any]]:
        """End all; what each saw."""
        for process in self.running.values():
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
        for label, process in self.running.items():
            if process.wait(END_LIMIT_S) != 0:
                raise RuntimeError(f"the {label} ended with {process.returncode}")
        return {label: json.loads((self._folder / f"{label}.json").read_text()) for label in self.running}

    def download(self) -> list[subprocess.Popen[str]]:
        """Begin a TCP transfer from A to B without end."""
        pipe = subprocess.PIPE
        sink = subprocess.Popen(self._network.command("B", [sys.executable, "-c", _SINK]), stdout=pipe, text=True)
        self._others.append(sink)
        assert sink.stdout is not None
        sink.stdout.readline()
        self._others.append(subprocess.Popen(self._network.command("A", [sys.executable, "-c", _SOURCE]), text=True))
        return self._others[-2:]

    def end_download(self, downloading: list[subprocess.Popen[str]]) -> None:
        """End what ``download`` began."""
        for process in downloading:
            process.kill()

    def kill(self) -> None:
        """Whatever still runs."""
        for process in (*self.running.values(), *self._others):
            if process.poll() is None:
                process.kill()
                process.wait()


@contextlib.contextmanager
def probes(network: EmulatedNetwork, kind: Kind, folder: Path) -> Iterator[Probes]:
    """The two ends; whatever happens, they end with the context."""
    made = Probes(network, kind, folder)
    try:
        yield made
    finally:
        made.kill()


def _certificates(folder: Path, address: str) -> Path:
    authority = new_authority()
    for site, addresses in (("studio", [address]), ("lobby", [])):
        if not (folder / site).exists():
            write_site(folder / site, authority, *new_certificate(authority, site, addresses))
    return folder


def run_case(case: NetworkCase, folder: Path, idle_s: float = IDLE_S) -> Seen:
    """One run of a case: idle, then bulk with its changes.

    Raises:
        EmulationError: there can be no emulation here.
        RuntimeError: an end did not run as it should.
    """
    with (
        emulated_network(case.path, case.back, case.mtu, case.congestion_control) as network,
        probes(network, case.kind, folder) as ends,
    ):
        ends.start("sender")
        ends.start("receiver")
        time.sleep(1.5)  # links open, clocks and bodies are asked for
        idle_from_ns = time.monotonic_ns()
        time.sleep(idle_s)
        network.report()
        began_ns = time.monotonic_ns()
        if case.bulk:
            ends.tell("bulk on")
        changed_ns = []
        for at_s, happen in _events(case, network, ends):
            _sleep_until(began_ns + int(at_s * NS))
            happen()
            changed_ns.append(time.monotonic_ns())
        _sleep_until(began_ns + int(case.seconds * NS))
        emulator, ended_ns = network.report(), time.monotonic_ns()
        saw = ends.end()
    sender, receiver = saw["sender"], saw["wall"]
    return Seen(
        sent=dict(sender["sent"]),
        shown=[(sent, shown) for _, sent, shown in receiver["shown"]],
        bulk=[(when, total) for when, total in receiver["bulk"]],
        meshes=[(when, size) for when, size in receiver["meshes"]],
        taken=[(when, divisor) for when, divisor in receiver["taken"]],
        counts=receiver["counts"],
        window=sender["window"],
        began_ns=began_ns,
        idle_from_ns=idle_from_ns,
        ended_ns=ended_ns,
        emulator=emulator,
        changed_ns=changed_ns,
        trace=sender["trace"],
    )


def _events(case: NetworkCase, network: EmulatedNetwork, ends: Probes) -> list[tuple[float, Callable[[], object]]]:
    """What happens during bulk, in order: when [s], and what to do."""
    events: list[tuple[float, Callable[[], object]]] = [
        (change.at_s, partial(network.change, change.direction, **change.conditions)) for change in case.changes
    ]
    if case.download_s is not None:
        downloading: list[subprocess.Popen[str]] = []
        begin_s, end_s = case.download_s
        events.append((begin_s, lambda: downloading.extend(ends.download())))
        events.append((end_s, lambda: ends.end_download(downloading)))
    return sorted(events, key=itemgetter(0))


def _sleep_until(when_ns: int) -> None:
    time.sleep(max(0.0, (when_ns - time.monotonic_ns()) / NS))
