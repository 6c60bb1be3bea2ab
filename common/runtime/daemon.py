"""The life of a daemon: logging, signals, readiness, exit code and a deadline for stopping.

``run_daemon`` runs one coroutine under uvloop, on a thread of its own. The main thread waits for signals, so that a
loop that hangs cannot hold them up: the first SIGTERM or SIGINT cancels the coroutine, the second ends the process at
once, and what has not stopped by the deadline is left behind.
"""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import importlib.util
import json
import logging
import os
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import uvloop

from common.runtime.garbage import collect_from_now_on

log = logging.getLogger(__name__)

STOP_WITHIN_S = 1.8  # from the first signal, or the end of the main coroutine, to the end of the process
PACKAGES = ("common", "sender", "receiver")
_STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)
_LOOP_ENDED = 0  # no signal has this number


class DaemonError(Exception):
    """The daemon cannot go on for a reason the operator can act on; logged as its text alone, without a traceback."""


class Daemon:
    """What the main coroutine may do to its daemon."""

    def __init__(self, name: str, ready_file: Path | None) -> None:
        self.name = name
        self._ready_file = ready_file

    def announce_ready(self) -> None:
        """Say once that the daemon does its job: a log line, the readiness file, and systemd. Its start is over."""
        collect_from_now_on()
        if self._ready_file is not None:
            unfinished = self._ready_file.with_name(self._ready_file.name + ".part")
            unfinished.write_text(f"{os.getpid()}\n", "ascii")
            unfinished.replace(self._ready_file)  # whoever sees the file sees all of it
        _notify_systemd("READY=1")
        log.info("%s ready, pid %d", self.name, os.getpid())

    def withdraw_readiness(self) -> None:
        """Take the announcement back, as the daemon stops."""
        if self._ready_file is not None:
            self._ready_file.unlink(missing_ok=True)
        _notify_systemd("STOPPING=1")


def run_daemon(
    name: str,
    main: Callable[[Daemon], Awaitable[None]],
    ready_file: Path | None = None,
    stop_within_s: float = STOP_WITHIN_S,
) -> int:
    """Run ``main`` until it returns, fails, or a signal comes; the exit code for ``sys.exit``.

    To be called once, in the main thread.

    0: it returned, or was stopped by a signal. 1: it failed (one log line says why), or did not stop in time. The
    process ends within ``stop_within_s`` of the first signal or of the end of ``main``, whatever hangs.
    """
    try:
        check_one_root()
    except DaemonError as error:
        log.error("%s failed: %s", name, error)
        return 1
    faulthandler.enable()  # a crash, or SIGABRT to a daemon that hangs, shows where every thread is
    # The interpreter writes the number of each signal to this socket, whichever thread receives it.
    inbox, outbox = socket.socketpair()
    outbox.setblocking(False)
    signal.set_wakeup_fd(outbox.fileno(), warn_on_full_buffer=False)
    for stop_signal in _STOP_SIGNALS:
        signal.signal(stop_signal, lambda *_: None)  # without a handler in Python nothing is written
    supervisor = _Supervisor(Daemon(name, ready_file), main, outbox)
    supervisor.start()
    stopping = False
    while (number := inbox.recv(1)[0]) != _LOOP_ENDED:
        if number not in _STOP_SIGNALS:
            continue
        if stopping:
            log.warning("%s: second %s, leaving at once", name, signal.Signals(number).name)
            leave(128 + number)
        stopping = True
        _leave_at_deadline(name, stop_within_s)
        supervisor.stop(signal.Signals(number).name)
    if not stopping:
        _leave_at_deadline(name, stop_within_s)
    return supervisor.exit_code


def set_up_logging(level: str = "INFO") -> None:
    """Log to standard error, one line per event; a second call replaces the first."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter())
    logging.basicConfig(level=level, handlers=[handler], force=True)
    logging.captureWarnings(True)


class LineFormatter(logging.Formatter):
    """``time level logger message``, on one line whatever the message or the traceback holds."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(name)s %(message)s")
        self.default_msec_format = "%s.%03d"

    def format(self, record: logging.LogRecord) -> str:
        text, *rest = super().format(record).splitlines() or [""]
        return text + (" " + json.dumps("\n".join(rest), ensure_ascii=False) if rest else "")


def check_one_root(packages: tuple[str, ...] = PACKAGES) -> None:
    """Refuse to run when the packages were not installed together: foreign ones of the same names may be in the way.

    Raises:
        DaemonError: one is missing, or they lie in different folders; the text says where each was found.
    """
    roots: dict[str, Path | None] = {}
    for package in packages:
        spec = importlib.util.find_spec(package)
        origin = spec.origin if spec is not None else None
        roots[package] = Path(origin).resolve().parent.parent if origin is not None else None
    if None in roots.values() or len(set(roots.values())) != 1:
        found = ", ".join(f"{package} in {root or 'no folder'}" for package, root in roots.items())
        raise DaemonError(f"the packages do not belong together: {found}")


class _Supervisor:
    """Runs the main coroutine on a loop in another thread, and turns its end into an exit code."""

    def __init__(self, daemon: Daemon, main: Callable[[Daemon], Awaitable[None]], outbox: socket.socket) -> None:
        self.exit_code = 1
        self._daemon = daemon
        self._main = main
        self._outbox = outbox
        self._running = threading.Event()
        self._stopping = False
        self._broken: BaseException | None = None

    def start(self) -> None:
        """Start the thread; returns once the coroutine can be stopped."""
        threading.Thread(target=self._run, name="loop", daemon=True).start()
        self._running.wait()

    def stop(self, why: str) -> None:
        """Cancel the coroutine, from the main thread."""
        log.info("%s stopping: %s", self._daemon.name, why)
        with contextlib.suppress(RuntimeError):  # the loop has just closed: stopped already
            self._loop.call_soon_threadsafe(self._cancel)

    def _cancel(self) -> None:
        self._stopping = True
        self._task.cancel()

    def _run(self) -> None:
        try:
            with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
                self.exit_code = runner.run(self._supervise())
        finally:
            self._outbox.send(bytes([_LOOP_ENDED]))

    async def _supervise(self) -> int:
        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(self._on_callback_error)
        self._task = asyncio.ensure_future(self._main(self._daemon))
        self._running.set()
        try:
            await self._task
        except BaseException as error:
            failure = self._broken or error
            if not isinstance(failure, asyncio.CancelledError) or not self._stopping:
                _log_failure(self._daemon.name, failure)
                return 1
        finally:
            self._daemon.withdraw_readiness()
        log.info("%s stopped", self._daemon.name)
        return 0

    def _on_callback_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """An exception in a callback ends the daemon; by default it would be logged and forgotten."""
        error = context.get("exception")
        if error is None or self._task.done():
            loop.default_exception_handler(context)
        elif self._broken is None:
            self._broken = error
            self._task.cancel()


def _log_failure(name: str, error: BaseException) -> None:
    """The one line that says why; with a traceback unless the error is one the operator can act on."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]  # the first to fail; the others were cancelled because of it
    if isinstance(error, DaemonError):
        log.error("%s failed: %s", name, error)
    else:
        log.error("%s failed: %s", name, traceback.format_exception_only(error)[-1].strip(), exc_info=error)


def _leave_at_deadline(name: str, within_s: float) -> None:
    """End the process after ``within_s``, unless it has ended by then."""

    def give_up() -> None:
        log.error("%s: not stopped within %s s, leaving", name, within_s)
        faulthandler.dump_traceback()
        leave(1)

    timer = threading.Timer(within_s, give_up)
    timer.daemon = True
    timer.start()
    # Should C code hold the interpreter's lock, no Python thread runs any more; this one is none.
    faulthandler.dump_traceback_later(within_s + 0.1, exit=True)


def leave(exit_code: int) -> None:
    """End the process now: no destructors, no waiting for threads that may be anywhere in compiled code."""
    logging.shutdown()
    os._exit(exit_code)


def _notify_systemd(state: str) -> None:
    """Tell systemd, where it started us with ``Type=notify``."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel, contextlib.suppress(OSError):
        channel.sendto(state.encode("ascii"), "\0" + address[1:] if address.startswith("@") else address)
