"""A receiver's animation path in real time: 30 skeletons a second, a full repository, and a new pose every second.

As in its daemon, poses are meshed on one thread and chosen and moved on another, in one process.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import cycle

from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.body.skinning import animate
from common.body.surface_normals import vertex_normals
from common.runtime.clock import Clock
from common.runtime.stage_timer import StageStatistics, StageTimer
from common.wire.skeleton_packet import SkeletonPacket
from receiver.config import RepositorySettings
from receiver.pipeline import AnimationPath, ReceivedPose, SkeletonToShow, mesh_of

RATE_HZ = 30
POSE_EVERY = RATE_HZ  # frames
_EPOCH, _PERIOD_NS = 1, 10**9 // RATE_HZ


class ThreadClock:
    """The calling thread's own time on a core: what else the machine does is not in it."""

    def now_ns(self) -> int:
        return time.thread_time_ns()


@dataclass(frozen=True, slots=True)
class LiveFigures:
    """``stages``: "selection", "animate" (skinning and normals) and "mesh" (a pose decoded and meshed beside them).
    ``shown_hz``: frames chosen and moved in their time; ``poses``: in the repository at the end."""

    stages: dict[str, StageStatistics]
    shown_hz: float
    poses: int


def played_live(
    meshes: Sequence[RiggedMesh],
    motion: Sequence[tuple[Skeleton, SkeletonPose]],
    messages: Sequence[bytes],
    poses: int,
    seconds: float,
    clock: Clock,
) -> LiveFigures:
    """Show ``motion`` again and again for so many ``seconds`` from a repository of ``poses``, those of ``meshes`` again
    and again; ``messages``, candidate poses of other ids, come in one after the other. ``clock``: what stages are timed
    by."""
    frames = int(seconds * RATE_HZ)
    timer = StageTimer(clock, frames)
    settings = RepositorySettings(poses=poses, equal_share=0.0, search_ms=1000.0)  # none is replaced, none pruned
    path = AnimationPath(settings, timer, clock)
    held = {n: replace(meshes[n % len(meshes)], pose_id=n) for n in range(poses)}
    arrived = deque(ReceivedPose(_EPOCH, mesh) for mesh in held.values())
    path.show(_newest(0, *motion[0], arrived))
    coming, shown, left_out, count = cycle(messages), 0, 0, poses
    with ThreadPoolExecutor(1) as mesher:
        meshing: Future[ReceivedPose] | None = None
        begin_ns = time.monotonic_ns()
        for k in range(frames):
            due_ns = begin_ns + k * _PERIOD_NS
            time.sleep(max(due_ns - time.monotonic_ns(), 0) / 1e9)
            if time.monotonic_ns() > due_ns + _PERIOD_NS:  # the next skeleton is there already
                left_out += 1
                continue
            if meshing is None and k % POSE_EVERY == 0:
                meshing = mesher.submit(_meshed, next(coming), timer)
            elif meshing is not None and meshing.done():
                arrived.append(ReceivedPose(_EPOCH, meshing.result().mesh))
                meshing = None
            result = path.show(_newest(k + 1, *motion[k % len(motion)], arrived))
            held.update((mesh.pose_id, mesh) for mesh in result.added)
            count = result.repository_poses
            frame = result.frame
            with timer.stage("animate"):
                assert frame.pose_id is not None
                assert frame.motion is not None
                mesh = held[frame.pose_id]
                vertex_normals(animate(mesh, frame.motion), mesh.faces_drawn)
            shown += 1
        wall_s = max(time.monotonic_ns() - begin_ns, frames * _PERIOD_NS) / 1e9
    return LiveFigures(timer.statistics(), shown / wall_s, count)


def _meshed(message: bytes, timer: StageTimer) -> ReceivedPose:
    with timer.stage("mesh"):
        return mesh_of(message, 0)


def _newest(sequence: int, body: Skeleton, pose: SkeletonPose, arrived: deque[ReceivedPose]) -> SkeletonToShow:
    packet = SkeletonPacket(0, _EPOCH, sequence, sequence * _PERIOD_NS, 0, 1.0, pose)
    return SkeletonToShow(packet, body, arrived)
