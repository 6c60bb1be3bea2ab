"""Runs one bench, prints its rows as a table and writes them as JSON.

A bench is a file ``scripts/bench_NAME.py``: its docstring says what it measures, and it has
``run(data: Path | None, seconds: float | None, clips: tuple[str, ...]) -> list[Row]``. ``seconds`` bounds each case,
``clips`` the cases; None and () mean all there is. Progress goes to stderr.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict

SCRIPTS = Path(__file__).parent
PREFIX = "bench_"


class Row(TypedDict):
    """One figure. ``reference``: the paper's figure or None; ``source``: where that stands, or how it was measured."""

    case: str
    metric: str
    value: float | int | None
    unit: str
    reference: float | int | None
    source: str


def benches() -> dict[str, str]:
    """Every bench by name, with the first line of its docstring."""
    files = sorted(SCRIPTS.glob(f"{PREFIX}*.py"))
    return {
        f.stem.removeprefix(PREFIX): (ast.get_docstring(ast.parse(f.read_text())) or "").partition("\n")[0]
        for f in files
    }


def table(rows: Sequence[Row]) -> str:
    """The rows as aligned text."""
    lines = [("case", "metric", "value", "unit", "reference", "source")]
    for row in rows:
        lines.append(
            (row["case"], row["metric"], _number(row["value"]), row["unit"], _number(row["reference"]), row["source"])
        )
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    known = benches()
    parser = argparse.ArgumentParser(prog="scripts/bench", description="Measures telepose on this machine.")
    parser.add_argument("name", nargs="?", choices=sorted(known), metavar="NAME")
    parser.add_argument("--data", type=Path, help="folder with bodies, motion capture and recordings")
    parser.add_argument("--json", type=Path, help="file for the rows as JSON")
    parser.add_argument("--seconds", type=float, help="at most so many seconds of motion per case")
    parser.add_argument("--clips", default="", help="only these clips, separated by commas")
    options = parser.parse_args(arguments)
    if options.name is None:
        print("\n".join(f"{name:12} {about}" for name, about in known.items()) or "no benches here")
        return 0
    if options.data is not None and not options.data.is_dir():
        parser.error(f"--data {options.data}: no such folder")
    if options.seconds is not None and options.seconds <= 0:
        parser.error("--seconds must be positive")
    clips = tuple(clip for clip in options.clips.split(",") if clip)
    bench = importlib.import_module(f"scripts.{PREFIX}{options.name}")
    rows: list[Row] = bench.run(data=options.data, seconds=options.seconds, clips=clips)
    print(table(rows))
    if options.json is not None:
        options.json.write_text(json.dumps({"bench": options.name, "rows": rows}, indent=1) + "\n")
    return 0


def _number(value: float | int | None) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
