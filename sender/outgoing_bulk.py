"""What goes to one receiver next when its link is free, by name and in bytes. Pure; one for each receiver.

The live sender asks with what its window allows, the encoder of a session with the rate it was given.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable

from sender.candidate_poses.mesh_scheduler import MeshScheduler, SendRecord


def pose_name(pose_id: int, preview: bool = False) -> tuple[str, int, bool]:
    """The name of a candidate pose on its way."""
    return "pose", pose_id, preview


def poses_in(names: Iterable[Hashable]) -> list[int]:
    """The ids of the whole candidate poses among the names."""
    return [name[1] for name in names if isinstance(name, tuple) and name == pose_name(name[1])]


class OutgoingBulk:
    """``on_sent`` is told of every candidate pose that goes out: whoever asks sees it through."""

    def __init__(self, receiver: str, scheduler: MeshScheduler, on_sent: Callable[[SendRecord], None]) -> None:
        self._receiver = receiver
        self._scheduler = scheduler
        self._on_sent = on_sent

    def next_message(self, budget_bytes: int, now_ns: int) -> tuple[Hashable, bytes] | None:
        """Name and payload of the next message, None: nothing is worth sending. ``budget_bytes``: a second's."""
        chosen = self._scheduler.next_for(self._receiver, budget_bytes, now_ns)
        if chosen is None:
            return None
        pose_id, payload = chosen
        record = self._scheduler.sent(self._receiver, pose_id, now_ns)
        if record is None:
            return None
        self._on_sent(record)
        return pose_name(pose_id, record.preview), payload
