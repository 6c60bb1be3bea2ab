"""The live surface on the receiver: the meshes on screen follow the newest residual maps (Lien §5.2, ``live_surface``).

What maps show beyond the best mesh is worked out at once when it comes on screen, so that a switch goes from one mesh
that looks like the maps to another. Else one mesh a frame at most is worked out, on whose thread a skeleton waits: one
that has none yet, else the one that has waited longest, each a few times a second, as maps lie in the links' own frames
and age little. It comes and goes within a moment: maps that have stopped leave meshes their own texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.body.live_surface import LiveSurface, live_surface, vertex_colours
from common.body.rigged_mesh import RiggedMesh
from common.body.skinning import animate
from common.runtime.stage_timer import StageTimer
from receiver.residual_decoder import ResidualMaps, at_level

PERIOD_NS = 100_000_000  # for one and the same mesh
LEVEL_MOST = 25.0  # %, of the grids: 2 cm, below which maps are noise; bounds what a page is sent
FADE_NS = 300_000_000
STALE_NS = 1_000_000_000
KEPT_NS = 1_000_000_000  # after it was made, for a mesh that is not on screen


Moved = tuple[RiggedMesh, NDArray[np.float32]]  # a mesh and its links' motion (L, 3, 4)


@dataclass(frozen=True, slots=True, eq=False)
class _Following:
    """A ``mesh``, its vertices' colours, and what ``maps`` show beyond it, worked out at ``made_ns``."""

    mesh: RiggedMesh
    colours: NDArray[np.uint8]
    maps: ResidualMaps
    made_ns: int
    surface: LiveSurface


class LivePath:
    """One person's. Time is the sender's, in which maps and skeletons were captured; ``note_maps`` may be called from
    another thread than the rest."""

    def __init__(self, timer: StageTimer) -> None:
        self._timer = timer
        self._maps: ResidualMaps | None = None
        self._followed: ResidualMaps | None = None  # the last ones: with them it fades out
        self._following: dict[int, _Following] = {}  # by pose, and a while after it has left the screen
        self._strength, self._strength_ns = 0.0, 0

    def note_maps(self, maps: ResidualMaps | None) -> None:
        """The maps to follow from now on; None: none."""
        self._maps = maps

    def forget(self) -> None:
        """Pose ids begin anew."""
        self._following = {}
        self._followed = None
        self._strength = 0.0

    def surfaces(
        self, poses: Sequence[Moved], T_world_link: NDArray[np.float32], epoch: int, now_ns: int
    ) -> tuple[tuple[LiveSurface, ...], float]:
        """What the meshes on screen, the best one first, moved to ``T_world_link`` (L, 4, 4), are to follow, in their
        order, and how much of it: 0..1. A mesh that has just come may lack it for some frames, never the first one.
        ``epoch`` and capture time ``now_ns`` are the skeleton's."""
        maps = self._maps
        fresh = maps is not None and maps.header.epoch == epoch and abs(now_ns - maps.header.capture_ns) < STALE_NS
        strength = self._faded(fresh, now_ns)
        if fresh:
            self._followed = maps
        if self._followed is None or strength <= 0:
            self._following = {}
            return (), 0.0
        known = self._kept(poses, now_ns)
        chosen = self._chosen(poses, known, self._followed, now_ns)
        if chosen is not None:
            mesh, motion = poses[chosen]
            last = known.get(mesh.pose_id)
            colours = vertex_colours(mesh.mesh) if last is None else last.colours
            with self._timer.stage("live surface"):
                surface = _made(mesh, motion, colours, T_world_link, self._followed)
            known[mesh.pose_id] = _Following(mesh, colours, self._followed, now_ns, surface)
        self._following = known
        return tuple(known[mesh.pose_id].surface for mesh, _ in poses if mesh.pose_id in known), strength

    def _faded(self, fresh: bool, now_ns: int) -> float:
        passed_ns, self._strength_ns = max(now_ns - self._strength_ns, 0), now_ns
        step = min(passed_ns / FADE_NS, 1.0)
        self._strength = min(max(self._strength + (step if fresh else -step), 0.0), 1.0)
        return self._strength

    def _kept(self, poses: Sequence[Moved], now_ns: int) -> dict[int, _Following]:
        """What is known of meshes on screen, and of others that may soon be back; an id may stand for another mesh."""
        on_screen = {mesh.pose_id: mesh for mesh, _ in poses}
        return {
            pose_id: last
            for pose_id, last in self._following.items()
            if (on_screen[pose_id] is last.mesh if pose_id in on_screen else now_ns - last.made_ns < KEPT_NS)
        }

    @staticmethod
    def _chosen(poses: Sequence[Moved], known: dict[int, _Following], maps: ResidualMaps, now_ns: int) -> int | None:
        """Which mesh to work out in this frame: the first that has nothing yet, else the oldest that is due."""
        ages = [known.get(mesh.pose_id) for mesh, _ in poses]
        due = [
            (now_ns - last.made_ns, -n)
            for n, last in enumerate(ages)
            if last is not None and last.maps is not maps and now_ns - last.made_ns >= PERIOD_NS
        ]
        return ages.index(None) if None in ages else -max(due)[1] if due else None


def _made(
    mesh: RiggedMesh,
    motion: NDArray[np.float32],
    colours: NDArray[np.uint8],
    T_world_link: NDArray[np.float32],
    maps: ResidualMaps,
) -> LiveSurface:
    grid = at_level(maps, min(maps.header.level, LEVEL_MOST))
    return live_surface(mesh.pose_id, *grid, T_world_link, mesh.vertex_link, animate(mesh, motion), colours)
