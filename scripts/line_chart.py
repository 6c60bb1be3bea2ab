"""Line charts as SVG text: no dependency, small files that a browser and a README show sharply."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

WIDTH, HEIGHT = 760, 340
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 56, 48  # room around the axes for their texts
LETTER, GAP = 7.0, 18  # width of a letter, about; between names
# Told apart by everyone (Okabe & Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000", "#888")
Line = tuple[Sequence[float], Sequence[float]]


def line_chart(
    title: str,
    x_label: str,
    y_label: str,
    lines: Mapping[str, Line],
    level: tuple[str, float] | None = None,
    dots: bool = False,
    low: float = 0.0,
) -> str:
    """SVG of ``lines`` by name, each x values and y values (from ``low`` up). ``level``: a named height, drawn dashed
    where it lies inside. ``dots``: mark every value.

    Raises:
        ValueError: no line has a value.
    """
    xs = np.concatenate([np.asarray(x, float) for x, _ in lines.values()] or [np.empty(0)])
    ys = np.concatenate([np.asarray(y, float) for _, y in lines.values()] or [np.empty(0)])
    if not len(xs):
        raise ValueError(f"chart {title!r} has nothing to show")
    x_ticks, y_ticks = ticks(float(xs.min()), float(xs.max())), ticks(low, float(ys.max()))
    x_range = min(x_ticks[0], xs.min()), max(x_ticks[-1], xs.max())
    y_range = low, max(y_ticks[-1], ys.max())

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - x_range[0]) / (x_range[1] - x_range[0])
        up = (y - y_range[0]) / (y_range[1] - y_range[0])
        return LEFT + across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - TOP - BOTTOM)

    parts = [_text(LEFT, 20, title, "start", bold=True)]
    for value in y_ticks:
        x, y = place(x_range[0], value)
        parts += [_stroke([(x, y), (WIDTH - RIGHT, y)], "#ddd", 1), _text(x - 6, y + 4, f"{value:g}", "end")]
    for value in x_ticks:
        x, y = place(value, low)
        parts += [_stroke([(x, y), (x, y + 4)], "#888", 1), _text(x, y + 18, f"{value:g}", "middle")]
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 10, x_label, "middle"))
    parts.append(_text(14, (TOP + HEIGHT - BOTTOM) / 2, y_label, "middle", turned=True))
    if level is not None and level[1] <= y_range[1]:
        (x, y), end = place(x_range[0], level[1]), WIDTH - RIGHT
        parts += [_stroke([(x, y), (end, y)], "#888", 1, dashed=True), _text(x + 4, y - 4, level[0], "start")]
    name_x = float(LEFT)
    for number, (name, (line_x, line_y)) in enumerate(lines.items()):
        colour = COLOURS[number % len(COLOURS)]
        points = [place(x, y) for x, y in zip(line_x, line_y, strict=True)]
        parts.append(_stroke(points, colour, 1.6))
        if dots:
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in points]
        parts.append(_text(name_x, 40, name, "start", colour=colour, bold=True))
        name_x += LETTER * len(name) + GAP
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif">'
    return "\n".join([head, f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>', *parts, "</svg>"]) + "\n"


def ticks(low: float, high: float) -> list[float]:
    """Four to eight round numbers of which the first is at most ``low`` and the last at least ``high``."""
    high = high if high > low else low + 1.0
    rough = (high - low) / 5
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * min((m for m in (1, 2, 2.5, 5, 10) if m * power >= rough * 0.99), default=10)
    first, last = np.floor(low / step + 1e-9), np.ceil(high / step - 1e-9)
    return [float(round(k * step, 12)) for k in np.arange(first, last + 1)]


def _stroke(points: Sequence[tuple[float, float]], colour: str, width: float, dashed: bool = False) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dash = ' stroke-dasharray="5 4"' if dashed else ""
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width}"{dash}/>'


def _text(
    x: float, y: float, text: str, anchor: str, colour: str = "#333", bold: bool = False, turned: bool = False
) -> str:
    weight = ' font-weight="bold"' if bold else ""
    turn = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turned else ""
    place = f'x="{x:.1f}" y="{y:.1f}" font-size="12" text-anchor="{anchor}"'
    return f'<text {place} fill="{colour}"{weight}{turn}>{escape(text)}</text>'
