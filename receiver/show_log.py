"""What arrived and what was shown, kept for measuring afterwards (``telepose-receive --log-shown FILE``).

One append-only msgpack stream of records ``[kind, time_ns, payload]``; times are the receiver's monotonic clock:

``skeleton`` packet bytes · ``body`` message bytes · ``pose`` candidate pose bytes · ``frame`` [epoch, sequence, pose id
or None, σ or None]: an animated mesh became ready · ``tick`` [sequence or None, age_ns or None]: what a display
tick showed.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import msgpack

log = logging.getLogger(__name__)

MAX_RECORD_BYTES = 8 * 1024 * 1024


class ShowLog:
    """Writes records; small ones stay in the file object's buffer, so a record costs microseconds. A full disk is said
    once and ends the log, not the session.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file: BinaryIO | None = path.open("wb")
        self._packer = msgpack.Packer(use_bin_type=True)

    def add(self, kind: str, time_ns: int, payload: bytes | list[Any]) -> None:
        """Append one record."""
        if self._file is not None:
            try:
                self._file.write(self._packer.pack([kind, time_ns, payload]))
            except OSError as error:
                self._give_up(error)

    def close(self) -> None:
        """Write out what is buffered."""
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        log.warning("%s: nothing more is logged: %s", self._path, error.strerror)
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):
                file.close()  # what is buffered cannot be written either


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
