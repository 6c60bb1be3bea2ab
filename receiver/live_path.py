"""The live surface on the receiver: the mesh on screen follows the newest residual maps (Lien §5.2, ``live_surface``).

What maps show beyond a mesh is worked out at once when the mesh on screen is another, so that a switch goes from one
mesh that looks like the maps to another; else a few times a second at most, as maps lie in the links' own frames and
age little. It comes and goes within a moment: maps that have stopped leave the mesh its own texture.
"""

from __future__ import annotations

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


class LivePath:
    """One person's. Time is the sender's, in which maps and skeletons were captured; ``note_maps`` may be called from
    another thread than the rest."""

    def __init__(self, timer: StageTimer) -> None:
        self._timer = timer
        self._maps: ResidualMaps | None = None
        self._surface: tuple[LiveSurface, ResidualMaps] | None = None  # and the maps it is of
        self._made_ns = 0
        self._colours: tuple[int, NDArray[np.uint8]] | None = None  # of the vertices of the pose with that id
        self._strength, self._strength_ns = 0.0, 0

    def note_maps(self, maps: ResidualMaps | None) -> None:
        """The maps to follow from now on; None: none."""
        self._maps = maps

    def forget(self) -> None:
        """Pose ids begin anew."""
        self._surface = self._colours = None
        self._strength = 0.0

    def surface(
        self, mesh: RiggedMesh, motion: NDArray[np.float32], T_world_link: NDArray[np.float32], epoch: int, now_ns: int
    ) -> tuple[LiveSurface | None, float]:
        """What ``mesh``, moved by ``motion`` (L, 3, 4) to ``T_world_link`` (L, 4, 4), is to follow, and how much of it:
        0..1. ``epoch`` and capture time ``now_ns`` are the skeleton's."""
        maps = self._maps
        fresh = maps is not None and maps.header.epoch == epoch and abs(now_ns - maps.header.capture_ns) < STALE_NS
        strength = self._faded(fresh, now_ns)
        if not fresh:
            maps = None if self._surface is None else self._surface[1]  # those it fades out with
        if maps is None or strength <= 0:
            self._surface = None
            return None, 0.0
        if self._is_due(mesh, maps, now_ns):
            with self._timer.stage("live surface"):
                self._surface = self._made(mesh, motion, T_world_link, maps), maps
            self._made_ns = now_ns
        assert self._surface is not None
        return self._surface[0], strength

    def _faded(self, fresh: bool, now_ns: int) -> float:
        passed_ns, self._strength_ns = max(now_ns - self._strength_ns, 0), now_ns
        step = min(passed_ns / FADE_NS, 1.0)
        self._strength = min(max(self._strength + (step if fresh else -step), 0.0), 1.0)
        return self._strength

    def _is_due(self, mesh: RiggedMesh, maps: ResidualMaps, now_ns: int) -> bool:
        if self._surface is None or self._surface[0].pose_id != mesh.pose_id:
            return True
        return self._surface[1] is not maps and now_ns - self._made_ns >= PERIOD_NS

    def _made(
        self, mesh: RiggedMesh, motion: NDArray[np.float32], T_world_link: NDArray[np.float32], maps: ResidualMaps
    ) -> LiveSurface:
        if self._colours is None or self._colours[0] != mesh.pose_id:
            self._colours = mesh.pose_id, vertex_colours(mesh.mesh)
        vertices, colours = animate(mesh, motion), self._colours[1]
        grid = at_level(maps, min(maps.header.level, LEVEL_MOST))
        return live_surface(mesh.pose_id, *grid, T_world_link, mesh.vertex_link, vertices, colours)
