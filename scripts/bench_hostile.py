"""Hostile peers beside a session in progress, on a secured link: what it loses, what memory it costs.

A studio's sender and a lobby's receiver are running when each attack begins. Outsiders have no certificate; the insider
has one of the same authority and may receive, as the site "wall". Skeletons lost are gaps the lobby's receiver counts;
on a machine that is busy attacking itself some may be lost for want of time: the case ``undisturbed`` says how many
without any attack. Everything stays on loopback.
"""

from __future__ import annotations

import random
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import zenoh

from common.transport import channels
from common.transport.channels import Channel, channel_key
from common.transport.temporal_layers import LAYERS
from scripts.daemon_processes import Running, Site, free_port, site
from scripts.hostile_peer import (
    closed,
    connect_and_talk,
    forged_report,
    fuzzed,
    idle_connections,
    outsider,
    pair,
)
from scripts.make_certificates import make
from scripts.run_bench import Row

RECEIVED, LOST = "telepose_skeletons_received_total", "telepose_skeletons_lost_total"
POSES = "telepose_repository_poses"
SETTLE_S = 2.0
SMALL_RIG = ("--width", "320", "--height", "240", "--fps", "15")
FUZZED, FORGED = 100_000, 20_000


def run(data: Path | None, seconds: float | None, clips: tuple[str, ...]) -> Iterator[Row]:
    """Every attack in turn on one session; ``clips``: only these attacks."""
    with tempfile.TemporaryDirectory(prefix="telepose-bench-") as name, site(Path(name)) as here:
        victim = Victim(here)
        for case, attack in victim.attacks(seconds or 10.0).items():
            if not clips or case in clips:
                print(f"hostile: {case}", file=sys.stderr, flush=True)
                yield from victim.suffer(case, attack)


class Victim:
    """A sender and a receiver with certificates, in mid-session."""

    def __init__(self, here: Site) -> None:
        self.port = free_port()
        here.link = f"127.0.0.1:{self.port}"
        self.sites = here.folder / "certificates"
        make(self.sites, [("studio", ["127.0.0.1"]), ("lobby", []), ("wall", [])])
        here.rig(*SMALL_RIG)
        secured = ("--certificates", str(self.sites / "studio"), "--receiver", "lobby", "--receiver", "wall")
        self.sender = here.sender(*secured)
        self.receiver = here.receiver("--certificates", str(self.sites / "lobby"), "--name", "1")
        self.receiver.wait_for(POSES, 1)
        self._here = here
        time.sleep(SETTLE_S)

    def attacks(self, seconds: float) -> dict[str, Callable[[], float | None]]:
        """By name; some return after how long a newcomer had its first skeleton [s]."""
        return {
            "undisturbed": lambda: time.sleep(seconds),
            "plaintext and no certificate": self._refused,
            "fuzzed packets": lambda: self._as_insider(self._fuzz),
            "forged reports": lambda: self._as_insider(self._forge),
            "200 MB messages": lambda: self._as_insider(self._huge),
            "tiny messages": lambda: self._as_insider(self._tiny),
            "150 idle connections": self._idle,
            "300 garbage connections": lambda: self._talk(300, 4096),
            "2000 connects": lambda: self._talk(2000, 1),
        }

    def suffer(self, case: str, attack: Callable[[], float | None]) -> Iterator[Row]:
        """The attack, and what came of it."""
        daemons = {"sender": self.sender, "receiver": self.receiver}
        before = {name: resident_mib(daemon) for name, daemon in daemons.items()}
        lost, received, begin_s = self.receiver.metric(LOST), self.receiver.metric(RECEIVED), time.monotonic()
        newcomer_s = attack()
        attacked_s = time.monotonic() - begin_s
        time.sleep(SETTLE_S)
        source = f"attack of {attacked_s:.1f} s, sender at 15 skeletons/s, two cores for all"
        figures = {
            "skeletons_received": (self.receiver.metric(RECEIVED) - received, "1"),
            "skeletons_lost": (self.receiver.metric(LOST) - lost, "1"),
            **{f"{name}_growth_mib": (resident_mib(daemons[name]) - before[name], "MiB") for name in daemons},
        }
        if newcomer_s is not None:
            figures["newcomer_first_skeleton_s"] = newcomer_s, "s"
        for metric, (value, unit) in figures.items():
            yield {"case": case, "metric": metric, "value": value, "unit": unit, "reference": None, "source": source}
        states = [daemon.process.poll() for daemon in daemons.values()]
        assert states == [None, None], (states, self.sender.log, self.receiver.log)

    def _newcomer(self) -> float:
        begin_s = time.monotonic()
        with closed(outsider(pair(self.port), self.sites / "wall", patient=True)) as session:
            came = threading.Event()
            skeletons = channel_key(channels.SKELETON, "studio", 0, layer=channels.ANY)
            subscriber = session.declare_subscriber(skeletons, lambda _: came.set())
            assert came.wait(60), "nothing came for a minute"
            subscriber.undeclare()  # type: ignore[no-untyped-call]
            return time.monotonic() - begin_s

    def _idle(self) -> float:
        with idle_connections(self.port, 150):
            return self._newcomer()

    def _talk(self, count: int, bytes_each: int) -> float:
        connect_and_talk(self.port, count, bytes_each)
        return self._newcomer()

    def _refused(self) -> None:
        for connect, ca in ((pair(self.port), self.sites / "lobby"), ([f"tcp/127.0.0.1:{self.port}"], None)):
            try:
                outsider(connect, None, ca).close()  # type: ignore[no-untyped-call]
            except zenoh.ZError:
                continue
            raise AssertionError(f"{connect} got in")

    def _as_insider(self, attack: Callable[[zenoh.Session, random.Random], None]) -> None:
        with closed(outsider(pair(self.port), self.sites / "wall")) as session:
            time.sleep(0.5)
            attack(session, random.Random(1))

    def _fuzz(self, session: zenoh.Session, chance: random.Random) -> None:
        """Every kind of packet, under its own names and others'; what may not pass counts too."""
        real = forged_report(chance, 1)
        for number in range(FUZZED):
            key, channel = self._key(chance)
            session.put(key, fuzzed(chance, real), priority=channel.priority)
            if number % 500 == 0:  # a question now and then: each waits for its answer
                list(session.get(key, payload=fuzzed(chance, real), timeout=0.05))

    def _key(self, chance: random.Random) -> tuple[str, Channel]:
        channel = chance.choice(channels.CHANNELS)
        name = chance.choice(["wall.1", "wall.2", "lobby.1"]) if channel.per_receiver else None
        layer = chance.randrange(LAYERS) if channel.layered else None
        return channel_key(channel, "studio", 0, name, layer), channel

    def _forge(self, session: zenoh.Session, chance: random.Random) -> None:
        """Reports with impossible contents, as fast as they go, of ever more receivers."""
        for number in range(FORGED):
            key = channel_key(channels.REPORT, "studio", 0, f"wall.{chance.randrange(100)}")
            session.put(key, forged_report(chance, number), express=True)

    def _huge(self, session: zenoh.Session, chance: random.Random) -> None:
        payload = bytes(200 << 20)
        for _ in range(2):
            session.put(channel_key(channels.REPORT, "studio", 0, "wall.1"), payload)

    def _tiny(self, session: zenoh.Session, chance: random.Random) -> None:
        publisher = session.declare_publisher(channel_key(channels.REPORT, "studio", 0, "wall.1"))
        for _ in range(FUZZED):
            publisher.put(b"x")


def resident_mib(daemon: Running) -> float:
    """Resident memory of a process now [MiB]."""
    status = Path(f"/proc/{daemon.process.pid}/status").read_text()
    match = re.search(r"VmRSS:\s+(\d+) kB", status)
    assert match is not None
    return int(match[1]) / 1024
