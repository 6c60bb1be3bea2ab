"""Real packets across a modelled path: two network namespaces, a TUN device in each, and ``link_model`` between them.

Started by ``network_emulation``; on its own it is ``./scripts/emulate_network``. Argument: JSON with ``there`` and
``back`` (conditions of the two directions), ``mtu`` and ``congestion_control``. Lines of JSON on standard input:
{"there": {...}}, {"back": {...}}, {"both": {...}} change conditions, {"report": true} asks for one line of JSON on
standard output. Needs root; nothing outside the two namespaces is touched. They have no names: each is held by a child
that dies with this process, even by kill -9, and is gone when the last process inside has ended.
"""

from __future__ import annotations

import ctypes
import fcntl
import gc
import json
import os
import selectors
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from scripts.link_model import Link, LinkConditions, conditions_from
from scripts.packet_damage import flip_a_bit

ADDRESSES = ("198.18.0.1", "198.18.0.2")  # of the range for measurements, RFC 2544; inside our namespaces only
TUN = Path("/dev/net/tun")
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_CLONE_NEWNET = 0x40000000
_PR_SET_PDEATHSIG, _PR_SET_TIMERSLACK = 1, 29
_PRIORITY = 50
_BATCH = 64  # packets read in a row before those that are due go out
_BUCKET_NS = 10_000

_libc = ctypes.CDLL(None, use_errno=True)


class Lateness:
    """How much later packets were delivered than they were due, in buckets of 10 µs."""

    def __init__(self) -> None:
        self._buckets: Counter[int] = Counter()

    def note(self, late_ns: int) -> None:
        self._buckets[late_ns // _BUCKET_NS] += 1

    def percentile_ms(self, percent: float) -> float:
        """Upper edge of the bucket that holds it [ms]; 0 without packets."""
        left = sum(self._buckets.values()) * percent / 100
        for bucket in sorted(self._buckets):
            left -= self._buckets[bucket]
            if left <= 0:
                return (bucket + 1) * _BUCKET_NS / 1e6
        return 0.0

    def take(self) -> dict[str, float]:
        """p50, p99 and the most [ms] since it was last asked for."""
        figures = {name: self.percentile_ms(p) for name, p in (("p50_ms", 50), ("p99_ms", 99), ("max_ms", 100))}
        self._buckets.clear()
        return figures


class Emulator:
    """Carries packets between two TUN devices until its input ends. ``tuns``: file descriptors of A and B."""

    def __init__(self, tuns: tuple[int, int], there: LinkConditions, back: LinkConditions) -> None:
        self.links: dict[str, Link[bytes]] = {
            "there": Link(there, 1, flip_a_bit),
            "back": Link(back, 2, flip_a_bit),
        }
        self.lateness = Lateness()
        a, b = tuns
        self._lanes = ((a, b, self.links["there"]), (b, a, self.links["back"]))
        self._input = b""
        self._running = True

    def run(self) -> None:
        selector = selectors.SelectSelector()  # the only one here that waits in microseconds
        for source, _, link in self._lanes:
            selector.register(source, selectors.EVENT_READ, (source, link))
        selector.register(0, selectors.EVENT_READ, None)
        while self._running:
            due = [link.next_due_ns for _, _, link in self._lanes if link.next_due_ns is not None]
            wait_s = max(0, min(due) - time.monotonic_ns()) / 1e9 if due else None
            for key, _ in selector.select(wait_s):
                if key.data is None:
                    self._read_input()
                else:
                    _read_packets(*key.data)
            for _, target, link in self._lanes:
                for due_ns, packet in link.take(time.monotonic_ns()):
                    _write_packet(target, packet)
                    self.lateness.note(time.monotonic_ns() - due_ns)

    def _read_input(self) -> None:
        data = os.read(0, 65536)
        self._running = bool(data)
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            self._obey(json.loads(line))

    def _obey(self, command: dict[str, Any]) -> None:
        now_ns = time.monotonic_ns()
        for name, link in self.links.items():
            changes = command.get("both", {}) | command.get(name, {})
            if changes:
                link.change(now_ns, **conditions_from(changes))
        if command.get("report"):
            counts = {name: dict(link.counts) for name, link in self.links.items()}
            print(json.dumps({"lateness": self.lateness.take(), **counts}), flush=True)


def _read_packets(source: int, link: Link[bytes]) -> None:
    for _ in range(_BATCH):
        try:
            packet = os.read(source, 65535)
        except BlockingIOError:
            return
        link.put(packet, len(packet), time.monotonic_ns())


def _write_packet(target: int, packet: bytes) -> None:
    try:
        os.write(target, packet)
    except OSError:
        return  # its device is down or its queue full: a lost packet, as on any other network


@dataclass(frozen=True, slots=True)
class _End:
    """What a namespace is given."""

    address: str
    peer: str
    mtu: int
    congestion_control: str | None


def _hold_namespace(end: _End, reply: socket.socket) -> NoReturn:
    """The child: a namespace with a TUN device, whose descriptor goes to the parent; then wait to be killed."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if _libc.unshare(_CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), "unshare of the network namespace")
    Path("/proc/sys/net/ipv6/conf/default/disable_ipv6").write_text("1")  # it would chatter
    if end.congestion_control is not None:
        Path("/proc/sys/net/ipv4/tcp_congestion_control").write_text(end.congestion_control)
    tun = os.open(TUN, os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", b"path", _IFF_TUN | _IFF_NO_PI))
    for command in (
        "link set lo up",
        f"addr add {end.address} peer {end.peer} dev path",
        f"link set path up mtu {end.mtu} txqueuelen 1000",
    ):
        subprocess.run(["ip", *command.split()], check=True)
    socket.send_fds(reply, [b"up"], [tun])
    while True:
        signal.pause()


def _namespace(end: _End) -> tuple[int, int]:
    """A namespace held by a child: its pid, and the descriptor of its TUN device."""
    ours, theirs = socket.socketpair()
    child = os.fork()
    if child == 0:
        try:
            _hold_namespace(end, theirs)
        except BaseException as error:
            print(f"link emulator: {error}", file=sys.stderr, flush=True)
        os._exit(1)
    theirs.close()
    _, descriptors, _, _ = socket.recv_fds(ours, 16, 1)
    if not descriptors:
        os.waitpid(child, 0)
        raise SystemExit("link emulator: no network namespace")
    return child, descriptors[0]


def be_punctual() -> bool:
    """Real-time priority when that is allowed, and exact timers; False: it was not allowed."""
    _libc.prctl(_PR_SET_TIMERSLACK, 1000, 0, 0, 0)
    gc.disable()  # there are no cycles here, only pauses
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError:
        return False
    return True


def run(settings: dict[str, Any], started: Callable[[list[int], bool], None]) -> None:
    """Emulate until the input ends; ``started`` is told the pids that hold A and B, and whether priority was given."""
    there, back = (LinkConditions(**conditions_from(settings.get(name, {}))) for name in ("there", "back"))
    holders, tuns = [], []
    try:
        for number, address in enumerate(ADDRESSES):
            peer = ADDRESSES[1 - number]
            end = _End(address, peer, settings.get("mtu", 1500), settings.get("congestion_control"))
            holder, tun = _namespace(end)
            holders.append(holder)
            tuns.append(tun)
        emulator = Emulator((tuns[0], tuns[1]), there, back)
        started(holders, be_punctual())
        emulator.run()
    finally:
        for holder in holders:
            os.kill(holder, signal.SIGKILL)
            os.waitpid(holder, 0)


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal's Ctrl-C is for whoever started this

    def started(holders: list[int], punctual: bool) -> None:
        print(json.dumps({"holders": holders, "punctual": punctual}), flush=True)

    run(json.loads(sys.argv[1]), started)


if __name__ == "__main__":
    main()
