"""A viewer that renders into arrays: what a person at the other end sees, for headless runs and benches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from common.body.link_points import SPLAT_RADIUS_M, LinkPoints
from common.body.live_surface import NO_OFFSET
from common.body.skinning import Skinning, animate
from common.geometry.camera_model import Camera
from common.geometry.point_splats import render_points
from common.geometry.rasterizer import render
from receiver.viewer.pose_blending import Picture, blended
from receiver.viewer.viewer import MovedPose, ShownFrame, ViewerStatus, ViewMode

if TYPE_CHECKING:
    from common.body.rigged_mesh import RiggedMesh

BACKGROUND = 255


class OffscreenViewer:
    """Keeps the poses, the points and the newest frame, as a page does, and renders one or the other when asked.

    ``render`` may be called from another thread than the rest. ``frames_shown`` counts the frames whose pose was
    there; ``status`` is the newest one.
    """

    def __init__(self, skinning: Skinning = "spherical", mode: ViewMode = "mesh") -> None:
        self._skinning: Skinning = skinning
        self._mode: ViewMode = mode
        self._points: LinkPoints | None = None
        self._newest: ShownFrame | None = None
        self._poses: dict[int, RiggedMesh] = {}
        # Replaced whole, so that threads see all of it or nothing.
        self._on_screen: tuple[ShownFrame, RiggedMesh, list[tuple[RiggedMesh, MovedPose]]] | None = None
        self.frames_shown = 0
        self.status = ViewerStatus()

    @property
    def frame(self) -> ShownFrame | None:
        """The frame on screen; None before the first whose pose is here, or before there are points."""
        if self._mode == "points":
            return None if self._points is None else self._newest
        return None if self._on_screen is None else self._on_screen[0]

    @property
    def newest(self) -> ShownFrame | None:
        """The frame shown last, whether it could be drawn or not."""
        return self._newest

    def add_pose(self, mesh: RiggedMesh) -> None:
        """Keeps the mesh until it is removed."""
        self._poses[mesh.pose_id] = mesh

    def remove_pose(self, pose_id: int) -> None:
        """Forgets the mesh; a frame that shows it goes off the screen."""
        self._poses.pop(pose_id, None)
        if self._on_screen is not None and self._on_screen[0].pose_id == pose_id:
            self._on_screen = None

    def show_points(self, points: LinkPoints | None) -> None:
        """The points to move from now on."""
        self._points = points

    def show(self, frame: ShownFrame) -> None:
        """The frame to render from now on, nobody if it has no pose; while its pose is not here the last one stays."""
        self._newest = frame
        if frame.pose_id is None:
            self._on_screen = None
        elif frame.withheld and self._on_screen is not None and self._on_screen[0].pose_id == frame.pose_id:
            self.frames_shown += 1  # the same picture again: its meshes do not follow where the links are now
        elif frame.pose_id in self._poses:
            others = [(self._poses[other.pose_id], other) for other in frame.others if other.pose_id in self._poses]
            self._on_screen = (frame, self._poses[frame.pose_id], others)
            self.frames_shown += 1

    def set_status(self, status: ViewerStatus) -> None:
        """Keeps the newest figures."""
        self.status = status

    def render(self, cameras: Sequence[Camera]) -> list[tuple[NDArray[np.uint8], NDArray[np.float32]]]:
        """The frame on screen seen by each camera: colour (H, W, 3) uint8 RGB on white, depth (H, W) float32 [m].

        Depth 0 = nothing there, which is everywhere while nobody is shown.
        """
        if self._mode == "points":
            return self._render_points(cameras)
        if (on_screen := self._on_screen) is None:
            return [_nobody(camera) for camera in cameras]
        frame, mesh, others = on_screen
        assert frame.motion is not None  # as its pose is not
        moved = [(mesh, frame.motion), *((other, pose.motion) for other, pose in others)]
        pictures = [self._render_pose(frame, *each, cameras) for each in moved]
        return [blended(of_one_camera) for of_one_camera in zip(*pictures, strict=True)]

    def _render_pose(
        self, frame: ShownFrame, mesh: RiggedMesh, motion: NDArray[np.float32], cameras: Sequence[Camera]
    ) -> list[Picture]:
        """One of the frame's poses, which may follow maps."""
        vertices = animate(mesh, motion, self._skinning)
        surface = next((surface for surface in frame.surfaces if surface.pose_id == mesh.pose_id), None)
        if self._mode != "live" or surface is None or frame.links is None:
            return [render(vertices, mesh.faces_drawn, mesh.mesh.surface, camera, BACKGROUND) for camera in cameras]
        moved, offsets = surface.follow(frame.links, mesh.vertex_link, vertices, frame.live)
        return [render_live(mesh, moved, offsets, camera) for camera in cameras]

    def _render_points(self, cameras: Sequence[Camera]) -> list[tuple[NDArray[np.uint8], NDArray[np.float32]]]:
        points, frame = self._points, self._newest
        if points is None or frame is None or frame.links is None:
            return [_nobody(camera) for camera in cameras]
        positions = points.posed(frame.links)
        return [render_points(positions, points.colours, camera, SPLAT_RADIUS_M, BACKGROUND) for camera in cameras]


def render_live(
    mesh: RiggedMesh, vertices: NDArray[np.float32], offsets: NDArray[np.uint8], camera: Camera
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour and depth as ``render``'s, of the texture with colour ``offsets`` (V, 3) about ``NO_OFFSET`` on it."""
    colour, depth = render(vertices, mesh.faces_drawn, mesh.mesh.surface, camera, BACKGROUND)
    offset, _ = render(vertices, mesh.faces_drawn, offsets, camera, NO_OFFSET)
    return np.clip(colour.astype(np.int16) + offset - NO_OFFSET, 0, 255).astype(np.uint8), depth


def _nobody(camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    size = (camera.height, camera.width)
    return np.full((*size, 3), BACKGROUND, np.uint8), np.zeros(size, np.float32)
