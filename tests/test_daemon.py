"""A daemon's life, with real signals to real processes: exit codes, deadlines, readiness, what the log says."""

from __future__ import annotations

import logging
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from common.runtime.daemon import DaemonError, LineFormatter, check_one_root

WITHIN_S = 10.0  # far beyond any deadline under test: reached only when something hangs
HEAD = """
import asyncio, ctypes, sys, time
from common.runtime.daemon import DaemonError, run_daemon, set_up_logging
set_up_logging()
async def wait(daemon):
    daemon.announce_ready()
    await asyncio.Event().wait()
"""
Start = Callable[[str], "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a process with the given program after HEAD; killed when the test ends."""
    processes: list[subprocess.Popen[str]] = []

    def run(program: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", HEAD + program]
        processes.append(subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.communicate()


def wait_for_line(process: subprocess.Popen[str], text: str) -> str:
    assert process.stderr is not None
    for line in process.stderr:
        if text in line:
            return line
    raise AssertionError(f"the process ended without {text!r}")


def finish(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, log = process.communicate(timeout=WITHIN_S)
    return process.returncode, log


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_it_with_code_0(start: Start, number: signal.Signals) -> None:
    process = start("""
async def main(daemon):
    try:
        await wait(daemon)
    finally:
        await asyncio.sleep(0.05)
        print("cleaned up")
sys.exit(run_daemon("d", main))
""")
    wait_for_line(process, "d ready")
    process.send_signal(number)
    output, log = process.communicate(timeout=WITHIN_S)
    assert (process.returncode, output) == (0, "cleaned up\n")
    assert log.count(f"d stopping: {number.name}") == 1
    assert log.count("d stopped") == 1


def test_a_signal_before_it_is_ready_stops_it_too(start: Start) -> None:
    process = start("""
async def main(daemon):
    print("here", flush=True)
    await asyncio.Event().wait()
sys.exit(run_daemon("d", main))
""")
    assert process.stdout is not None
    process.stdout.readline()
    process.terminate()
    assert finish(process)[0] == 0


def test_it_ends_with_code_0_when_its_work_is_done(start: Start) -> None:
    process = start("""
async def main(daemon): pass
sys.exit(run_daemon("d", main))
""")
    assert finish(process)[0] == 0


def test_a_failure_the_operator_can_mend_is_one_line(start: Start) -> None:
    process = start("""
async def main(daemon):
    async with asyncio.TaskGroup() as group:
        group.create_task(wait(daemon))
        raise DaemonError("port 7447 is in use")
sys.exit(run_daemon("d", main))
""")
    code, log = finish(process)
    assert code == 1
    assert next(line for line in log.splitlines() if "ERROR" in line).endswith("d failed: port 7447 is in use")
    assert "Traceback" not in log


def test_a_programming_error_has_its_traceback_on_the_same_line(start: Start) -> None:
    process = start("""
async def main(daemon): {}["missing"]
sys.exit(run_daemon("d", main))
""")
    code, log = finish(process)
    (line,) = log.splitlines()
    assert code == 1
    assert "ERROR" in line
    assert "d failed: KeyError: 'missing'" in line
    assert "Traceback" in line


def test_an_error_in_a_callback_of_the_loop_fails_it(start: Start) -> None:
    process = start("""
def broken(): raise ValueError("bad callback")
async def main(daemon):
    asyncio.get_running_loop().call_later(0.02, broken)
    await wait(daemon)
sys.exit(run_daemon("d", main))
""")
    code, log = finish(process)
    assert code == 1
    assert "d failed: ValueError: bad callback" in log


def test_a_cancellation_nobody_asked_for_is_a_failure(start: Start) -> None:
    process = start("""
async def main(daemon): asyncio.current_task().cancel(); await asyncio.sleep(1)
sys.exit(run_daemon("d", main))
""")
    code, log = finish(process)
    assert code == 1
    assert "d failed: " in log
    assert "CancelledError" in log


HANGS = {
    "cleaning up never ends": """
async def main(daemon):
    try: await wait(daemon)
    finally: await asyncio.Event().wait()
""",
    "the loop is blocked": """
async def main(daemon):
    daemon.announce_ready()
    time.sleep(60)
""",
    "the interpreter's lock is held": """
async def main(daemon):
    daemon.announce_ready()
    asyncio.get_running_loop().call_later(0.2, ctypes.PyDLL(None).sleep, 60)
    try: await asyncio.Event().wait()
    finally: await asyncio.sleep(1)
""",
    "a call in another thread never ends": """
async def main(daemon):
    asyncio.get_running_loop().run_in_executor(None, time.sleep, 60)
    await wait(daemon)
""",
}


@pytest.mark.parametrize("program", HANGS.values(), ids=HANGS.keys())
def test_whatever_hangs_the_process_ends_by_the_deadline(start: Start, program: str) -> None:
    process = start(program + 'sys.exit(run_daemon("d", main, stop_within_s=0.4))')
    wait_for_line(process, "d ready")
    process.terminate()
    code, log = finish(process)
    assert code == 1
    assert "not stopped within 0.4 s" in log or "Timeout" in log
    assert "most recent call first" in log  # where it hung


def test_the_second_signal_ends_it_at_once(start: Start) -> None:
    process = start(HANGS["cleaning up never ends"] + 'sys.exit(run_daemon("d", main, stop_within_s=60))')
    wait_for_line(process, "d ready")
    process.send_signal(signal.SIGINT)
    wait_for_line(process, "d stopping")
    process.send_signal(signal.SIGTERM)
    code, log = finish(process)
    assert code == 128 + signal.SIGTERM
    assert "second SIGTERM" in log


def test_readiness_reaches_the_file_and_systemd(start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ready_file, notify = tmp_path / "ready", tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(notify))
        systemd.settimeout(WITHIN_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(notify))
        process = start(f"""
from pathlib import Path
sys.exit(run_daemon("d", wait, ready_file=Path({str(ready_file)!r})))
""")
        assert systemd.recv(100) == b"READY=1"
        assert int(ready_file.read_text()) == process.pid
        process.terminate()
        assert systemd.recv(100) == b"STOPPING=1"
    assert finish(process)[0] == 0
    assert not ready_file.exists()


def test_log_lines_stay_one_line() -> None:
    record = logging.LogRecord("x", logging.INFO, "", 0, "first\nsecond %s", ("third\n",), None)
    line = LineFormatter().format(record)
    assert "\n" not in line
    assert line.endswith('INFO x first "second third"')


def test_packages_from_different_places_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_one_root()
    (tmp_path / "foreign_package").mkdir()
    (tmp_path / "foreign_package" / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(DaemonError, match="foreign_package in /"):
        check_one_root(("common", "foreign_package"))
    with pytest.raises(DaemonError, match="absent_package in no folder"):
        check_one_root(("common", "absent_package"))
