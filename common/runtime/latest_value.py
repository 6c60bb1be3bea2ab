"""A slot between two threads in which the newest value wins: what was not fetched in time is dropped and counted."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Closed(Exception):
    """The slot was closed; nothing more will come out of it."""


class LatestValue(Generic[Value]):
    """Holds at most one value. Any thread may put, wait and close."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._held: list[Value] = []  # empty or one value, so that None is a value like any other
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """How many values were replaced before anyone took them."""
        return self._dropped

    @property
    def closed(self) -> bool:
        """Whether ``close`` was called."""
        return self._closed

    def put(self, value: Value) -> None:
        """Replace whatever is held. After ``close`` the value is dropped without being counted."""
        with self._changed:
            if self._closed:
                return
            self._dropped += len(self._held)
            self._held = [value]
            self._changed.notify_all()

    def put_in_turn(self, value: Value) -> None:
        """Wait until nothing is held, then hold ``value``: for a source that can wait, so that nothing is dropped."""
        with self._changed:
            self._changed.wait_for(lambda: not self._held or self._closed)
            if not self._closed:
                self._held = [value]
                self._changed.notify_all()

    def wait(self, timeout_s: float | None = None) -> Value:
        """Take the value, waiting for one.

        Raises:
            TimeoutError: none came within ``timeout_s``.
            Closed: the slot was closed, before or while waiting; a value still held is gone then.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._held or self._closed, timeout_s):
                raise TimeoutError(f"no value within {timeout_s} s")
            if self._closed:
                raise Closed
            self._changed.notify_all()
            return self._held.pop()

    def close(self) -> None:
        """Wake everyone who waits; nothing is delivered from now on."""
        with self._changed:
            self._closed = True
            self._held.clear()
            self._changed.notify_all()
