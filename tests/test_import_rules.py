"""No module mixes the event loop with number crunching, and none unpickles.

The other rules on imports are import-linter contracts in pyproject.toml.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent
MODULES = sorted(p.relative_to(ROOT) for part in ("common", "sender", "receiver") for p in (ROOT / part).rglob("*.py"))


def imported(source: str) -> set[str]:
    """Top-level names of everything imported anywhere in the source."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.partition(".")[0])
    return names


def test_imports_are_found_wherever_they_stand() -> None:
    source = "import a.b\nfrom c.d import e\nif True:\n    import f\ndef g():\n    from h import i"
    assert imported(source) == {"a", "c", "f", "h"}


def modules_importing(*names: str, any_of: bool = False) -> list[str]:
    imports = {str(m): imported((ROOT / m).read_text()) for m in MODULES}
    return [m for m, found in imports.items() if (set(names) & found if any_of else set(names) <= found)]


def test_only_daemons_import_both_asyncio_and_numpy() -> None:
    assert [m for m in modules_importing("asyncio", "numpy") if Path(m).name != "daemon.py"] == []


def test_nothing_is_unpickled() -> None:
    assert modules_importing("pickle", "shelve", "marshal", any_of=True) == []


def test_only_certificates_go_by_the_wall_clock() -> None:
    """Everything else is monotonic, so that a step of the clock, of an hour or a year, changes nothing."""
    words = ("time.time(", "time_ns()", "datetime.now", "utcnow", "perf_counter")
    readers = {str(m) for m in MODULES for line in (ROOT / m).read_text().splitlines() if any(w in line for w in words)
               and "monotonic_ns()" not in line and "thread_time_ns()" not in line}  # fmt: skip
    assert readers == {"common/transport/zenoh_session.py"}
