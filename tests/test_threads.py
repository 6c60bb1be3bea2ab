"""Threads that give way, and libraries that start none."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest

from common.runtime.threads import BACKGROUND, into_background


@pytest.mark.skipif(sys.platform != "linux", reason="niceness of a thread is Linux's")
def test_only_the_calling_thread_goes_into_the_background():
    found = {}

    def work() -> None:
        into_background()
        found["there"] = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    here = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found["there"] == max(BACKGROUND, here)
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == here


def test_libraries_start_no_threads_of_their_own():
    program = (
        "from common.runtime.threads import prepare_threads; prepare_threads(); import cv2, numpy as np, os;"
        "a = np.ones((600, 600)); a @ a; cv2.GaussianBlur(a, (31, 31), 0);"
        "print(cv2.getNumThreads(), len(os.listdir('/proc/self/task')))"
    )
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    shown = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60, env=environment
    )
    assert shown.stdout.split() == ["1", "1"]
