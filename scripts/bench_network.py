"""Skeletons and meshes over emulated networks: delay over the idle path, goodput, losses, coming back.

Needs root and Linux (network namespaces). Real Zenoh sessions, windows, chunks and reports of the daemons run in two
processes; between them is a path with the case's rate, delay and faults. The delay of the idle path is measured in the
same run, before meshes begin. Figures are medians of ``--runs``; a run in which the emulator itself was late by more
than 2 ms (99th percentile) is void and done again. Rates are of IP packets, goodput counts bytes of chunks. TCP
goes by Reno where the case does not name another; on such paths CUBIC, Linux' own default, does the same.
``--clips`` names cases (``10M/50ms/secure``), or all that begin so (``10M``).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median

from scripts.link_model import BurstLoss, LinkConditions
from scripts.network_emulation import CongestionControl, EmulatorReport, unavailable
from scripts.network_run import MS, NS, Change, NetworkCase, Seen, percentile, run_case
from scripts.run_bench import Row

VOID_RUNS_MAX = 3
OUTAGE_S = 5.0
HERE = "two processes"
Figures = dict[str, tuple[float, str]]  # metric → value, unit
Judge = Callable[[NetworkCase, Seen], Figures]


def ten(kind: str, congestion_control: CongestionControl = "reno", **faults: object) -> NetworkCase:
    """10 Mbit/s, 50 ms there and back, 200 ms of queue."""
    path = LinkConditions(10e6, 25, **faults)  # type: ignore[arg-type]
    return NetworkCase(path, kind, congestion_control=congestion_control)  # type: ignore[arg-type]


def steady(case: NetworkCase, seen: Seen) -> Figures:
    """From when bulk has settled until the end."""
    begin_ns, end_ns = seen.began_ns + case.settle_s * NS, seen.ended_ns - NS / 2
    delays, idle_ms = seen.delays_ms(begin_ns, end_ns), seen.idle_ms()
    whole = [size for when, size in seen.meshes]
    figures: Figures = {
        "idle_p50_ms": (idle_ms, "ms"),
        "skeleton_delay_over_idle_p50_ms": (percentile(delays, 50) - idle_ms, "ms"),
        "skeleton_delay_over_idle_p99_ms": (percentile(delays, 99) - idle_ms, "ms"),
        "skeleton_lost_share": (seen.lost_share(begin_ns, end_ns), ""),
        "frames_unseen_share": (seen.unseen_share(begin_ns, end_ns), ""),
        "skeleton_divisor": (seen.divisor_at(end_ns), ""),
        "skeletons_shown_per_s": (len(delays) / (end_ns - begin_ns) * NS, "1/s"),
        "oldest_shown_ms": (delays[-1] if delays else float("nan"), "ms"),
    }
    if case.bulk and case.path.rate_bps:
        figures["goodput_share"] = (seen.goodput_bps(begin_ns, end_ns) / case.path.rate_bps, "")
        figures["meshes_whole"] = (len(whole), "")
    return figures


def after_changes(case: NetworkCase, seen: Seen) -> Figures:
    """From five seconds after the last change until the end, beside what happened in between."""
    last_ns = seen.changed_ns[-1]
    end_ns, idle_ms = seen.ended_ns - NS / 2, seen.idle_ms()
    between = seen.delays_ms(seen.changed_ns[0] + 2 * NS, last_ns)
    after = seen.delays_ms(last_ns + 5 * NS, end_ns)
    back_ns = seen.back_to_ns(0.9 * case.path.rate_bps, last_ns)
    return {
        "idle_p50_ms": (idle_ms, "ms"),
        "over_idle_p99_ms between": (percentile(between, 99) - idle_ms, "ms"),
        "goodput_bps between": (seen.goodput_bps(seen.changed_ns[0] + 2 * NS, last_ns), "bit/s"),
        "over_idle_p99_ms after": (percentile(after, 99) - idle_ms, "ms"),
        "goodput_share after": (seen.goodput_bps(last_ns + 5 * NS, end_ns) / case.path.rate_bps, ""),
        "bulk_back_s": (float("nan") if back_ns is None else (back_ns - last_ns) / NS, "s"),
    }


def outage(case: NetworkCase, seen: Seen) -> Figures:
    """How soon after an outage skeletons are fresh and bulk is back, and how old the oldest one shown was."""
    down_ns, up_ns = seen.changed_ns
    after = sorted((shown, (shown - sent) / MS) for sent, shown in seen.shown if shown > up_ns)
    fresh = [shown for shown, age_ms in after if age_ms < 300]
    back_ns = seen.back_to_ns(0.9 * case.path.rate_bps, up_ns)
    return {
        "idle_p50_ms": (seen.idle_ms(), "ms"),
        "resume_s": ((fresh[0] - up_ns) / NS if fresh else float("nan"), "s"),
        "oldest_shown_ms": (max((age for _, age in after), default=float("nan")), "ms"),
        "bulk_back_s": (float("nan") if back_ns is None else (back_ns - up_ns) / NS, "s"),
        "skeletons_lost": (seen.lost_share(down_ns, up_ns + 3 * NS) * 30 * ((up_ns - down_ns) / NS + 3), ""),
    }


def deaf(case: NetworkCase, seen: Seen) -> Figures:
    """The reports die: how long bulk goes on, and whether skeletons do."""
    cut_ns = seen.changed_ns[0]
    path_ns = case.path.delay_ms * MS
    arrivals = [when for (when, total), (_, before) in zip(seen.bulk[1:], seen.bulk, strict=False) if total > before]
    return {
        "bulk_stops_s": ((max(arrivals, default=cut_ns) - path_ns - cut_ns) / NS, "s"),
        "skeleton_lost_share": (seen.lost_share(cut_ns, cut_ns + 2 * NS), ""),
    }


def damage(case: NetworkCase, seen: Seen) -> Figures:
    """Packets are damaged for a while: what of it was shown, what was refused here and below, and how soon all is well
    after it."""
    begin_ns, end_ns = seen.changed_ns
    sent = set(seen.sent.values())
    after = sorted(shown for when, shown in seen.shown if when > end_ns)
    back_ns = seen.back_to_ns(0.8 * case.path.rate_bps, end_ns)
    refused = sum(seen.counts.get(cause, 0) for cause in ("skeleton malformed", "bulk malformed", "damaged"))
    return {
        "packets_damaged": (seen.emulator.there["damaged"] + seen.emulator.back["damaged"], ""),
        "wrong_skeletons_shown": (sum(when not in sent for when, _ in seen.shown), ""),
        "wrong_meshes_shown": (sum(size == 0 for _, size in seen.meshes), ""),
        "refused_by_our_checksums": (refused, ""),
        "skeleton_lost_share meanwhile": (seen.lost_share(begin_ns, end_ns), ""),
        "meshes_whole meanwhile": (sum(begin_ns < when < end_ns for when, _ in seen.meshes), ""),
        "resume_s": ((after[0] - end_ns) / NS if after else float("nan"), "s"),
        "bulk_back_s": (float("nan") if back_ns is None else (back_ns - end_ns) / NS, "s"),
    }


_DOWN_AND_UP = (Change(6, {"outage": True}), Change(6 + OUTAGE_S, {"outage": False}))
_DAMAGED = (Change(4, {"damaged": 0.005}), Change(9, {"damaged": 0.0}))
_CUT_AND_RISE = (Change(6, {"rate_bps": 2e6}), Change(14, {"rate_bps": 10e6}))


def _outage(kind: str) -> NetworkCase:
    return NetworkCase(LinkConditions(10e6, 25), kind, _DOWN_AND_UP, seconds=20)  # type: ignore[arg-type]


CASES: dict[str, tuple[NetworkCase, Judge]] = {
    "10M/50ms/secure": (NetworkCase(LinkConditions(10e6, 25), "secure", seconds=25), steady),
    "10M/50ms/tcp": (NetworkCase(LinkConditions(10e6, 25), "tcp", seconds=25), steady),
    "10M/50ms/tcp-bbr": (NetworkCase(LinkConditions(10e6, 25), "tcp", seconds=25, congestion_control="bbr"), steady),
    "1M/50ms/tcp": (NetworkCase(LinkConditions(1e6, 25), "tcp"), steady),
    "1M/50ms/secure": (NetworkCase(LinkConditions(1e6, 25), "secure"), steady),
    "100M/20ms/tcp": (NetworkCase(LinkConditions(100e6, 10), "tcp"), steady),
    "100M/20ms/secure": (NetworkCase(LinkConditions(100e6, 10), "secure"), steady),
    "10M/200ms/secure": (NetworkCase(LinkConditions(10e6, 100), "secure"), steady),
    "loss1/10M/secure": (ten("secure", loss=0.01), steady),
    "loss5/10M/secure": (ten("secure", loss=0.05), steady),
    "burst/10M/secure": (ten("secure", burst=BurstLoss(0.01, 0.4)), steady),
    "loss1-bbr/10M/secure": (ten("secure", loss=0.01, congestion_control="bbr"), steady),
    "burst-bbr/10M/secure": (ten("secure", burst=BurstLoss(0.01, 0.4), congestion_control="bbr"), steady),
    "loss20/10M/secure": (ten("secure", loss=0.2), steady),
    "jitter/10M/secure": (ten("secure", jitter_ms=10, reorder=True, duplicates=0.01), steady),
    "bufferbloat/10M/secure": (ten("secure", queue_ms=2000), steady),
    "shallow/10M/secure": (ten("secure", queue_ms=5), steady),
    "mtu1280/10M/secure": (NetworkCase(LinkConditions(10e6, 25), "secure", mtu=1280), steady),
    "mtu576/10M/secure": (NetworkCase(LinkConditions(10e6, 25), "secure", mtu=576), steady),
    "10-2-10/50ms/secure": (
        NetworkCase(LinkConditions(10e6, 25, queue_bytes=250_000), "secure", _CUT_AND_RISE, seconds=24),
        after_changes,
    ),
    "download/10M/secure": (
        NetworkCase(LinkConditions(10e6, 25), "secure", seconds=24, download_s=(6, 14)),
        after_changes,
    ),
    "outage/10M/secure": (_outage("secure"), outage),
    "outage/10M/tcp": (_outage("tcp"), outage),
    "deaf/10M/secure": (
        NetworkCase(LinkConditions(10e6, 25), "secure", (Change(6, {"outage": True}, "back"),), seconds=9),
        deaf,
    ),
    **{
        f"damaged/10M/{kind}": (NetworkCase(LinkConditions(10e6, 25), kind, _DAMAGED, seconds=18), damage)
        for kind in ("secure", "tcp")
    },
    "64k/100ms/tcp": (NetworkCase(LinkConditions(64e3, 50), "tcp", settle_s=10, seconds=40), steady),
    "64k/100ms/secure": (NetworkCase(LinkConditions(64e3, 50), "secure", settle_s=10, seconds=40), steady),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """The bench's own options."""
    parser.add_argument("--runs", type=int, default=5, help="runs of each case that count (default 5)")


def run(data: Path | None, seconds: float | None, clips: tuple[str, ...], runs: int = 5) -> Iterator[Row]:
    """The cases that ``clips`` names, or all. ``seconds``: of bulk, instead of the case's own."""
    why = unavailable()
    if why is not None:
        raise SystemExit(f"network: {why}")
    for name, (case, judge) in CASES.items():
        if not clips or any(name.startswith(clip) for clip in clips):
            yield from _case(name, case, judge, runs)


def _case(name: str, case: NetworkCase, judge: Judge, runs: int) -> Iterator[Row]:
    found: list[Figures] = []
    latest: EmulatorReport | None = None
    void = 0
    while len(found) < runs and void < VOID_RUNS_MAX:
        with tempfile.TemporaryDirectory(prefix="telepose-network-") as folder:
            seen = run_case(case, Path(folder))
        figures = judge(case, seen)
        shown = ", ".join(f"{metric} {value:.4g}" for metric, (value, _) in figures.items())
        verdict = "void" if seen.emulator.void else "run"
        print(f"network: {name} {verdict}, {seen.emulator.about}: {shown}", file=sys.stderr, flush=True)
        if seen.emulator.void:
            void += 1
            continue
        found.append(figures)
        latest = max((latest, seen.emulator), key=lambda report: report.late_p99_ms) if latest else seen.emulator
    how = f", {latest.about}" if latest else ""
    source = f"{HERE}{how}, {len(found)} runs" + (f", {void} void" if void else "")
    if not found:
        yield Row(case=name, metric="void", value=None, unit="", reference=None, source=source)
        return
    for metric, (_, unit) in found[0].items():
        value = median(figures[metric][0] for figures in found)
        yield Row(case=name, metric=metric, value=value, unit=unit, reference=GOALS.get((name, metric)), source=source)


_P50, _P99 = "skeleton_delay_over_idle_p50_ms", "skeleton_delay_over_idle_p99_ms"
# What is to be reached: at most, but for shares of goodput, which are at least.
GOALS: dict[tuple[str, str], float] = {
    **{(f"10M/50ms/{kind}", metric): goal
       for kind in ("secure", "tcp", "tcp-bbr")
       for metric, goal in ((_P50, 15), (_P99, 40), ("goodput_share", 0.9))},
    **{(f"1M/50ms/{kind}", metric): goal
       for kind in ("secure", "tcp") for metric, goal in ((_P99, 60), ("goodput_share", 0.8))},
    **{(f"100M/20ms/{kind}", "goodput_share"): 0.9 for kind in ("secure", "tcp")},
    ("10M/200ms/secure", "goodput_share"): 0.85,
    ("loss1/10M/secure", _P99): 15, ("loss1/10M/secure", "skeleton_lost_share"): 0.01,
    ("loss5/10M/secure", _P99): 15, ("loss5/10M/secure", "skeleton_lost_share"): 0.05,
    ("burst/10M/secure", _P99): 15, ("burst/10M/secure", "skeleton_lost_share"): BurstLoss(0.01, 0.4).mean,
    ("outage/10M/secure", "resume_s"): 1, ("outage/10M/secure", "oldest_shown_ms"): 300,
    ("outage/10M/secure", "bulk_back_s"): 5,
    ("deaf/10M/secure", "bulk_stops_s"): 0.5,
    **{(f"damaged/10M/{kind}", f"wrong_{what}_shown"): 0
       for kind in ("secure", "tcp") for what in ("skeletons", "meshes")},
    ("64k/100ms/tcp", "oldest_shown_ms"): 500, ("64k/100ms/secure", "oldest_shown_ms"): 500,
}  # fmt: skip
