"""Packets become maps on a thread, and points if wanted; one that is behind shows the newest, and junk is counted."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import pytest

from common.runtime.clock import ManualClock
from common.runtime.stage_timer import StageTimer
from receiver.map_maker import WAITING, MapMaker
from receiver.pipeline import MapPath, NewMaps
from sender.residual_encoder import ResidualEncoder, ResidualSettings
from tests.posed_cloud import BODY
from tests.test_residual_stream import FRAME_NS, encoder, frame, sent

EPOCH = 9


class Made:
    """A maker with what it showed; ``go_on`` lets its thread work."""

    def __init__(self) -> None:
        self.shown: list[NewMaps] = []
        self.wants_points = True
        self.go_on = threading.Event()
        self.go_on.set()
        path = MapPath(0, StageTimer(ManualClock()))
        take = path.take

        def when_let(*arguments: object) -> list[NewMaps]:
            assert self.go_on.wait(10)
            return take(*arguments)  # type: ignore[arg-type]

        path.take = when_let  # type: ignore[method-assign]
        bodies = {EPOCH: {5: BODY}}
        self.maker = MapMaker(path, lambda epoch: bodies.get(epoch, {}), lambda: self.wants_points, self.shown.append)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


async def test_each_packet_is_shown_by_one_that_keeps_up():
    made = Made()
    running = asyncio.create_task(made.maker.run())
    for number, packet in enumerate(sent(encoder(), range(4))):
        made.maker.submit(packet)
        await until(lambda number=number: made.maker.made > number)
    assert len(made.shown) == 4
    points = made.shown[-1].points
    assert points is not None
    assert len(points) > 500
    made.wants_points = False
    made.maker.submit(sent(encoder(), range(5))[4])
    await until(lambda: made.maker.made == 5)
    assert made.shown[-1].points is None
    assert made.shown[-1].maps.header.sequence == 4
    running.cancel()
    made.maker.close()


async def test_one_that_is_behind_shows_the_newest_and_junk_is_counted():
    made = Made()
    packets = sent(encoder(), range(6))
    made.go_on.clear()
    running = asyncio.create_task(made.maker.run())
    made.maker.submit(packets[0])
    await asyncio.sleep(0.05)  # it is at work on the key
    for packet in packets[1:5]:
        made.maker.submit(packet)
    made.go_on.set()
    await until(lambda: made.maker.made == 2)
    assert made.maker.counts["overtaken"] == 3
    for packet in (b"junk" * 30, packets[5][:-1], packets[5]):
        made.maker.submit(packet)
    await until(lambda: made.maker.made == 3)
    assert made.maker.counts["refused"] == 2
    for _ in range(3 * WAITING):
        made.maker.submit(packets[1])
    await until(lambda: made.maker.counts["late"] >= 1)
    assert made.maker.counts["waiting too long"] == 2 * WAITING
    assert not running.done()
    running.cancel()
    made.maker.close()


async def test_a_group_is_shown_at_the_pace_it_was_captured_at_until_there_is_a_newer_one():
    pytest.importorskip("av")
    made = Made()
    ours = ResidualEncoder(0, EPOCH, ResidualSettings(points=3000, video_frames=6))
    first, second = (packet for k in range(12) if (packet := ours.encode(frame(k), 50.0)) is not None)
    running = asyncio.create_task(made.maker.run())
    made.maker.submit(b"\x73\x03" + first[2:-9])
    await until(lambda: made.maker.counts["refused"] == 1)
    made.maker.submit(first)
    await until(lambda: len(made.shown) == 1)
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    await until(lambda: len(made.shown) == 6)
    assert loop.time() - begun_s > 0.9 * 4 * FRAME_NS / 1e9
    made.maker.submit(second)
    await until(lambda: len(made.shown) == 7)
    third = [packet for k in range(12, 18) if (packet := ours.encode(frame(k), 50.0)) is not None]
    made.maker.submit(third[0])
    await until(lambda: any(new.maps.header.sequence == 17 for new in made.shown))
    shown = [new.maps.header.sequence for new in made.shown]
    assert shown[:7] == list(range(7))
    assert shown == sorted(shown)
    assert made.maker.made == 3
    running.cancel()
    made.maker.close()


async def test_packets_of_a_run_whose_body_is_unknown_give_nothing():
    made = Made()
    made.maker._bodies = lambda epoch: {}
    running = asyncio.create_task(made.maker.run())
    made.maker.submit(sent(encoder(), range(1))[0])
    await until(lambda: made.maker.counts["without reference"] == 1)
    assert made.shown == []
    running.cancel()
    made.maker.close()
