"""What was sent to whom and why: a JSON line for every send, in a file that never grows beyond its bound."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter, deque
from pathlib import Path
from typing import Any

from sender.candidate_poses.mesh_scheduler import SendRecord

MAX_BYTES = 8 << 20  # of the file; then it becomes NAME.1 and a new one begins
REMEMBERED = 1000  # sends, for the statistics


class SendLog:
    """Takes in every send. ``file`` None: only the newest are remembered.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, file: Path | None, max_bytes: int = MAX_BYTES) -> None:
        self._file = file
        self._max_bytes = max_bytes
        self._out = None if file is None else file.open("a", encoding="utf-8")
        self._reasons: Counter[str] = Counter()
        self._recent: deque[dict[str, Any]] = deque(maxlen=REMEMBERED)

    def add(self, record: SendRecord) -> None:
        """One pose is on its way."""
        fields = dataclasses.asdict(record)
        self._reasons[record.reason.value] += 1
        self._recent.append(fields)
        if self._out is None or self._file is None:
            return
        line = json.dumps(fields, ensure_ascii=False) + "\n"
        if self._out.tell() + len(line.encode()) > self._max_bytes:
            self._out.close()
            self._file.replace(self._file.with_name(self._file.name + ".1"))
            self._out = self._file.open("w", encoding="utf-8")
        self._out.write(line)
        self._out.flush()

    def close(self) -> None:
        """Nothing more is written."""
        if self._out is not None:
            self._out.close()
            self._out = None

    def figures(self) -> dict[str, Any]:
        """How many sends for which reason, and the newest of them."""
        return {"by_reason": dict(self._reasons), "newest": list(self._recent)}
