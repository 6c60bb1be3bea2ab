"""Residual packets and candidate poses beside skeletons over a simulated path, in virtual time: the real choice,
window, sender and chunks; only what is in the packets is made up, as large as measured.

A frame of 10 000 points takes 8.9 KB at 100 % and less as level^0.7 (``sender/residual_encoder.py``).
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Hashable
from dataclasses import dataclass

from common.transport.bulk_sender import PERIOD_NS, BulkMessage, BulkSender
from scripts.bulk_simulation import EPOCH, BulkSimulation, S
from scripts.link_model import LinkConditions
from sender.candidate_poses.mesh_scheduler import MeshScheduler
from sender.candidate_poses.usable_pose_set import Quotients
from sender.outgoing_bulk import Outgoing, OutgoingBulk
from sender.residual_encoder import LevelControl
from sender.residual_path import Residual

FULL_BYTES, EXPONENT = 8900, 0.7
KEY_SHARE = 1.3  # a key is so much larger than a difference
POSE_BYTES, POSE_EVERY_S = 50_000, 0.2
FRAME_RATE_HZ = 30
SMOOTHING = 1 / FRAME_RATE_HZ  # of the budget, as the sender's second
_STAMP = struct.Struct("<IIq")


@dataclass(frozen=True, slots=True)
class Arrived:
    """A residual packet: its number, that of the key it needs, when it was made and when it came [ns]."""

    sequence: int
    key: int
    made_ns: int
    came_ns: int


class ResidualSimulation(BulkSimulation):
    """``poses``: there are new ones all the time. ``residuals``: those that came; ``levels``: of those made."""

    def __init__(self, there: LinkConditions, poses: bool = True, share: float = 0.5) -> None:
        super().__init__(there)
        self.poses = poses
        self.pose_bytes = 0
        self.residuals: list[Arrived] = []
        self.levels: list[float] = []
        scheduler = MeshScheduler()
        scheduler.receiver_joined("there", 1)
        self.choice = OutgoingBulk("there", scheduler, lambda _: None, share)
        self.choice.wants_residuals = True
        self.sender = BulkSender(
            self, self.window, EPOCH, self._next_message, self._on_delivered, self.loop, self._next_urgent
        )
        self._scheduler = scheduler
        self._key: tuple[int, float, int] | None = None  # sequence, level, when made

    async def _run(self, seconds: float) -> None:
        parts = self.sender.run(), self._send_skeletons(), self._report(), self._make_poses(), self._make_residuals()
        tasks = [self.loop.create_task(part) for part in parts]
        await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_EXCEPTION)
        for task in tasks:
            if task.done():
                task.result()

    async def _make_poses(self) -> None:
        number = 0
        while True:
            if self.poses:
                number += 1
                self._scheduler.offer(number, bytes([number % 256]) * POSE_BYTES, number, Quotients({number: 0.5}))
                self.sender.wake()
            await asyncio.sleep(POSE_EVERY_S)

    async def _make_residuals(self) -> None:
        control, sequence, smoothed = LevelControl(), 0, None
        while True:
            now_ns = self.loop.now_ns()
            budget = self.choice.residual_bytes_s(self.window.allowed_bytes_s, now_ns)
            smoothed = budget if smoothed is None else smoothed + (budget - smoothed) * SMOOTHING
            level = control.level(smoothed / FRAME_RATE_HZ)
            if level > 0:
                self._make_one(sequence, level, now_ns, control)
                sequence += 1
            await asyncio.sleep(1 / FRAME_RATE_HZ)

    def _make_one(self, sequence: int, level: float, now_ns: int, control: LevelControl) -> None:
        key = self._key
        if key is None or now_ns - key[2] > 0.95 * S or not 1 / 1.1 < level / key[1] < 1.1 or self.choice.needs_key:
            key = self._key = sequence, level, now_ns
        size = FULL_BYTES * (key[1] / 100) ** EXPONENT * (KEY_SHARE if key[0] == sequence else 1.0)
        data = _STAMP.pack(sequence, key[0], now_ns) + bytes(int(size))
        control.coded(key[1], len(data))
        self.levels.append(key[1])
        self.choice.offer(Residual(sequence, key[0], data, key[1]))
        self.sender.wake()

    def _next_message(self, budget_bytes: int) -> BulkMessage | None:
        return _message(self.choice.next_message(budget_bytes * S // PERIOD_NS, self.loop.now_ns()))

    def _next_urgent(self) -> BulkMessage | None:
        return _message(self.choice.next_urgent())

    def _on_delivered(self, name: Hashable) -> None:
        self.delivered.append(name)

    def _on_message(self, message: bytes, now_ns: int) -> None:
        if len(message) == POSE_BYTES:
            self.pose_bytes += len(message)
        else:
            sequence, key, made_ns = _STAMP.unpack_from(message)
            self.residuals.append(Arrived(sequence, key, made_ns, now_ns))

    def shown(self, begin_s: float) -> list[Arrived]:
        """Those that came since ``begin_s`` and could be shown: the key was there, and no later one was."""
        keys, newest, shown = set(), -1, []
        for residual in self.residuals:
            if residual.key == residual.sequence:
                keys.add(residual.sequence)
            if residual.sequence > newest and residual.key in keys:
                newest = residual.sequence
                if residual.came_ns >= begin_s * S:
                    shown.append(residual)
        return shown


def _message(chosen: Outgoing | None) -> BulkMessage | None:
    if chosen is None:
        return None
    return BulkMessage(chosen.name, chosen.payload, chosen.supersedes, chosen.urgent)


def main() -> None:
    """Print what gets through at several rates."""
    print("Mbit/s  poses  level %  frames/s shown  age ms (median, p95)  skeleton over idle p99 ms  used Mbit/s")
    for poses in (True, False):
        for mbit in (0.25, 0.5, 1, 2, 4, 10):
            run = ResidualSimulation(LinkConditions(mbit * 1e6, delay_ms=25), poses)
            run.run(20)
            shown = run.shown(8)
            ages = sorted((one.came_ns - one.made_ns) / 1e6 for one in shown) or [float("nan")]
            levels = run.levels[len(run.levels) // 2 :] or [0.0]
            print(
                f"{mbit:6} {poses!s:>6} {sum(levels) / len(levels):8.1f} {len(shown) / 12:15.1f} "
                f"{ages[len(ages) // 2]:10.0f} {ages[int(len(ages) * 0.95)]:9.0f} {run.over_idle_ms(8, 20):20.1f} "
                f"{run.goodput_bps(8, 20) / 1e6:17.2f}"
            )


if __name__ == "__main__":
    main()
