"""DISPOSE with a live surface: the chosen meshes follow residual maps that share its link (``live_surface``).

A fixed share of the link carries maps, at the level that fills it; nothing below ``LEAST_BPS``, where candidate poses
need every byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from common.body.live_surface import NO_OFFSET, live_surface, vertex_colours
from common.body.rigged_mesh import RiggedMesh
from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.body.skinning import animate
from common.geometry.camera_model import Camera
from common.wire.body_message import quantized_skeleton
from common.wire.residual_packet import decode_residual_header
from common.wire.skeleton_packet import quantized_pose
from receiver.live_path import Moved
from receiver.residual_decoder import ResidualDecoder, ResidualMaps
from receiver.viewer.offscreen_viewer import render_live
from receiver.viewer.pose_blending import blended
from scripts.capture_files import CapturedFrame
from scripts.fidelity import Picture
from scripts.fidelity_capture import FRAME_NS, FRAME_RATE_HZ
from scripts.fidelity_link import ByteLink
from scripts.fidelity_methods import Dispose, Screen, posed
from sender.pipeline import BODY_CHANGE_M
from sender.reconstruction.foreground_points import PointSampler
from sender.residual_encoder import LevelControl, ResidualEncoder, ResidualFrame, ResidualSettings

LEAST_BPS = 0.4e6
SHARE = 0.1  # of the link, for maps: at 0.5, 1 and 3 Mbit/s better than 0.2, which better than 0.4
FRAMES_PER_MAP = 4  # finer maps more seldom: they lie in the links' frames and age little
POINTS, VOXEL_M = 10_000, 0.012
Followed = Literal["shape", "colour", "both"]


class DisposeLive(Dispose):
    """``Dispose`` on what the maps leave of the link; what it shows follows them."""

    def __init__(self, rate_bps: float, own: bool, followed: Followed = "both", share: float = SHARE) -> None:
        share = share if rate_bps >= LEAST_BPS else 0.0
        super().__init__(rate_bps * (1 - share), own)
        self._followed = followed
        self._maps_link = ByteLink(rate_bps * share, FRAME_RATE_HZ, skeletons=False)
        self._encoder = ResidualEncoder(0, 1, ResidualSettings(points=POINTS))
        self._decoder, self._control = ResidualDecoder(), LevelControl()
        self._sampler: PointSampler | None = None
        self._body: tuple[Skeleton, Skeleton, int] | None = None
        self._T_world_link: NDArray[np.float32] | None = None

    def frame(self, k: int, captured: CapturedFrame) -> None:
        """Maps first: what arrives in this frame's time is followed in it."""
        fitted = posed(captured, self.own)
        if fitted is not None:
            self._T_world_link = forward_kinematics(fitted[0], fitted[1])
            if self._maps_link.bytes_per_frame > 0 and captured.views:
                self._carry_maps(k, captured, *fitted[:2])
        super().frame(k, captured)

    def _carry_maps(self, k: int, captured: CapturedFrame, found: Skeleton, pose: SkeletonPose) -> None:
        self._maps_link.start_frame()
        if self._maps_link.idle:
            level = self._control.level(self._maps_link.bytes_per_frame * FRAMES_PER_MAP)
            packet = self._encoder.encode(self._residual_frame(k, captured, found, pose), level)
            if packet is not None:
                self._control.coded(decode_residual_header(packet).level, len(packet))
                self._maps_link.send(packet, len(packet))
        before = self._maps_link.sent_bytes
        message = self._maps_link.arrived()
        self.link.sent_bytes += self._maps_link.sent_bytes - before
        if isinstance(message, bytes) and self._body is not None:
            self._decoder.decode(message, {self._body[2]: self._body[1]})

    def _residual_frame(self, k: int, captured: CapturedFrame, found: Skeleton, pose: SkeletonPose) -> ResidualFrame:
        if self._sampler is None:
            self._sampler = PointSampler([view.camera for view in captured.views], POINTS, VOXEL_M)
        if self._body is None or _changed(self._body[0], found):
            self._body = found, quantized_skeleton(found), 0 if self._body is None else (self._body[2] + 1) % 256
        _, body, revision = self._body
        T_world_link = forward_kinematics(body, quantized_pose(pose))
        return ResidualFrame(body, revision, T_world_link, k, k * FRAME_NS, self._sampler.points(captured.views))

    def _show(self, k: int, mesh: RiggedMesh, motion: NDArray[np.float32], others: Sequence[Moved] = ()) -> None:
        super()._show(k, mesh, motion, others)
        maps, T_world_link = self._decoder.newest, self._T_world_link
        if maps is not None and T_world_link is not None:
            moved = [(mesh, motion), *others]
            self.screen = Screen(k, partial(live_picture, moved, maps, T_world_link, self._followed))


def _changed(a: Skeleton, b: Skeleton) -> bool:
    pairs = ((a.offsets, b.offsets), (a.tips, b.tips), (a.radii, b.radii))
    return max(float(np.abs(x - y).max()) for x, y in pairs) >= BODY_CHANGE_M


def live_picture(
    poses: Sequence[Moved], maps: ResidualMaps, T_world_link: NDArray[np.float32], followed: Followed,
    cameras: list[Camera],
) -> list[Picture]:  # fmt: skip
    """The mean of meshes that follow maps, seen by the cameras."""
    pictures = [_following(*each, maps, T_world_link, followed, cameras) for each in poses]
    return [blended(of_one_camera) for of_one_camera in zip(*pictures, strict=True)]


def _following(
    mesh: RiggedMesh,
    motion: NDArray[np.float32],
    maps: ResidualMaps,
    T_world_link: NDArray[np.float32],
    followed: Followed,
    cameras: list[Camera],
) -> list[Picture]:
    """A mesh moved to ``T_world_link`` that follows maps, seen by the cameras: texture plus the vertices' offsets."""
    vertices, colours = animate(mesh, motion), vertex_colours(mesh.mesh)
    surface = live_surface(mesh.pose_id, maps.layout, maps.maps, T_world_link, mesh.vertex_link, vertices, colours)
    moved, offsets = surface.follow(T_world_link, mesh.vertex_link, vertices)
    if followed == "shape":
        offsets = np.full_like(offsets, NO_OFFSET)
    return [render_live(mesh, vertices if followed == "colour" else moved, offsets, camera) for camera in cameras]
