"""Charts and tables of the tracking bench, from results made up by hand."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest

from scripts.bench_tracking import means
from scripts.line_chart import HEIGHT, WIDTH, line_chart, ticks
from scripts.tracking_figures import charts, markdown
from scripts.tracking_run import Case, Result

SVG = "{http://www.w3.org/2000/svg}"


def result(tracker: str, clip: str, seen: str, e_t: float, flipped: int = 0) -> Result:
    metrics = {"e_t_mean": e_t, "e_t_mean_aligned": e_t / 2, "e_t_max": 2 * e_t, "lost_share": 0.125}
    return Result(
        Case(tracker, "body", clip, seen, None, None), metrics, flipped, 100, [0.0, 1.0, 2.0], [0.0, e_t, 2 * e_t]
    )


def polylines(svg: str) -> list[list[tuple[float, float]]]:
    lines = ElementTree.fromstring(svg).iter(f"{SVG}polyline")
    return [[tuple(map(float, p.split(","))) for p in line.attrib["points"].split()] for line in lines]


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 0.05, [0, 0.01, 0.02, 0.03, 0.04, 0.05]),
        (0.0, 6.0, [0, 2, 4, 6]),
        (1.0, 25.0, [0, 5, 10, 15, 20, 25]),
        (3.0, 3.0, [3.0, 3.2, 3.4, 3.6, 3.8, 4.0]),
    ],
)
def test_ticks_are_round_and_cover_the_range(low: float, high: float, expected: list[float]) -> None:
    assert ticks(low, high) == pytest.approx(expected)


def test_a_line_goes_where_its_values_are_and_names_are_text() -> None:
    svg = line_chart("a < b", "s", "e_t", {"one & two": ([0, 5, 10], [0.0, 1.0, 0.5])})
    line = polylines(svg)[-1]
    xs, ys = zip(*line, strict=True)
    assert xs[1] - xs[0] == pytest.approx(xs[2] - xs[1])
    assert ys[0] - ys[2] == pytest.approx((ys[0] - ys[1]) / 2, abs=0.11)  # upwards is less
    assert all(0 <= x <= WIDTH and 0 <= y <= HEIGHT for x, y in line)
    texts = [text.text for text in ElementTree.fromstring(svg).iter(f"{SVG}text")]
    assert {"a < b", "one & two", "e_t"} <= set(texts)


def test_a_level_is_drawn_where_it_lies_inside_only() -> None:
    lines = {"x": ([0, 1], [0.0, 0.1])}
    assert "stroke-dasharray" in line_chart("t", "s", "y", lines, ("lost", 0.05))
    assert "stroke-dasharray" not in line_chart("t", "s", "y", lines, ("lost", 0.5))


def test_an_empty_chart_is_refused() -> None:
    with pytest.raises(ValueError, match="chart 'nothing' has nothing to show"):
        line_chart("nothing", "s", "y", {"x": ([], [])})


def test_trackers_of_one_film_share_a_chart_and_curves_go_over_one_quantity_alone() -> None:
    results = [
        result("articp", "a", "points-given", 0.01),
        result("articp-no-global", "a", "points-given", 0.1),
        result("articp", "a", "share5-given", 0.02),
        result("articp", "a", "noise3cm-given", 0.03),
        result("articp", "b", "points-given", 0.5),  # not seen at 5 %: no part of that curve
        result("articp", "a", "depth4-auto", 0.04),
    ]
    drawn = dict(charts(results))
    assert set(drawn) == {
        "error_body_a_points-given.svg",
        "error_body_b_points-given.svg",
        "error_body_a_share5-given.svg",
        "error_body_a_noise3cm-given.svg",
        "error_body_a_depth4-auto.svg",
        "points.svg",
        "noise_m.svg",
    }
    assert len(re.findall("articp", drawn["error_body_a_points-given.svg"])) == 2
    five, plain = polylines(drawn["points.svg"])[-1]
    assert five[0] < plain[0]
    assert five[1] < plain[1]  # at 5 % the error is higher, and upwards is less
    assert max(float(y) for y in re.findall(r'end"[^>]*>([\d.]+)<', drawn["points.svg"])) < 0.05


def test_the_table_has_a_line_for_each_tracker_condition_and_kind_of_clip() -> None:
    results = [result("t", "a", "points-auto", 0.01), result("t", "b", "points-auto", 0.03)]
    results += [result("t", "c", "points-auto", 0.2, flipped=50)]
    lines = markdown(means(results)).splitlines()
    assert len(lines) == 4
    assert len({line.count("|") for line in lines}) == 1
    assert lines[2] == "| t | points-auto | clean clips (2) | 0.0200 | 0.0100 | 0.0600 | 12.5 % | – | – | – |"
    assert lines[3].startswith("| t | points-auto | clips with flips (1) | 0.2000 ")
