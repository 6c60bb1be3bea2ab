"""Latency of the whole path on loopback: pose age, stages, late joining, coming back after kill -9, leaving.

Case ``running`` is ``./scripts/demo --headless --report`` without the pictures; the others are medians of
``REPETITIONS`` of one event each, with the full rig running.
"""

from __future__ import annotations

import signal
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from scripts.daemon_processes import Running, Site, site
from scripts.run_bench import Row

SHOWN, PUBLISHED = "telepose_frames_shown_total", "telepose_skeletons_published_total"
POSES = "telepose_repository_poses"
REPETITIONS = 5
RUN_S = 20.0
HERE = "two processes on loopback, four cameras 640×480, builtin performer"


def run(data: Path | None, seconds: float | None, clips: tuple[str, ...]) -> list[Row]:
    """All cases; ``seconds`` is the length of the running case."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="telepose-bench-") as folder, site(Path(folder)) as here:
        rows += running(here, seconds or RUN_S)
    with tempfile.TemporaryDirectory(prefix="telepose-bench-") as folder, site(Path(folder)) as here:
        rows += comings_and_goings(here)
    return rows


def say(text: str) -> None:
    print(f"latency: {text}", file=sys.stderr, flush=True)


def row(case: str, metric: str, value: float, unit: str, reference: float | None = None, source: str = HERE) -> Row:
    return {"case": case, "metric": metric, "value": value, "unit": unit, "reference": reference, "source": source}


def running(here: Site, seconds: float) -> list[Row]:
    """An undisturbed run."""
    say(f"an undisturbed run of {seconds:.0f} s")
    here.rig()
    receiver, sender = here.receiver(), here.sender()
    receiver.wait_for(POSES, 1)
    time.sleep(seconds)
    exits = [daemon.end() for daemon in (receiver, sender)]
    assert all(code == 0 for code, _ in exits), (receiver.log, sender.log)
    sent, received = here.figures("sender"), here.figures("receiver")
    rows = [
        row("running", "skeletons_per_second", _rate(sent), "1/s"),
        row("running", "skeleton_bytes_max", float(sent["skeleton_bytes_max"]), "bytes", 250, "DISPOSE §7"),
        row("running", "time_to_first_body_s", received["time_to_first_body_s"], "s"),
        row("running", "exit_s_max", max(s for _, s in exits), "s"),
        row("running", "sender_cpu", float(sent["cpu_share"]), "cores"),
        row("running", "receiver_cpu", float(received["cpu_share"]), "cores"),
        row("running", "rig_cpu", float(sent["rig_cpu_share"]), "cores"),
    ]
    references = {"capture to publish": (2.0, "DISPOSE §4: 2 ms to send"), "capture to shown": (6.0, "DISPOSE §7")}
    for side, figures in (("sender", sent), ("receiver", received)):
        for stage, times in figures["stage_ms"].items():
            reference, source = references.get(stage, (None, HERE))
            for quantile in ("p50", "p95", "p99"):
                rows.append(row("running", f"{side} {stage} {quantile}", times[quantile], "ms", reference, source))
    return rows


def _rate(sent: dict[str, Any]) -> float:
    return float(sent["skeletons_published"] / max(sent["frames_captured"], 1) * 30.0)


def comings_and_goings(here: Site) -> list[Row]:
    """Medians of joining late, of coming back after kill -9, and of leaving. Times start with the new process."""
    here.rig()
    sender = here.sender()
    receiver = here.receiver()
    receiver.wait_for(POSES, 1)
    sender.wait_for(PUBLISHED, 120)  # the body is kept by then
    late, first_body, receiver_back, sender_back, leaving = [], [], [], [], []
    for number in range(REPETITIONS):
        say(f"comings and goings {number + 1}/{REPETITIONS}")
        begin = time.monotonic()
        second = here.receiver(name=f"late{number}")
        late.append(_until_person(second, begin))
        leaving.append(second.end()[1])
        first_body.append(here.figures(f"late{number}")["time_to_first_body_s"])
        receiver.end(signal.SIGKILL)
        begin = time.monotonic()
        receiver = here.receiver(name=f"again{number}")
        receiver_back.append(_until_person(receiver, begin))
        sender.end(signal.SIGKILL)
        shown = receiver.metric(SHOWN)
        begin = time.monotonic()
        sender = here.sender()
        receiver.wait_for(SHOWN, shown + 2)
        sender_back.append(time.monotonic() - begin)
        receiver.wait_for(POSES, 1)
        sender.wait_for(PUBLISHED, 120)
    return [
        row("late receiver", "start_to_person_s", median(late), "s"),
        row("late receiver", "time_to_first_body_s", median(first_body), "s"),
        row("receiver killed", "restart_to_person_s", median(receiver_back), "s"),
        row("sender killed", "restart_to_moving_s", median(sender_back), "s"),
        row("receiver", "exit_s", median(leaving), "s"),
    ]


def _until_person(receiver: Running, begin_s: float) -> float:
    """Seconds from ``begin_s`` until a mesh is shown."""
    receiver.wait_for(POSES, 1)
    receiver.wait_for(SHOWN, 1)
    return time.monotonic() - begin_s
