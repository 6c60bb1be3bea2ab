"""Pictures of the tracking bench, and its figures as a Markdown table.

Error over frames with every tracker's line (as Lien 2009 Fig. 6), mean error over the share of points (Fig. 7), the
noise (Fig. 8) and the frame rate, and a strip of overlays: the found skeleton on what the frontal camera sees, with the
true joints as white rings. ``python -m scripts.tracking_figures BENCH.json…`` prints the table.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scripts.line_chart import Line, line_chart
from scripts.overlay import dots, draw, picture_of
from scripts.run_bench import Row
from scripts.tracking_conditions import SAMPLED, Condition, condition, performer_for, sights
from scripts.tracking_run import LOST_E_T, Result
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import RigRenderer
from sender.fitting.tracker import FitResult, Tracker

# What a curve goes over: field of a condition, its unit's size, and the label of the axis.
CURVES = {
    "points": (SAMPLED / 100, "points, % of 10,000"),
    "noise_m": (0.01, "noise on each axis, cm (σ)"),
    "frame_rate_hz": (1.0, "frames a second"),
}
OVERLAYS_S = (0.5, 5.6, 8.9, 12.3, 15.3, 18.2, 22.4, 29.5)  # A-pose, wave, T-pose, arms folded, squat, turn, step, kick
QUALITY = 85
_COLUMNS = ("e_t_mean", "e_t_mean_aligned", "e_t_max", "lost_share", "time_to_skeleton_s", "ms_per_frame_p50",
            "ms_per_frame_p99")  # fmt: skip


def charts(results: Iterable[Result]) -> Iterator[tuple[str, str]]:
    """File name and SVG text of every chart the results are enough for."""
    by_film: dict[tuple[str, str, str], dict[str, Line]] = {}
    for result in results:
        if result.times_s:
            case = result.case
            film = by_film.setdefault((case.body, case.clip, case.condition), {})
            film[case.tracker] = result.times_s, result.e_t
    for (body, clip, seen), lines in by_film.items():
        level = "lost", LOST_E_T
        title = f"Tracking error: {body}, {clip}, {seen}"
        yield f"error_{body}_{clip}_{seen}.svg", line_chart(title, "s", "e_t", lines, level)
    yield from _curves(list(results))


def _curves(results: list[Result]) -> Iterator[tuple[str, str]]:
    """Mean error over one quantity, all else as in the plain condition, over the films seen at each of its values."""
    for quantity, (unit, label) in CURVES.items():
        found: dict[str, dict[float, dict[tuple[str, str], float]]] = {}
        for result in results:
            seen = condition(result.case.condition)
            plain = replace(Condition("", seen.start), **{quantity: getattr(seen, quantity)})
            if replace(seen, name="") == plain and "e_t_mean" in result.metrics:
                line = found.setdefault(f"{result.case.tracker}, {seen.start}", {})
                film = result.case.body, result.case.clip
                line.setdefault(getattr(seen, quantity) / unit, {})[film] = result.metrics["e_t_mean"]
        lines = {name: _mean_line(values) for name, values in found.items() if len(values) > 1}
        if lines:
            yield f"{quantity}.svg", line_chart(f"Mean error over {label}", label, "e_t", lines, dots=True)


def _mean_line(values: Mapping[float, Mapping[tuple[str, str], float]]) -> Line:
    """Means over the films that every value has."""
    films = set.intersection(*(set(errors) for errors in values.values()))
    xs = sorted(values) if films else []
    return xs, [float(np.mean([values[x][film] for film in films])) for x in xs]


def overlays(tracker: Tracker, cameras: int = 4) -> NDArray[np.uint8]:
    """A strip (H, W, 3) uint8 RGB of the built-in performer, found by ``tracker`` with nothing given."""
    seen = condition(f"depth{cameras}-auto")
    performer = performer_for(seen, "builtin", None, None)
    renderer = RigRenderer(performer, RigSettings(cameras=cameras))
    camera = renderer.cameras[0]
    wanted = {round(time_s * seen.frame_rate_hz) for time_s in OVERLAYS_S}
    tiles = []
    for number, sight in enumerate(sights(performer, seen, max(OVERLAYS_S) + 0.1)):
        fit: FitResult | None = tracker.track(sight.cloud, round(sight.time_s * 1e9))
        if number not in wanted:
            continue
        depth = np.empty((camera.height, camera.width), np.uint16)
        colour = np.empty((camera.height, camera.width, 3), np.uint8)
        renderer.view(0, sight.time_s, depth, colour)
        picture, scale = picture_of(depth, colour)
        if fit is not None:
            draw(picture, camera, fit.skeleton, fit.pose, scale)
        dots(picture, camera, sight.joints, scale)
        width = picture.shape[1]
        tiles.append(picture[:, width // 4 : -width // 4])
    return np.concatenate(tiles, axis=1)


def save_all(results: list[Result], tracker: Tracker, folder: Path) -> None:
    """Every chart of the results, and the overlays of ``tracker``, into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, svg in charts(results):
        (folder / name).write_text(svg)
    cv2.imwrite(str(folder / "overlay.jpg"), overlays(tracker)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def markdown(rows: Iterable[Row]) -> str:
    """The means of a tracking bench as a Markdown table: one line for each tracker, kind of clips and condition."""
    lines: dict[str, dict[str, Row]] = {}
    for row in rows:
        if "/all/" in row["case"]:
            lines.setdefault(row["case"], {})[row["metric"]] = row
    head = "| tracker | condition | clips | e_t | aligned | max | lost | first skeleton | ms p50 | ms p99 |"
    out = [head, "|---" * (head.count("|") - 1) + "|"]
    for case, figures in lines.items():
        tracker, _, kind, seen = case.split("/")
        count = figures["lost_share"]["source"].partition(" ")[0]
        cells = [_cell(metric, figures[metric]["value"]) if metric in figures else "–" for metric in _COLUMNS]
        out.append(f"| {tracker} | {seen} | {kind} ({count}) | {' | '.join(cells)} |")
    return "\n".join(out)


def _cell(metric: str, value: float | int | None) -> str:
    if value is None:
        return "–"
    if metric == "lost_share":
        return f"{100 * value:.1f} %"
    return f"{value:.4f}" if metric.startswith("e_t") else f"{value:.2f} s" if metric.endswith("_s") else f"{value:.1f}"


if __name__ == "__main__":
    print(markdown(row for file in sys.argv[1:] for row in json.loads(Path(file).read_text())["rows"]))
