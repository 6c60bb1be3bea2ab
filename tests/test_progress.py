"""The progress line: redrawn on a terminal, now and then in a log file."""

from __future__ import annotations

import io

from common.runtime.clock import ManualClock
from common.runtime.progress import ProgressLine


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_log_file_gets_a_whole_line_now_and_then():
    clock, out = ManualClock(), io.StringIO()
    progress = ProgressLine("encode", out, clock)
    for step in range(100):
        progress.show(step / 100, f"{step} frames")
        clock.advance(250_000_000)
    progress.clear()
    assert out.getvalue() == "encode: 40 %  40 frames, 15 s left\nencode: 80 %  80 frames, 5 s left\n"


def test_a_terminal_gets_one_line_that_is_redrawn_and_taken_off():
    clock, out = ManualClock(), Terminal()
    progress = ProgressLine("decode", out, clock)
    progress.show(0.0, "a longer word")
    progress.show(0.1, "too soon to be read")
    clock.advance(2_000_000_000)
    progress.show(0.5, "half")
    progress.clear()
    first, second, cleared, rest = out.getvalue().split("\r")[1:]
    assert "\n" not in out.getvalue()
    assert "soon" not in out.getvalue()
    assert second.startswith("decode [############------------]  50 %  half, 2 s left")
    assert len(second) >= len(first)  # nothing of the longer line is left over
    assert cleared.strip() == rest == ""
