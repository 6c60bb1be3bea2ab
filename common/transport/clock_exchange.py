"""Exchanging times with the other host over the clock channel, for ``ClockOffset``."""

from __future__ import annotations

import struct

from common.runtime.clock import Clock
from common.transport.channel_query import ChannelQueryable, ask
from common.transport.channels import CLOCK
from common.transport.clock_offset import ClockOffset
from common.transport.zenoh_session import ZenohSession
from common.wire.header import TIME_MAX_NS

_TIME = struct.Struct("<Q")


def serve_clock(session: ZenohSession, key: str, clock: Clock) -> ChannelQueryable:
    """Answer whoever asks under ``key`` with the time of ``clock`` [ns, u64]."""
    return ChannelQueryable(session, CLOCK, key, lambda _: _TIME.pack(clock.now_ns()))


async def exchange_times(
    session: ZenohSession, key: str, clock: Clock, offset: ClockOffset, timeout_s: float = 1.0
) -> bool:
    """Ask once for the time served under ``key`` and add the exchange to ``offset``; False when nothing came of it."""
    t0_ns = clock.now_ns()
    answers = await ask(session, CLOCK, key, timeout_s=timeout_s)
    t3_ns = clock.now_ns()
    if len(answers) != 1 or len(answers[0]) != _TIME.size:
        return False
    (there_ns,) = _TIME.unpack(answers[0])
    return there_ns <= TIME_MAX_NS and offset.add(t0_ns, there_ns, there_ns, t3_ns)
