"""Keeps the body found, so that a sender that was killed goes on in mid-motion without another A-pose."""

from __future__ import annotations

import logging
import os
from pathlib import Path

from common.runtime.daemon import DaemonError
from sender.fitting.body_model import BodyModel

log = logging.getLogger(__name__)

MAX_BYTES = 64 << 20


class BodyStore:
    """One file per site and person.

    Raises:
        DaemonError: the folder cannot be made.
    """

    def __init__(self, folder: Path | None, site: str, person: int) -> None:
        folder = folder or _user_state_folder()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DaemonError(f"state folder {folder}: {error.strerror}") from error
        self._path = folder / f"{site}-{person}.body"

    def load(self) -> BodyModel | None:
        """The body kept, or None when there is none; a damaged file is said so and left alone."""
        try:
            if self._path.stat().st_size > MAX_BYTES:
                raise ValueError(f"larger than {MAX_BYTES} bytes")
            body = BodyModel.from_bytes(self._path.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            log.warning("body file %s is not used: %s", self._path, error)
            return None
        log.info("going on with the body in %s", self._path)
        return body

    def save(self, data: bytes) -> None:
        """Replace the body kept, whole or not at all; a full disk is said so and costs only the restart."""
        unfinished = self._path.with_name(self._path.name + ".part")
        try:
            with unfinished.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            unfinished.replace(self._path)
        except OSError as error:
            log.warning("body file %s was not written: %s", self._path, error.strerror)


def _user_state_folder() -> Path:
    base = (
        os.environ.get("STATE_DIRECTORY") or os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    )
    return Path(base) / "telepose"
