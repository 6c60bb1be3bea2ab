"""Runs one bench, prints its rows as a table and writes them as JSON.

A bench is a file ``scripts/bench_NAME.py``: its docstring says what it measures, and it has
``run(data: Path | None, seconds: float | None, clips: tuple[str, ...]) -> Iterable[Row]``. ``seconds`` bounds each
case, ``clips`` the cases; None and () mean all there is. A bench with options of its own declares them in
``add_options(parser)`` and gets them as further arguments of ``run``. Progress goes to stderr. The JSON file is written
after every case, so that a bench cut off keeps what it has.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import sys
from collections.abc import Iterable, Sequence
from itertools import groupby
from operator import itemgetter
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
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words:
        print("\n".join(f"{name:12} {about}" for name, about in known.items()) or "no benches here")
        return 0
    bench = importlib.import_module(f"scripts.{PREFIX}{words[0]}") if words[0] in known else None
    if bench is not None and hasattr(bench, "add_options"):
        bench.add_options(parser)
    options = vars(parser.parse_args(words))
    name, json_file = options.pop("name"), options.pop("json")
    if bench is None:
        parser.error("the bench's NAME comes first")
    if options["data"] is not None and not options["data"].is_dir():
        parser.error(f"--data {options['data']}: no such folder")
    if options["seconds"] is not None and options["seconds"] <= 0:
        parser.error("--seconds must be positive")
    options["clips"] = tuple(clip for clip in options["clips"].split(",") if clip)
    print(table(kept(bench.run(**options), name, json_file)))
    return 0


def kept(rows: Iterable[Row], bench: str, file: Path | None) -> list[Row]:
    """All rows, written to ``file`` after each case."""
    so_far: list[Row] = []
    for _, case in groupby(rows, key=itemgetter("case")):
        so_far += case
        if file is not None:
            file.write_text(json.dumps({"bench": bench, "rows": so_far}, indent=1) + "\n")
    return so_far


def _number(value: float | int | None) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
