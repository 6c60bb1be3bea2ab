"""Whether a session has come apart: links are up, and yet nothing comes since one was lost.

When a path was gone in one direction for about as long as the lease, one end may have closed its transport and the
other one not: Zenoh then adds the new links to what is left of the old transport, and that end never says again what it
listens to, nor what its numbers for keys mean (eclipse-zenoh/zenoh#2806, open as of 1.10). Nothing heals it but
another session, which has another id. Pure: time is an argument.
"""

from __future__ import annotations

PATIENCE_NS = 1_000_000_000  # skeletons come within tenths of a second of a link


class SplitSession:
    """One session's. A stream that is silent for reasons of its own costs one new session for each lost link."""

    def __init__(self) -> None:
        self._links = 0
        self._lost = False
        self._changed_ns = 0

    def link(self, up: bool, now_ns: int) -> None:
        """A link came up, or was lost."""
        self._links += 1 if up else -1
        self._lost |= not up
        self._changed_ns = now_ns

    def heard(self) -> None:
        """Something of the stream came: all is well."""
        self._lost = False

    def is_split(self, now_ns: int) -> bool:
        """A link was lost, there are links, and for a while nothing came."""
        return self._lost and self._links > 0 and now_ns - self._changed_ns >= PATIENCE_NS
