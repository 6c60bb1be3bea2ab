"""The live surface on the receiver: the meshes on screen follow the newest residual maps (Lien §5.2, ``live_surface``).

What maps show beyond a mesh is worked out at once when it comes on screen, so that a switch goes from one mesh that
looks like the maps to another; else a few times a second at most, as maps lie in the links' own frames and age little,
and of one mesh a frame, the one that has waited longest. It comes and goes within a moment: maps that have stopped
leave meshes their own texture.
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


Moved = tuple[RiggedMesh, NDArray[np.float32]]  # a mesh and its links' motion (L, 3, 4)


@dataclass(slots=True, eq=False)
class _Following:
    """A mesh on screen: its vertices' colours, and what ``maps`` show beyond it, worked out at ``made_ns``."""

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
        self._following: dict[int, _Following] = {}  # by pose
        self._strength, self._strength_ns = 0.0, 0

    def note_maps(self, maps: ResidualMaps | None) -> None:
        """The maps to follow from now on; None: none."""
        self._maps = maps

    def forget(self) -> None:
        """Pose ids begin anew."""
        self._following = {}
        self._strength = 0.0

    def surfaces(
        self, poses: Sequence[Moved], T_world_link: NDArray[np.float32], epoch: int, now_ns: int
    ) -> tuple[tuple[LiveSurface, ...], float]:
        """What the meshes on screen, moved to ``T_world_link`` (L, 4, 4), are to follow, and how much of it: 0..1.
        ``epoch`` and capture time ``now_ns`` are the skeleton's."""
        maps = self._maps
        fresh = maps is not None and maps.header.epoch == epoch and abs(now_ns - maps.header.capture_ns) < STALE_NS
        strength = self._faded(fresh, now_ns)
        if fresh:
            self._followed = maps
        if self._followed is None or strength <= 0:
            self._following = {}
            return (), 0.0
        self._follow(poses, T_world_link, self._followed, now_ns)
        return tuple(following.surface for following in self._following.values()), strength

    def _faded(self, fresh: bool, now_ns: int) -> float:
        passed_ns, self._strength_ns = max(now_ns - self._strength_ns, 0), now_ns
        step = min(passed_ns / FADE_NS, 1.0)
        self._strength = min(max(self._strength + (step if fresh else -step), 0.0), 1.0)
        return self._strength

    def _follow(
        self, poses: Sequence[Moved], T_world_link: NDArray[np.float32], maps: ResidualMaps, now_ns: int
    ) -> None:
        """Makes what is missing, makes anew the oldest that is due, and forgets what is no more on screen."""
        before = self._following
        due = [mesh.pose_id for mesh, _ in poses if self._is_due(before.get(mesh.pose_id), maps, now_ns)]
        oldest = min(due, key=lambda pose_id: before[pose_id].made_ns, default=None)
        self._following = {}
        for mesh, motion in poses:
            last = before.get(mesh.pose_id)
            if last is None or mesh.pose_id == oldest:
                colours = vertex_colours(mesh.mesh) if last is None else last.colours
                with self._timer.stage("live surface"):
                    surface = _made(mesh, motion, colours, T_world_link, maps)
                last = _Following(colours, maps, now_ns, surface)
            self._following[mesh.pose_id] = last

    @staticmethod
    def _is_due(last: _Following | None, maps: ResidualMaps, now_ns: int) -> bool:
        return last is not None and last.maps is not maps and now_ns - last.made_ns >= PERIOD_NS


def _made(
    mesh: RiggedMesh,
    motion: NDArray[np.float32],
    colours: NDArray[np.uint8],
    T_world_link: NDArray[np.float32],
    maps: ResidualMaps,
) -> LiveSurface:
    grid = at_level(maps, min(maps.header.level, LEVEL_MOST))
    return live_surface(mesh.pose_id, *grid, T_world_link, mesh.vertex_link, animate(mesh, motion), colours)
