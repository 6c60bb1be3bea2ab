"""The chosen pose, moved to the newest skeleton: what a viewer shows (DISPOSE §5.1, A(M, S_in, S_out))."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.body.rigged_mesh import RiggedMesh
from common.body.skinning import animate_rigid, link_motion


@dataclass(frozen=True, slots=True, eq=False)
class AnimatedMesh:
    """A pose and how its links moved since its capture, ``motion`` (L, 3, 4) float32, world to world.

    That is all a page needs; ``vertices`` moves them here. ``repeated``: an earlier frame, shown once more.
    """

    mesh: RiggedMesh
    motion: NDArray[np.float32]
    repeated: bool = False

    def vertices(self) -> NDArray[np.float32]:
        """Animated vertices (V, 3) float32 [m, world]; their triangles are ``mesh.faces_drawn``."""
        return animate_rigid(self.mesh, self.motion)


class Animator:
    """Animates one person; remembers the last good frame for those that are withheld."""

    def __init__(self) -> None:
        self._last: AnimatedMesh | None = None

    def animate(self, mesh: RiggedMesh, T_world_link: NDArray[np.float32], withheld: bool = False) -> AnimatedMesh:
        """``mesh`` with its links at ``T_world_link`` (L, 4, 4) [m]; a ``withheld`` frame repeats the last good one
        (DISPOSE §8), if there is one."""
        if withheld and self._last is not None:
            return AnimatedMesh(self._last.mesh, self._last.motion, repeated=True)
        self._last = AnimatedMesh(mesh, link_motion(mesh, T_world_link))
        return self._last

    def forget(self) -> None:
        """Drop the last frame: its mesh left the repository, or a new run of the sender began."""
        self._last = None
