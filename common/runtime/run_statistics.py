"""The figures of a daemon's run that every daemon has: memory, processor time, stages; written as JSON at the end."""

from __future__ import annotations

import json
import os
import resource
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from common.runtime.daemon import DaemonError
from common.runtime.stage_timer import StageTimer


class RunStatistics:
    """Measures from its creation on."""

    def __init__(self, timer: StageTimer) -> None:
        self._timer = timer
        self._begin_s = time.monotonic()
        self._begin_cpu_s = time.process_time()

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self._begin_s

    def figures(self) -> dict[str, Any]:
        """``rss_mb``: peak resident memory [MiB]; ``cpu_share``: of one core, since creation; ``stage_ms``."""
        return {
            "elapsed_s": self.elapsed_s,
            "rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "cpu_share": (time.process_time() - self._begin_cpu_s) / max(self.elapsed_s, 1e-3),
            "stage_ms": {
                name: {"p50": s.p50_ms, "p95": s.p95_ms, "p99": s.p99_ms, "count": s.count}
                for name, s in self._timer.statistics().items()
            },
        }


def write_statistics(path: Path, figures: Mapping[str, Any]) -> None:
    """Write the figures whole or not at all.

    Raises:
        DaemonError: the file cannot be written.
    """
    unfinished = path.with_name(path.name + ".part")
    try:
        unfinished.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")
        os.replace(unfinished, path)
    except OSError as error:
        raise DaemonError(f"stats_file {path}: {error.strerror}") from error
