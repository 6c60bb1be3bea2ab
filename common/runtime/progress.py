"""How far a long job is: one line drawn anew on a terminal, a line now and then where a log file is written."""

from __future__ import annotations

from typing import TextIO

from common.runtime.clock import Clock

BAR = 24
TERMINAL_EVERY_NS, LOG_EVERY_NS = 100_000_000, 10_000_000_000


class ProgressLine:
    """``what`` is being done; time is ``clock``'s. Nothing is drawn more often than it can be read."""

    def __init__(self, what: str, out: TextIO, clock: Clock) -> None:
        self._what = what
        self._out = out
        self._clock = clock
        self._terminal = out.isatty()
        self._every_ns = TERMINAL_EVERY_NS if self._terminal else LOG_EVERY_NS
        self._begin_ns = clock.now_ns()
        self._drawn_ns = self._begin_ns - (self._every_ns if self._terminal else 0)
        self._width = 0

    def show(self, share: float, detail: str) -> None:
        """``share`` 0..1 of the job is done; ``detail`` in words."""
        now_ns = self._clock.now_ns()
        if now_ns - self._drawn_ns < self._every_ns:
            return
        self._drawn_ns = now_ns
        share = min(max(share, 0.0), 1.0)
        left = f", {_duration((now_ns - self._begin_ns) / 1e9 * (1 - share) / share)} left" if share > 0.01 else ""
        words = f"{100 * share:3.0f} %  {detail}{left}"
        if not self._terminal:
            self._out.write(f"{self._what}: {words.lstrip()}\n")
        else:
            full = round(BAR * share)
            line = f"{self._what} [{'#' * full}{'-' * (BAR - full)}] {words}"
            self._out.write(f"\r{line:{self._width}}")
            self._width = len(line)
        self._out.flush()

    def clear(self) -> None:
        """Take the line off the terminal, for what is to be said at the end."""
        if self._terminal and self._width:
            self._out.write(f"\r{'':{self._width}}\r")
            self._out.flush()
            self._width = 0


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
