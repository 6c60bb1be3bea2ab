"""An event loop whose time is virtual: it never waits, so that minutes of asyncio code pass in seconds, always alike.

Timers fire in order, each at exactly its time. For code that waits only for timers and events: sockets, threads and
processes know nothing of virtual time.
"""

from __future__ import annotations

import asyncio
import contextlib
import selectors
from collections.abc import Coroutine, Mapping
from typing import Any, TypeVar

Result = TypeVar("Result")


class Deadlock(Exception):
    """Every task waits for something that no timer will bring about."""


class _NoWaiting(selectors.DefaultSelector):
    """Advances the time by what the loop wanted to wait."""

    def __init__(self) -> None:
        super().__init__()
        self.time_ns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            raise Deadlock("no timer is set, and nothing else can happen in virtual time")
        self.time_ns += max(0, round(timeout * 1e9))
        ready: list[tuple[selectors.SelectorKey, int]] = super().select(0)
        return ready


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """As a clock it has ``now_ns``."""

    def __init__(self) -> None:
        self._no_waiting = _NoWaiting()
        super().__init__(self._no_waiting)

    def time(self) -> float:
        return self._no_waiting.time_ns / 1e9

    def now_ns(self) -> int:
        return self._no_waiting.time_ns

    def at(self, when_ns: int, action: Any, *arguments: object) -> asyncio.TimerHandle:
        """Call ``action`` at a time; what is past is called at once."""
        return self.call_at(when_ns / 1e9, action, *arguments)


def run_virtually(main: Coroutine[Any, Any, Result], loop: VirtualTimeLoop) -> Result:
    """Run to the end, then cancel whatever else still runs on the loop, raising what it raised."""
    errors: list[BaseException] = []

    def note(_: asyncio.AbstractEventLoop, context: Mapping[str, Any]) -> None:
        error = context.get("exception")
        errors.append(error if isinstance(error, BaseException) else RuntimeError(str(context["message"])))

    async def run_and_clear_up() -> Result:
        try:
            return await main
        finally:
            rest = asyncio.all_tasks() - {asyncio.current_task()}
            for task in rest:
                task.cancel()
            errors.extend(e for e in await asyncio.gather(*rest, return_exceptions=True) if isinstance(e, Exception))

    loop.set_exception_handler(note)
    task = loop.create_task(run_and_clear_up())
    try:
        try:
            result = loop.run_until_complete(task)
        except Deadlock:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                loop.run_until_complete(task)
            raise
        if errors:
            raise errors[0]
        return result
    finally:
        loop.close()
