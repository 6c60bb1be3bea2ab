"""Whether a session has come apart: links are up, and yet nothing comes since one was lost, or not all that is needed.

When a path was gone in one direction for about as long as the lease, one end may have closed its transport and the
other one not: Zenoh then adds the new links to what is left of the old transport, and that end never says again what it
listens to, nor what its numbers for keys mean (eclipse-zenoh/zenoh#2806, open as of 1.10). Nothing heals it but
another session, which has another id. Pure: time is an argument.
"""

from __future__ import annotations

PATIENCE_NS = 1_000_000_000  # skeletons come within tenths of a second of a link
ANSWERS_NS = 5_000_000_000  # and what is asked for, which may be asked for several times, within seconds


class SplitSession:
    """One session's. A stream that is silent for reasons of its own costs one new session for each lost link.
    ``lost_any``: a link was lost in this session, and with it whatever was on it."""

    def __init__(self) -> None:
        self.lost_any = False
        self._links: set[str] = set()
        self._silent = False
        self._changed_ns = 0
        self._unanswered_ns: int | None = None

    def link(self, link: str, up: bool, now_ns: int) -> None:
        """A link came up, or was lost, as may be said more than once."""
        if up:
            self._links.add(link)
        else:
            self._links.discard(link)
            self._silent = self.lost_any = True
        self._changed_ns = now_ns

    def heard(self, answered: bool, now_ns: int) -> None:
        """Something of the stream came: all is well, if what it takes to show it has been ``answered`` as well."""
        self._silent = False
        self._unanswered_ns = None if answered else self._unanswered_ns or now_ns

    def is_split(self, now_ns: int) -> bool:
        """There are links, and after one was lost nothing came for a while, or for long no answers."""
        silent = self._silent and now_ns - self._changed_ns >= PATIENCE_NS
        unanswered = self._unanswered_ns is not None and now_ns - self._unanswered_ns >= ANSWERS_NS
        return bool(self._links) and (silent or unanswered)
