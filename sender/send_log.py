"""What was sent to whom and why: a JSON line for every send, in a file that never grows beyond its bound."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections import Counter, deque
from pathlib import Path
from typing import Any

from sender.candidate_poses.mesh_scheduler import SendRecord

log = logging.getLogger(__name__)

MAX_BYTES = 8 << 20  # of the file; then it becomes NAME.1 and a new one begins
REMEMBERED = 1000  # sends, for the statistics


class SendLog:
    """Takes in every send. ``file`` None: only the newest are remembered. A full disk is said once and ends the file.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, file: Path | None, max_bytes: int = MAX_BYTES) -> None:
        self._file = file
        self._max_bytes = max_bytes
        self._out = None if file is None else file.open("ab", buffering=0)
        self._reasons: Counter[str] = Counter()
        self._recent: deque[dict[str, Any]] = deque(maxlen=REMEMBERED)

    def add(self, record: SendRecord) -> None:
        """One pose is on its way."""
        fields = dataclasses.asdict(record)
        self._reasons[record.reason.value] += 1
        self._recent.append(fields)
        if self._out is None or self._file is None:
            return
        line = json.dumps(fields, ensure_ascii=False).encode() + b"\n"
        try:
            if self._out.tell() + len(line) > self._max_bytes:
                self._out.close()
                self._file.replace(self._file.with_name(self._file.name + ".1"))
                self._out = self._file.open("wb", buffering=0)
            self._out.write(line)
        except OSError as error:
            log.warning("%s: nothing more is logged: %s", self._file, error.strerror)
            self.close()

    def close(self) -> None:
        """Nothing more is written."""
        if self._out is not None:
            self._out.close()
            self._out = None

    def figures(self) -> dict[str, Any]:
        """How many sends for which reason, and the newest of them."""
        return {"by_reason": dict(self._reasons), "newest": list(self._recent)}
