"""Candidate poses into meshes beside the loop."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import numpy as np
import pytest

from common.body.mannequin import mannequin, mannequin_camera, mannequin_depth
from common.body.view import View
from common.runtime.clock import MonotonicClock
from common.runtime.stage_timer import StageTimer
from common.wire.candidate_pose import CandidatePose, encode_candidate_pose
from receiver.pose_maker import PoseMaker


def message() -> bytes:
    skeleton, pose = mannequin()
    depth = mannequin_depth(mannequin_camera())
    view = View(mannequin_camera(), 0, 0, depth, np.full((*depth.shape, 3), 128, np.uint8))
    return encode_candidate_pose(CandidatePose(1, 0, 7, 0, skeleton, pose, (view,)))


async def done(maker: PoseMaker) -> None:
    async with asyncio.timeout(60):
        while maker.in_hand:  # noqa: ASYNC110
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("good", [True, False])
async def test_a_pose_is_in_hand_until_it_is_taken_or_refused(good: bool) -> None:
    ready = asyncio.Event()
    maker = PoseMaker(0, "joining-edges", StageTimer(MonotonicClock()), ready.set)
    assert not maker.in_hand
    running = asyncio.create_task(maker.run())
    try:
        maker.submit(message() if good else b"no pose")
        assert maker.in_hand
        if good:
            await asyncio.wait_for(ready.wait(), 60)
            assert maker.in_hand
            assert maker.meshes.popleft().mesh.pose_id == 1
        await done(maker)
        assert maker.counts["pose refused"] == (not good)
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running
        maker.close()


async def test_what_waits_too_long_is_not_in_hand() -> None:
    maker = PoseMaker(0, "joining-edges", StageTimer(MonotonicClock()), lambda: None)
    for _ in range(20):
        maker.submit(b"no pose")
    assert maker.counts["pose waiting too long"] == 12
    running = asyncio.create_task(maker.run())
    await done(maker)
    running.cancel()
    maker.close()
