"""What arrived and what was shown, kept for measuring afterwards (``telepose-receive --log-shown FILE``).

One append-only msgpack stream of records ``[kind, time_ns, payload]``; times are the receiver's monotonic clock:

``skeleton`` packet bytes · ``body`` message bytes · ``pose`` candidate pose bytes · ``frame`` [epoch, sequence, pose id
or None, σ or None]: an animated mesh became ready · ``tick`` [sequence or None, age_ns or None]: what a display
tick showed.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import msgpack

MAX_RECORD_BYTES = 8 * 1024 * 1024


class ShowLog:
    """Writes records; small ones stay in the file object's buffer, so a record costs microseconds."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: BinaryIO = path.open("wb")
        self._packer = msgpack.Packer(use_bin_type=True)

    def add(self, kind: str, time_ns: int, payload: bytes | list[Any]) -> None:
        """Append one record."""
        self._file.write(self._packer.pack([kind, time_ns, payload]))

    def close(self) -> None:
        self._file.close()


def read_show_log(path: Path) -> Iterator[tuple[str, int, Any]]:
    """The records of a log, in order; a record cut short by a crash ends the reading.

    Raises:
        ValueError: the file holds something that is not a show log.
    """
    with path.open("rb") as file:
        unpacker = msgpack.Unpacker(file, raw=False, max_buffer_size=MAX_RECORD_BYTES, max_array_len=8)
        for record in unpacker:
            if not (isinstance(record, list) and len(record) == 3 and isinstance(record[0], str)):
                raise ValueError(f"{path}: not a show log")
            yield record[0], record[1], record[2]
