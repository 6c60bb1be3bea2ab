"""The screen of a headless receiver: at every display tick the newest frame is rendered, on a thread of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.body.skinning import Skinning
from common.geometry.camera_model import Camera
from common.geometry.rigid_transform import look_at
from common.runtime.compute_worker import ComputeWorker
from common.runtime.stage_timer import StageTimer
from receiver.viewer.offscreen_viewer import OffscreenViewer
from receiver.viewer.viewer import ShownFrame, ViewerStatus, ViewMode

if TYPE_CHECKING:
    from common.body.link_points import LinkPoints
    from common.body.rigged_mesh import RiggedMesh


def front_camera() -> Camera:
    """640×480, from the front, wide enough for a person with raised arms."""
    pose = look_at(np.array([0.0, 1.2, 3.5]), np.array([0.0, 1.0, 0.0]))
    return Camera("front", 640, 480, 560.0, 560.0, 319.5, 239.5, pose)


class HeadlessScreen:
    """A ``Viewer`` that renders what it is shown. All methods are the loop's. ``frames_rendered`` counts;
    ``wants_points``: it has a use for points; ``wants_live``: for what maps show beyond a mesh;
    ``wants_poses``: for meshes."""

    def __init__(
        self,
        timer: StageTimer,
        camera: Camera | None = None,
        skinning: Skinning = "spherical",
        mode: ViewMode = "mesh",
    ) -> None:
        self.frames_rendered = 0
        self.wants_points, self.wants_live, self.wants_poses = mode == "points", mode == "live", mode != "points"
        self._camera = camera or front_camera()
        self._timer = timer
        self._viewer = OffscreenViewer(skinning, mode)
        self._rendered: ShownFrame | None = None
        self._renderer = ComputeWorker("render", self._render, self._on_rendered, background=True)

    def add_pose(self, mesh: RiggedMesh) -> None:
        """Keeps the mesh until it is removed."""
        self._viewer.add_pose(mesh)

    def remove_pose(self, pose_id: int) -> None:
        """Forgets the mesh."""
        self._viewer.remove_pose(pose_id)

    def show_points(self, points: LinkPoints | None) -> None:
        """The points to move from the next tick on."""
        self._viewer.show_points(points)

    def show(self, frame: ShownFrame) -> None:
        """The frame to render at the next tick."""
        self._viewer.show(frame)

    def set_status(self, status: ViewerStatus) -> None:
        """Keeps the newest figures."""
        self._viewer.set_status(status)

    def tick(self) -> None:
        """A display tick: render, unless nothing new is there or the last picture is not finished."""
        frame = self._viewer.frame
        if frame is not None and frame is not self._rendered:
            self._rendered = frame
            self._renderer.submit(frame)

    async def run(self) -> None:
        """Render until cancelled."""
        await self._renderer.run()

    def _render(self, _: ShownFrame) -> None:
        with self._timer.stage("render"):
            self._viewer.render([self._camera])

    def _on_rendered(self, _: None) -> None:
        self.frames_rendered += 1
