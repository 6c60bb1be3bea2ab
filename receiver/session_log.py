"""What arrives, as a session file, for ``telepose-receive decode`` afterwards (``telepose-receive --record FILE``)."""

from __future__ import annotations

import logging
from pathlib import Path

from common.runtime.session_recording import RecordingError, SessionWriter
from common.transport.channels import SCHEMA

log = logging.getLogger(__name__)


class SessionLog:
    """Every payload of the recorded channels, by the time it arrived. The file has its name once it is closed; until
    then, and after a crash, what there is is in ``FILE.part``, which plays too. A full disk ends it, not the session.

    Raises:
        RecordingError: the file cannot be made, or the package is missing.
    """

    def __init__(self, file: Path, site: str, person: int) -> None:
        self._file = file
        self._writer: SessionWriter | None = SessionWriter(file, SCHEMA, {"site": site, "person": str(person)})

    def add(self, key: str, time_ns: int, payload: bytes) -> None:
        """One message."""
        if self._writer is not None:
            try:
                self._writer.add(key, time_ns, payload)
            except RecordingError as error:
                self._give_up(error)

    def close(self) -> None:
        """The session is over."""
        if self._writer is not None:
            try:
                size = self._writer.finish()
                log.info("%s: a session of %d bytes", self._file, size)
            except RecordingError as error:
                self._give_up(error)
        self._writer = None

    def _give_up(self, error: RecordingError) -> None:
        log.warning("nothing more is recorded: %s", error)
        self._writer = None
