"""Half an hour of random faults: does memory grow, does anything leak, do the counters add up.

Both daemons with certificates over an emulated path of 10 Mbit/s and 50 ms, at 30 frames a second of the lightest real
source: the built-in rig with two cameras of 200×150 pixels, which two slow cores carry. The receiver holds at most 40
poses, so that its repository is full when the warm-up ends. Faults come from ``--seed``: losses, bursts, other rates,
outages of 0.3 to 5 s, reports lost, SIGSTOP of 1 s, and kill -9 of each daemon once in the first third. Growth is
the median of the last minute over that of the first one after the warm-up, of each process that lived long enough. For
a count the rig is stopped and the path left alone, until nothing moves: what came is then what went, exactly.
Root only.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from scripts.daemon_processes import Running
from scripts.emulated_site import EmulatedSite, emulated_site
from scripts.line_chart import line_chart
from scripts.link_model import LinkConditions
from scripts.network_emulation import unavailable
from scripts.run_bench import Row
from scripts.soak_ledger import BETWEEN, OWN, Identity, Sample, cameras_add_up, growth, read_metrics, still
from scripts.soak_plan import Fault, plan

MINUTES, SEED = 30.0, 1
WARM_UP_S = 180.0
CAMERAS = 2
SMALL_RIG = ("--cameras", str(CAMERAS), "--width", "200", "--height", "150", "--fps", "30")
FEW_POSES = "[repository]\nposes = 40\n"
PATH = LinkConditions(rate_bps=10e6, delay_ms=25)
NORMAL = {"rate_bps": PATH.rate_bps, "loss": 0.0, "burst": None, "outage": False}
SAMPLE_S = 3.0
SETTLE_S = 1.5  # what the path did before is over
REST_S, REST_LIMIT_S = 0.6, 3.5  # of the rig: the sender gives it up after 5 s of silence
SHOWN, POSES = "telepose_frames_shown_total", "telepose_repository_poses"
GROWTH_GOAL, RESTART_GOAL_S = 0.05, 2.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """The bench's own options."""
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"how long (default {MINUTES:.0f})")
    parser.add_argument("--seed", type=int, default=SEED, help=f"of the faults (default {SEED})")
    parser.add_argument("--chart", type=Path, help="SVG of memory over time")


def run(
    data: Path | None,
    seconds: float | None,
    clips: tuple[str, ...],
    minutes: float = MINUTES,
    seed: int = SEED,
    chart: Path | None = None,
) -> Iterator[Row]:
    """One run of ``minutes`` (or ``seconds``)."""
    why = unavailable()
    if why is not None:
        raise SystemExit(f"soak: {why}")
    with tempfile.TemporaryDirectory(prefix="telepose-bench-") as name, emulated_site(Path(name), PATH) as here:
        soak = Soak(here)
        with soak.sampling():
            for fault in plan(seed, seconds or minutes * 60):
                soak.suffer(fault)
        emulator = here.network.report().about
    if chart is not None:
        chart.write_text(soak.chart())
    source = f"seed {seed}, {(seconds or minutes * 60) / 60:.1f} min, {emulator}"
    for case, metric, value, unit, reference in soak.figures():
        yield Row(case=case, metric=metric, value=value, unit=unit, reference=reference, source=source)


@dataclass(slots=True)
class Life:
    """One process, and what was seen of it."""

    daemon: Running
    samples: list[Sample] = field(default_factory=list)

    def take(self, at_s: float) -> None:
        """A sample, unless the process has just ended."""
        process = Path(f"/proc/{self.daemon.process.pid}")
        try:
            status, files = (process / "status").read_text(), len(os.listdir(process / "fd"))
        except OSError:
            return
        rss, threads = re.search(r"VmRSS:\s+(\d+)", status), re.search(r"Threads:\s+(\d+)", status)
        if rss is None or threads is None:
            return
        answer, text = self.daemon.get("/metrics")
        tasks = read_metrics(text).get("tasks") if answer == 200 else None
        count = None if tasks is None else int(tasks)
        self.samples.append(Sample(at_s, int(rss[1]) / 1024, int(threads[1]), files, count))


class Soak:
    """A session that faults happen to."""

    def __init__(self, here: EmulatedSite) -> None:
        self._here = here
        self._options = here.folder / "receiver.toml"
        self._options.write_text(FEW_POSES)
        self._rig = here.rig(*SMALL_RIG)
        self._daemons = {"sender": here.sender(), "receiver": self._receiver()}
        self._lives = {name: [Life(daemon)] for name, daemon in self._daemons.items()}
        self._daemons["receiver"].wait_for(POSES, 1, 120)
        self._begin_s = time.monotonic()
        self._counted: dict[str, float] | None = None
        self._happened: Counter[str] = Counter()
        self._imbalance: dict[str, list[float]] = {}
        self._back_s: dict[str, float] = {}

    def _receiver(self) -> Running:
        return self._here.receiver("--config", str(self._options))

    def sampling(self) -> _Sampler:
        return _Sampler(self._sample)

    def _sample(self) -> None:
        for lives in self._lives.values():
            lives[-1].take(time.monotonic() - self._begin_s)

    def suffer(self, fault: Fault) -> None:
        """Wait for its time, and let it happen."""
        time.sleep(fault.quiet_s)
        what = f"{fault.kind} {fault.conditions or ''}".strip()
        at_s = time.monotonic() - self._begin_s
        print(f"soak: {at_s:.0f} s: {what} {fault.seconds:.1f} s", file=sys.stderr, flush=True)
        self._happened[next(iter(fault.conditions), fault.kind) if fault.kind == "path" else fault.kind] += 1
        verb, _, daemon = fault.kind.partition(" ")
        if verb == "count":
            self._count()
        elif verb == "kill":
            self._kill(daemon)
        elif verb == "stop":
            self._daemons[daemon].process.send_signal(signal.SIGSTOP)
            time.sleep(fault.seconds)
            self._daemons[daemon].process.send_signal(signal.SIGCONT)
        else:
            self._here.network.change("back" if verb == "deaf" else "both", **fault.conditions)
            time.sleep(fault.seconds)
            self._here.network.change("both", **NORMAL)
        for running in self._daemons.values():
            assert running.process.poll() is None, f"{running.name} ended:\n{running.log}"

    def _kill(self, name: str) -> None:
        """kill -9, and a new process at once; how long until a person moves on the receiver's screen again."""
        self._daemons[name].end(signal.SIGKILL)
        self._counted = None
        shown = self._daemons["receiver"].metric(SHOWN) if name == "sender" else 0.0
        begin_s = time.monotonic()
        self._daemons[name] = self._here.sender() if name == "sender" else self._receiver()
        self._lives[name].append(Life(self._daemons[name]))
        receiver = self._daemons["receiver"]
        receiver.wait_for(SHOWN, shown + 1)
        if name == "receiver":
            receiver.wait_for(POSES, 1)
        self._back_s[name] = time.monotonic() - begin_s
        receiver.wait_for(POSES, 1)

    def _numbers(self) -> dict[str, float]:
        read = {side: read_metrics(daemon.get("/metrics")[1]) for side, daemon in self._daemons.items()}
        return {f"{side}.{name}": value for side, found in read.items() for name, value in found.items()}

    def _count(self) -> None:
        """Let everything come to rest, and compare what came with what went."""
        time.sleep(SETTLE_S)
        own, between = (*OWN, cameras_add_up(CAMERAS)), BETWEEN
        self._rig.process.send_signal(signal.SIGSTOP)
        try:
            begin_s = time.monotonic()
            time.sleep(REST_S)
            before, now = self._numbers(), self._numbers()
            while not still(before, now, (*own, *between)) and time.monotonic() - begin_s < REST_LIMIT_S:
                time.sleep(REST_S / 2)
                before, now = now, self._numbers()
        finally:
            self._rig.process.send_signal(signal.SIGCONT)
        if not still(before, now, (*own, *between)):
            self._happened["count void: something still moved"] += 1
            return
        for identity in own:
            self._note(identity, now, None)
        all_taken = now.get("receiver.skeleton_divisor") == 1  # else the last ones published may be of no layer taken
        for identity in between if self._counted is not None and all_taken else ():
            self._note(identity, now, self._counted)
        self._counted = now if all_taken else None

    def _note(self, identity: Identity, now: dict[str, float], before: dict[str, float] | None) -> None:
        wrong = identity.imbalance(now, before)
        self._imbalance.setdefault(identity.name, []).append(wrong)
        if wrong:
            names = (*identity.came, *identity.went)
            grown = {name: now.get(name, 0.0) - (before or {}).get(name, 0.0) for name in names}
            print(f"soak: {identity.name} is off by {wrong:g}: {grown}", file=sys.stderr, flush=True)

    def figures(self) -> Iterator[tuple[str, str, float, str, float | None]]:
        """Case, metric, value, unit, goal."""
        for name, lives in self._lives.items():
            for number, life in enumerate(lives):
                yield from _of_life(f"{name} {number + 1}", life)
        for name, wrong in self._imbalance.items():
            yield "counters", f"{name}: counts", len(wrong), "", None
            yield "counters", f"{name}: most off by", max(map(abs, wrong)), "", 0
        for name, seconds in self._back_s.items():
            yield f"{name} killed", "picture_back_s", seconds, "s", RESTART_GOAL_S
        for name, count in sorted(self._happened.items()):
            yield "faults", name, count, "", None

    def chart(self) -> str:
        """Memory of each process over time, as SVG."""
        lines = {
            f"{name} {number + 1}": ([s.at_s / 60 for s in life.samples], [s.rss_mib for s in life.samples])
            for name, lives in self._lives.items()
            for number, life in enumerate(lives)
            if life.samples
        }
        return line_chart("Memory under random faults", "minutes", "resident [MiB]", lines)


def _of_life(case: str, life: Life) -> Iterator[tuple[str, str, float, str, float | None]]:
    if not life.samples:
        return
    yield case, "lived_s", life.samples[-1].at_s - life.samples[0].at_s, "s", None
    yield case, "rss_most_mib", max(sample.rss_mib for sample in life.samples), "MiB", None
    for what, unit in (("rss_mib", "MiB"), ("threads", ""), ("files", ""), ("tasks", "")):
        ends = growth(life.samples, what, WARM_UP_S)
        if ends is None:
            continue
        yield case, f"{what}_after_warm_up", ends[0], unit, None
        yield case, f"{what}_at_end", ends[1], unit, None
        if what == "rss_mib":
            yield case, "rss_growth_share", ends[1] / ends[0] - 1, "", GROWTH_GOAL


class _Sampler:
    """Calls ``sample`` every three seconds on a thread of its own, within the context."""

    def __init__(self, sample: Callable[[], None]) -> None:
        self._sample = sample
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sampler", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(SAMPLE_S):
            self._sample()
