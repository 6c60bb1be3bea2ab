"""Questions and answers: what is asked for now and then, such as the body by a late joiner, and is not published."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass

import zenoh
from zenoh.handlers import Callback

from common.transport.channels import ANY, Channel
from common.transport.zenoh_session import ZenohSession
from common.wire.header import WireError

REPLIES_MAX = 16  # of one question: a hostile peer may send any number


@dataclass(frozen=True, slots=True)
class Question:
    """``key``: under which it is asked, which says who asks where each receiver has its own."""

    key: str
    payload: bytes


class ChannelQueryable:
    """Answers questions under ``key`` (an expression, perhaps) with ``answer(question)``, called on the loop; None: no
    answer.

    At most ``channel.keep`` questions wait for the loop; more are dropped unanswered and counted in ``dropped``. A
    ``WireError`` raised by ``answer`` means a malformed question, counted in ``malformed``.
    """

    def __init__(
        self, session: ZenohSession, channel: Channel, key: str, answer: Callable[[Question], bytes | None]
    ) -> None:
        self.answered = 0
        self.dropped = 0
        self.malformed = 0
        self._session = session
        self._channel = channel
        self._key = key
        self._answer = answer
        self._lock = threading.Lock()
        self._waiting = 0
        self._queryable = session.declare(
            lambda session: session.declare_queryable(key, Callback(self._asked, indirect=False), complete=True)
        )

    def close(self) -> None:
        self._queryable.undeclare()

    def _asked(self, query: zenoh.Query) -> None:
        payload = query.payload
        too_large = payload is not None and len(payload) > self._channel.max_bytes
        with self._lock:
            refused = too_large or self._waiting >= self._channel.keep
            if refused:
                self.dropped += 1
            else:
                self._waiting += 1
        if refused:
            query.drop()  # type: ignore[no-untyped-call]
        else:
            self._session.on_loop(self._reply, query, payload.to_bytes() if payload is not None else b"")

    def _reply(self, query: zenoh.Query, payload: bytes) -> None:
        with self._lock:
            self._waiting -= 1
        key = str(query.key_expr)
        if ANY not in self._key:
            key = self._key
        with query:
            if ANY in key:  # asked of nobody in particular
                self.malformed += 1
                return
            try:
                reply = self._answer(Question(key, payload))
            except WireError:
                self.malformed += 1
                return
            if reply is not None:
                if len(reply) > self._channel.max_bytes:
                    raise ValueError(f"{self._channel.name}: an answer of {len(reply)} bytes")
                query.reply(key, reply)
                self.answered += 1


async def ask(
    session: ZenohSession, channel: Channel, key: str, payload: bytes = b"", timeout_s: float = 1.0
) -> list[bytes]:
    """Everyone's answers to a question, empty when nobody answered within ``timeout_s``. Oversized ones are left out.

    Raises:
        ValueError: a question larger than the channel carries.
    """
    if len(payload) > channel.max_bytes:
        raise ValueError(f"{channel.name}: a question of {len(payload)} bytes")
    answers: list[bytes] = []
    done = asyncio.Event()

    def replied(reply: zenoh.Reply) -> None:
        sample = reply.ok
        if sample is not None and len(sample.payload) <= channel.max_bytes and len(answers) < REPLIES_MAX:
            answers.append(sample.payload.to_bytes())

    cancellation = zenoh.CancellationToken()
    session.zenoh.get(
        key,
        Callback(replied, drop=lambda: session.on_loop(done.set), indirect=False),
        payload=payload,
        timeout=timeout_s,
        priority=channel.priority,
        congestion_control=zenoh.CongestionControl.DROP,
        express=channel.express,
        cancellation_token=cancellation,
    )
    try:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s + 0.5):  # Zenoh's own timeout ends it; this one is for certainty
                await done.wait()
    finally:
        cancellation.cancel()  # type: ignore[no-untyped-call]
    return answers
