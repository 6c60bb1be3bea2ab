"""The compute thread: latest input wins, results arrive on the loop, failures reach the owner, stopping is bounded."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress

import pytest

from common.runtime import compute_worker
from common.runtime.compute_worker import ComputeWorker


async def stop(task: asyncio.Task[None]) -> None:
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task
    assert task.cancelled()


async def test_results_are_delivered_on_the_loop() -> None:
    arrived: asyncio.Queue[tuple[int, int]] = asyncio.Queue()
    worker: ComputeWorker[int, int] = ComputeWorker(
        "w", lambda x: x * x, lambda y: arrived.put_nowait((y, threading.get_ident()))
    )
    task = asyncio.create_task(worker.run())
    worker.submit(3)
    assert await asyncio.wait_for(arrived.get(), 5) == (9, threading.get_ident())
    await stop(task)


async def test_the_latest_input_wins_and_the_others_are_counted() -> None:
    begun, release = threading.Event(), threading.Event()
    arrived: asyncio.Queue[int] = asyncio.Queue()

    def job(value: int) -> int:
        begun.set()
        assert release.wait(5)
        return value

    worker = ComputeWorker("w", job, arrived.put_nowait)
    task = asyncio.create_task(worker.run())
    worker.submit(1)
    await asyncio.to_thread(begun.wait, 5)
    for value in (2, 3, 4):
        worker.submit(value)
    release.set()
    assert [await asyncio.wait_for(arrived.get(), 5) for _ in range(2)] == [1, 4]
    assert worker.dropped == 2
    await stop(task)


async def test_at_most_one_result_waits_for_a_busy_loop() -> None:
    done: list[int] = []
    second_done = threading.Event()

    def job(value: int) -> int:
        done.append(value)
        if len(done) == 2:
            second_done.set()
        return value

    worker = ComputeWorker("w", job, lambda _: None)
    task = asyncio.create_task(worker.run())
    await worker.wait_ready()
    worker.submit(1)
    while not done:
        threading.Event().wait(0.001)  # the loop is held up here
    worker.submit(2)
    second_done.wait(5)
    worker.submit(3)
    worker.submit(4)
    threading.Event().wait(0.05)
    assert done == [1, 2]  # the result of 2 waits until the loop took that of 1
    await stop(task)


async def test_a_failing_job_fails_the_owner() -> None:
    def job(value: int) -> int:
        raise ArithmeticError(f"no root of {value}")

    worker = ComputeWorker("w", job, lambda _: None)
    worker.submit(-1)
    with pytest.raises(ArithmeticError, match="no root of -1"):
        await asyncio.wait_for(worker.run(), 5)


async def test_a_failing_delivery_fails_the_owner() -> None:
    def deliver(value: int) -> None:
        raise LookupError(f"nobody wants {value}")

    worker = ComputeWorker("w", int, deliver)
    worker.submit(5)
    with pytest.raises(LookupError, match="nobody wants 5"):
        await asyncio.wait_for(worker.run(), 5)


async def test_ready_only_after_the_warm_up() -> None:
    release = threading.Event()
    worker = ComputeWorker("w", int, lambda _: None, warm_up=lambda: release.wait(5))
    task = asyncio.create_task(worker.run())
    ready = asyncio.create_task(worker.wait_ready())
    await asyncio.sleep(0.02)
    assert not ready.done()
    release.set()
    await asyncio.wait_for(ready, 5)
    await stop(task)


async def test_a_failing_warm_up_ends_whoever_waits_in_the_same_group() -> None:
    def warm_up() -> None:
        raise ImportError("no kernels")

    worker: ComputeWorker[int, int] = ComputeWorker("w", int, lambda _: None, warm_up)

    async def owner() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(worker.run())
            group.create_task(worker.wait_ready())

    with pytest.raises(BaseExceptionGroup) as caught:
        await owner()
    assert caught.group_contains(ImportError, match="no kernels")


async def test_stopping_waits_for_the_job_under_way_and_delivers_nothing_more() -> None:
    begun, release = threading.Event(), threading.Event()
    delivered: list[int] = []

    def job(value: int) -> int:
        begun.set()
        release.wait(5)
        return value

    worker = ComputeWorker("w", job, delivered.append)
    task = asyncio.create_task(worker.run())
    worker.submit(1)
    await asyncio.to_thread(begun.wait, 5)
    task.cancel()
    await asyncio.sleep(0.02)
    assert not task.done()
    release.set()
    await stop(task)
    assert delivered == []


async def test_a_job_that_hangs_is_left_behind(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(compute_worker, "STOP_WITHIN_S", 0.05)
    begun, release = threading.Event(), threading.Event()

    def job(value: int) -> int:
        begun.set()
        release.wait(5)
        return value

    worker = ComputeWorker("slow", job, lambda _: None)
    task = asyncio.create_task(worker.run())
    worker.submit(1)
    await asyncio.to_thread(begun.wait, 5)
    await stop(task)
    assert "slow: the job under way did not end" in caplog.text
    release.set()
