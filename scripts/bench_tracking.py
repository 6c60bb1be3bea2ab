"""How well each tracker follows: e_t of 16 joints (Lien 2009 §6.2.1) by body, clip and condition.

Cases are ``tracker/body/clip/condition``; ``tracking_conditions`` says what a condition is, ``tracking_run`` what the
figures are. At the end come, for every tracker and condition, the means over the clean clips and over those whose truth
has flips (joints turning faster than people can, found in the truth itself).
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from scripts.run_bench import Row
from scripts.tracking_conditions import condition, performer_for, sights
from scripts.tracking_figures import save_all
from scripts.tracking_run import Case, Result, flips_of, follow, is_clean
from sender.fitting.articp_tracker import ARTICP_ABLATIONS
from sender.fitting.gauss_newton_tracker import GAUSS_NEWTON_ABLATIONS
from sender.fitting.open_tracker import TRACKERS, open_tracker
from sender.fitting.tracker import Tracker

DEFAULT_CONDITIONS = (
    "points-given,points-auto,depth4-auto,depth2-auto,depth1-auto,"
    "15fps-given,noise1cm-given,noise3cm-given,share5-given,share2-given"
)
ABLATIONS = {**ARTICP_ABLATIONS, **GAUSS_NEWTON_ABLATIONS}
CONTESTANTS = (*TRACKERS, *ABLATIONS)
ROUTINE = "routine"  # the built-in performer's motion
WARM_UP_S = 0.3
_UNITS = {"time_to_skeleton_s": "s", "ms_per_frame_p50": "ms", "ms_per_frame_p99": "ms", "lost_share": "1"}
_REFERENCES = {
    "e_t_mean": (0.01, "Lien 2009 Fig. 6, dance clip"),
    "e_t_max": (0.02, "Lien 2009 Fig. 6, dance clip"),
    "ms_per_frame_p50": (1000 / 61.3, "Lien 2009 §6.2.1: 61.3 fps at best"),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """This bench's own options."""
    parser.add_argument("--trackers", default="gauss-newton", help=f"of {', '.join(CONTESTANTS)}, separated by commas")
    parser.add_argument("--conditions", default=DEFAULT_CONDITIONS, help="separated by commas")
    parser.add_argument("--bodies", default="", help="only these, separated by commas")
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time, each in a process; times are noisy then")
    parser.add_argument("--pictures", type=Path, help="folder for error curves and overlays")


def run(
    data: Path | None, seconds: float | None, clips: tuple[str, ...], trackers: str, conditions: str, bodies: str,
    jobs: int, pictures: Path | None = None,
) -> Iterator[Row]:  # fmt: skip
    """Rows of every case as it is done, then the means; progress on stderr."""
    cases = list(_cases(data, seconds, clips, _names(trackers), _names(conditions), _names(bodies)))
    if not cases or jobs < 1:
        raise SystemExit("nothing to measure" if not cases else "--jobs must be positive")
    results = []
    with ExitStack() as stack:
        for result in _measured(cases, jobs, stack):
            results.append(result)
            print(f"{len(results)}/{len(cases)} {_summary(result)}", file=sys.stderr, flush=True)
            yield from _rows(result, jobs)
    yield from means(results, jobs)
    if pictures is not None:
        save_all(results, contestant(cases[0].tracker), pictures)


def contestant(name: str) -> Tracker:
    """A tracker, or one with parts switched off, by its name in ``CONTESTANTS``."""
    return ABLATIONS[name](None) if name in ABLATIONS else open_tracker(name)


def means(results: Iterable[Result], jobs: int = 1) -> Iterator[Row]:
    """Rows for every tracker and condition over the clean clips and over the others: means, but the largest of e_t_max
    and time_to_skeleton_s.

    A case without any skeleton counts in ``lost_share``, it has no e_t.
    """
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        kind = "clean clips" if is_clean(result.flipped, result.frames) else "clips with flips"
        groups.setdefault((result.case.tracker, kind, result.case.condition), []).append(result)
    for (tracker, kind, seen), members in groups.items():
        for metric in _metrics_of(members):
            values = {m.case: m.metrics[metric] for m in members if metric in m.metrics}
            worst = max(values, key=lambda case: values[case])
            largest = metric in ("e_t_max", "time_to_skeleton_s")
            value = values[worst] if largest else float(np.mean(list(values.values())))
            remark = f"{len(values)} cases, largest {values[worst]:.4g} in {worst.body}/{worst.clip}"
            yield _row(f"{tracker}/all/{kind}/{seen}", metric, value, remark, *_noisy(metric, jobs))


def _metrics_of(results: list[Result]) -> list[str]:
    return list(dict.fromkeys(metric for result in results for metric in result.metrics))


def _names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


def _cases(
    data: Path | None,
    seconds: float | None,
    clips: tuple[str, ...],
    trackers: list[str],
    conditions: list[str],
    bodies: list[str],
) -> Iterator[Case]:
    """Every combination; the built-in performer plays its routine, the bodies of ``data`` its clips."""
    there = [] if data is None else list(json.loads((data / "mocap" / "clips.json").read_text()))
    persons = [] if data is None else sorted(path.stem for path in (data / "bodies").glob("*.npz"))
    _check("clip", clips, [ROUTINE, *there])
    _check("tracker", trackers, CONTESTANTS)
    _check("body", bodies, ["builtin", *persons])
    try:
        seen = [condition(name).name for name in conditions]
    except ValueError as error:
        raise SystemExit(str(error)) from None
    pairs = [("builtin", ROUTINE)] + [(body, clip) for clip in there for body in persons]
    for tracker in trackers:
        for name in seen:
            for body, clip in pairs:
                if (not clips or clip in clips) and (not bodies or body in bodies):
                    yield Case(tracker, body, clip, name, data, seconds)


def _check(what: str, names: Iterable[str], there: Iterable[str]) -> None:
    unknown = set(names) - set(there)
    if unknown:
        raise SystemExit(f"no {what} {', '.join(sorted(unknown))}; there are: {', '.join(there)}")


def _measured(cases: list[Case], jobs: int, stack: ExitStack) -> Iterator[Result]:
    """The cases' results in order, ``jobs`` at a time."""
    trackers = sorted({case.tracker for case in cases})
    if jobs == 1:
        _warm_up(trackers)
        return map(_measure, cases)
    context = multiprocessing.get_context("spawn")
    pool = stack.enter_context(ProcessPoolExecutor(jobs, context, _warm_up, (trackers,)))
    stack.callback(pool.shutdown, cancel_futures=True)
    return pool.map(_measure, cases)


def _warm_up(trackers: list[str]) -> None:
    """Compiles or loads every kernel, so that the first case's times are the tracker's own."""
    for tracker in trackers:
        for seen in ("points-given", "depth1-auto"):
            _measure(Case(tracker, "builtin", ROUTINE, seen, None, WARM_UP_S))


def _measure(case: Case) -> Result:
    seen = condition(case.condition)
    performer = performer_for(seen, case.body, None if case.clip == ROUTINE else case.clip, case.data)
    run = follow(contestant(case.tracker), sights(performer, seen, case.seconds), seen.start == "given")
    metrics = run.metrics()
    if seen.start == "given":
        metrics.pop("time_to_skeleton_s", None)
    e_t = run.e_t().tolist() if run.times_s else []
    return Result(case, metrics, *flips_of(performer), run.times_s, e_t)


def _summary(result: Result) -> str:
    return f"{result.case.name}: " + "  ".join(f"{name} {value:.4g}" for name, value in result.metrics.items())


def _rows(result: Result, jobs: int) -> Iterator[Row]:
    for metric, value in result.metrics.items():
        remarks = [f"glitches: {result.flipped} of {result.frames} frames"] if result.flipped else []
        yield _row(result.case.name, metric, value, *remarks, *_noisy(metric, jobs))


def _noisy(metric: str, jobs: int) -> list[str]:
    """What is to be said of times taken while other cases ran."""
    return [f"{jobs} cases at a time: noisy"] if jobs > 1 and metric.startswith("ms_") else []


def _row(case: str, metric: str, value: float, *remarks: str) -> Row:
    reference, source = _REFERENCES.get(metric, (None, "")) if case.endswith("/points-given") else (None, "")
    unit = _UNITS.get(metric, "R")
    joined = "; ".join(part for part in (source, *remarks) if part)
    return {"case": case, "metric": metric, "value": value, "unit": unit, "reference": reference, "source": joined}
