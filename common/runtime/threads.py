"""Threads on a machine with few cores: libraries start none of their own, and what the picture waits for goes first."""

from __future__ import annotations

import contextlib
import os
import sys
import threading

BACKGROUND = 10  # niceness of work that nobody waits for

# A thread that comes back from compiled code asks for the interpreter, and gets it when this is over at the latest.
# Python's own 5 ms are half of a frame's processing time.
SWITCH_INTERVAL_S = 0.0005


def prepare_threads() -> None:
    """To be called before NumPy and OpenCV are imported.

    Their thread pools spin while they wait for work as small as ours; the stages are the parallelism here.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def into_background() -> None:
    """The calling thread gives way to all others from now on (Linux: niceness belongs to the thread)."""
    if sys.platform == "linux":
        with contextlib.suppress(PermissionError):  # it is further back already, and may not come forward
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), BACKGROUND)
