"""A captured person whose shirt turns red afterwards, though no other mesh comes: what residual packets tell of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.body.live_surface import vertex_colours
from common.body.skeleton import LINK_INDEX
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.body.skinning import animate, link_motion
from common.geometry.point_cloud import PointCloud
from sender.residual_encoder import ResidualEncoder, ResidualFrame, ResidualSettings
from tests.capsule_views import captured
from tests.posed_cloud import BODY

FRAME_NS = 33_333_333
EPOCH, REVISION, POINTS = 9, 5, 8000
RED = (220, 50, 60)
SHIRT_LINKS = [LINK_INDEX[name] for name in ("lower_spine", "upper_spine", "left_clavicle", "right_clavicle")]


class ChangingShirt:
    """The person with pose id 7, and a sender's packets."""

    def __init__(self, level: float = 60.0) -> None:
        self.mesh = captured(0.4, 7)
        self._encoder = ResidualEncoder(0, EPOCH, ResidualSettings(points=POINTS))
        self._level = level

    def links(self, pose: SkeletonPose) -> NDArray[np.float32]:
        """T_world_link (L, 4, 4)."""
        return forward_kinematics(BODY, pose)

    def packet(self, pose: SkeletonPose, capture_ns: int, shirt: tuple[int, int, int] = RED) -> bytes:
        """The residual packet of the person seen in ``pose`` with a shirt of that colour."""
        T_world_link = self.links(pose)
        positions = animate(self.mesh, link_motion(self.mesh, T_world_link))
        colours = vertex_colours(self.mesh.mesh)
        colours[np.isin(self.mesh.vertex_link, SHIRT_LINKS)] = shirt
        cloud = PointCloud(positions, np.zeros_like(positions), colours)
        frame = ResidualFrame(BODY, REVISION, T_world_link, 0, capture_ns, cloud)
        data = self._encoder.encode(frame, self._level)
        assert data is not None
        return data


def reddish(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels (H, W) that are as the red shirt, roughly."""
    return np.asarray((np.abs(picture.astype(int) - RED) < 40).all(axis=2))
