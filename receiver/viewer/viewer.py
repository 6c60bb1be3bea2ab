"""What the receiver shows to: one interface for the page, the offscreen renderer and nobody at all.

The receiver's daemon calls a viewer on its own loop, in this order: poses enter and leave with the repository, then
frames name the pose they move. A viewer never blocks and never queues without a bound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT

if TYPE_CHECKING:
    from common.body.link_points import LinkPoints
    from common.body.live_surface import LiveSurface
    from common.body.rigged_mesh import RiggedMesh

ViewMode = Literal["mesh", "live", "points"]


class ConnectionState(StrEnum):
    """What the receiver knows of its sender."""

    WAITING = "waiting for sender"
    RECEIVING = "receiving"
    LOST = "connection lost"


@dataclass(frozen=True, slots=True, eq=False)
class MovedPose:
    """A candidate pose and how its links moved since it was captured: ``motion`` (L, 3, 4) float32."""

    pose_id: int
    motion: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class ShownFrame:
    """One instant on screen: which candidate pose is drawn and how its links moved since it was captured.

    ``capture_ns``: the sender's capture time of the skeleton [ns]. ``pose_id``: the candidate pose drawn; None while
    the repository is empty (then ``motion`` is None too and only the joints are known).
    ``motion`` (L, 3, 4) float32: T_world_link(now) · T_link_world(at capture), moves the mesh's world vertices.
    ``others``: poses that it is blended with: the picture is the mean of all.
    ``joints`` (L, 3) float32 [m, world]: link origins. ``sigma``: distortion score σ of the drawn pose (nan: none).
    ``links`` (L, 3, 4) float32: T_world_link, moves points; None where nobody needs it.
    ``surfaces``: what maps show beyond these poses' meshes; ``live``: how much of it to show, 0..1.
    ``region_sigma`` (R,) float32: its σ_r by region (``REGION_NAMES``; nan: not seen), None without a pose.
    ``fit_confidence``: 0..1. ``confidence`` (L,) float32: 0 = that link was not seen.
    ``age_ms``: time from capture to this call [ms], nan while the clock offset to the sender is unknown.
    ``withheld``: the newest skeleton would distort every mesh too much (DISPOSE §8); this is the last good frame again,
    but for ``links``: points are where the newest skeleton is.

    Raises:
        ValueError: wrong shapes, or a motion without a pose.
    """

    capture_ns: int
    sequence: int
    pose_id: int | None
    motion: NDArray[np.float32] | None
    joints: NDArray[np.float32]
    sigma: float
    links: NDArray[np.float32] | None = field(default=None, kw_only=True)
    others: tuple[MovedPose, ...] = field(default=(), kw_only=True)
    surfaces: tuple[LiveSurface, ...] = field(default=(), kw_only=True)
    live: float = field(default=0.0, kw_only=True)
    region_sigma: NDArray[np.float32] | None = field(default=None, kw_only=True)
    fit_confidence: float
    confidence: NDArray[np.float32]
    age_ms: float = float("nan")
    withheld: bool = False

    def __post_init__(self) -> None:
        if (self.pose_id is None) != (self.motion is None):
            raise ValueError("a shown frame has a pose and its motion, or neither")
        if self.others and self.pose_id is None:
            raise ValueError("a shown frame has no pose, but others to blend it with")
        drawn = {self.pose_id, *(other.pose_id for other in self.others)}
        if strange := [surface.pose_id for surface in self.surfaces if surface.pose_id not in drawn]:
            raise ValueError(f"surfaces of poses {strange} in a frame of poses {drawn}")
        if self.motion is not None and self.motion.shape != (LINK_COUNT, 3, 4):
            raise ValueError(f"motion: expected {(LINK_COUNT, 3, 4)}, got {self.motion.shape}")
        if self.links is not None and self.links.shape != (LINK_COUNT, 3, 4):
            raise ValueError(f"links: expected {(LINK_COUNT, 3, 4)}, got {self.links.shape}")
        if self.joints.shape != (LINK_COUNT, 3) or self.confidence.shape != (LINK_COUNT,):
            raise ValueError(f"joints {self.joints.shape}, confidence {self.confidence.shape}: not {LINK_COUNT} links")


@dataclass(frozen=True, slots=True)
class ViewerStatus:
    """The figures beside the picture, a few times a second.

    ``detail``: one sentence for a person where something is missing ("no person in view"), else "".
    ``frame_rate_hz``: skeletons received per second. ``pose_age_ms``: capture to screen [ms], None while unknown.
    ``skeleton_bps``, ``bulk_bps``: payload received [bit/s]. ``chosen_pose``: id of the pose drawn, None = none.
    ``sigma``: its distortion score σ, None = none. ``region_sigma``: σ_r of the regions seen.
    """

    connection: ConnectionState = ConnectionState.WAITING
    detail: str = ""
    frame_rate_hz: float = 0.0
    pose_age_ms: float | None = None
    skeleton_bps: float = 0.0
    bulk_bps: float = 0.0
    repository_poses: int = 0
    chosen_pose: int | None = None
    sigma: float | None = None
    region_sigma: Mapping[str, float] = field(default_factory=dict)


class Viewer(Protocol):
    """Shows one person, as a mesh, as a mesh that follows maps ("live") or as points. Poses are added before the first
    frame that names them; ``show_points``: the points that frames move from now on, None: there are none."""

    def add_pose(self, mesh: RiggedMesh) -> None: ...
    def remove_pose(self, pose_id: int) -> None: ...
    def show_points(self, points: LinkPoints | None) -> None: ...
    def show(self, frame: ShownFrame) -> None: ...
    def set_status(self, status: ViewerStatus) -> None: ...


class NullViewer:
    """Shows nothing; the receiver runs the same without a screen."""

    def add_pose(self, mesh: RiggedMesh) -> None:
        """Ignores the pose."""

    def remove_pose(self, pose_id: int) -> None:
        """Ignores the pose."""

    def show_points(self, points: LinkPoints | None) -> None:
        """Ignores the points."""

    def show(self, frame: ShownFrame) -> None:
        """Ignores the frame."""

    def set_status(self, status: ViewerStatus) -> None:
        """Ignores the figures."""
