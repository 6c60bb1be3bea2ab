"""A sender and a receiver killed (SIGKILL) at every chunk of a message: the next run has it whole, and nothing else."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

from common.transport.link_settings import LinkSettings
from common.transport.zenoh_session import open_session
from scripts.daemon_processes import free_port
from tests.mortal_runs import Run, digest_of, message_of, receive, send

ROOT = Path(__file__).parents[1]
LIMIT_S = 60.0


@pytest.fixture(scope="module")
def runs() -> Iterator[subprocess.Popen[str]]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command, pipe = [sys.executable, "-m", "tests.mortal_runs"], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment, cwd=ROOT) as process:
        yield process
        process.kill()


async def over(runs: subprocess.Popen[str], run: Run) -> tuple[int, list[str]]:
    """How a run ended, and the messages it had."""
    assert runs.stdin is not None
    assert runs.stdout is not None
    runs.stdin.write(json.dumps(asdict(run)) + "\n")
    runs.stdin.flush()
    async with asyncio.timeout(LIMIT_S):
        answer = json.loads(await asyncio.to_thread(runs.stdout.readline))
    return answer["status"], answer["whole"]


async def test_after_a_receiver_was_killed_at_any_chunk_the_next_one_has_the_message_whole(runs: subprocess.Popen[str]):
    port, message = free_port(), message_of(1)
    async with open_session(LinkSettings(listen=(f"tcp/127.0.0.1:{port}",))) as session:
        serving = asyncio.create_task(send(session, message, None, lambda: False))
        for chunk in itertools.count(1):
            status, whole = await over(runs, Run("receiver", port, chunk))
            if status == 0:
                break  # the message has no such chunk
            assert (status, whole) == (-signal.SIGKILL, [])
            assert await over(runs, Run("receiver", port, None)) == (0, [digest_of(message)])
        serving.cancel()
    assert whole == [digest_of(message)]
    assert chunk > 3


async def test_after_a_sender_was_killed_at_any_chunk_the_next_one_s_message_arrives_whole(runs: subprocess.Popen[str]):
    port, whole, seeds = free_port(), list[str](), itertools.count(1)
    lived: list[str] = []
    async with open_session(LinkSettings(listen=(f"tcp/127.0.0.1:{port}",))) as session:
        listening = asyncio.create_task(receive(session, None, whole, lambda: False))
        for chunk in itertools.count(1):
            killed, next_one = next(seeds), next(seeds)  # messages of the same id, of other bytes
            status, _ = await over(runs, Run("sender", port, chunk, killed))
            if status == 0:
                lived.append(digest_of(message_of(killed)))
                break  # the message has no such chunk
            assert status == -signal.SIGKILL
            assert (await over(runs, Run("sender", port, None, next_one)))[0] == 0
            lived.append(digest_of(message_of(next_one)))
        listening.cancel()
    # The last chunk was out when its sender was killed: that message may be whole as well.
    last_killed = digest_of(message_of(killed - 2))
    assert [digest for digest in whole if digest != last_killed] == lived
    assert chunk > 3
