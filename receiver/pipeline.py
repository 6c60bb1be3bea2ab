"""The receiver on one page: from a skeleton packet to what the viewer shows, and from a candidate pose to its mesh.

DISPOSE Fig. 1, right half: the skeleton never waits for a mesh; it moves the best of those already here. ``MapPath``
decodes residual packets (Lien §5): of the newest one, either the mesh moved takes colour and shape (``LivePath``), or,
in point mode, its points are moved.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
from numpy.typing import NDArray

from common.body.body_regions import ScoreForm, region_weights
from common.body.distortion_score import region_scores
from common.body.link_points import LinkPoints
from common.body.rigged_mesh import RiggedMesh, build_rigged_mesh
from common.body.skeleton import Skeleton
from common.body.skeleton_pose import forward_kinematics
from common.body.skinning import link_motion
from common.runtime.clock import Clock
from common.runtime.stage_timer import StageTimer
from common.wire.candidate_pose import decode_candidate_pose
from common.wire.header import WireError
from common.wire.residual_packet import decode_residual_header
from common.wire.skeleton_packet import SkeletonPacket
from receiver.config import RepositorySettings as Settings
from receiver.live_path import LivePath
from receiver.repository.pose_repository import PoseRepository, RepositorySettings
from receiver.repository.pose_selection import PoseSelector, Selection, SelectionSettings
from receiver.residual_decoder import ResidualDecoder, ResidualMaps, link_points
from receiver.viewer.viewer import MovedPose, ShownFrame

RESIDUAL_POINTS_MAX = 200_000  # bounds what a packet can make us allocate
SEARCHES_REMEMBERED = 31  # the median of so many is what a search costs: one that was interrupted says nothing


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedPose:
    """A candidate pose meshed, and the sender's run it belongs to."""

    epoch: int
    mesh: RiggedMesh


@dataclass(frozen=True, slots=True, eq=False)
class SkeletonToShow:
    """The newest skeleton with its body, and the poses meshed since the last one (taken out by whoever shows it)."""

    packet: SkeletonPacket
    body: Skeleton
    arrived: deque[ReceivedPose]


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What one skeleton led to. ``frame``: what to show; withheld, it is the last good one again.
    ``removed``, then ``added``: how the repository changed; the viewer follows it. ``counts``: poses not taken, by
    cause."""

    epoch: int
    frame: ShownFrame
    added: tuple[RiggedMesh, ...]
    removed: tuple[int, ...]
    repository_poses: int
    counts: Counter[str]


def mesh_of(message: bytes, person: int, score_form: ScoreForm = "joining-edges") -> ReceivedPose:
    """Decode a candidate pose and build its rigged mesh (depth → triangles → links), as the sender did.

    ``score_form``: of the distortion score here.

    Raises:
        WireError: it cannot be decoded, is another person's, or holds no surface.
    """
    candidate = decode_candidate_pose(message)
    if candidate.person != person:
        raise WireError(f"candidate pose of person {candidate.person}, expected {person}")
    try:
        mesh = build_rigged_mesh(
            candidate.pose_id,
            candidate.capture_ns,
            candidate.skeleton,
            candidate.pose,
            candidate.views,
            candidate.rigging,
            score_form,
        )
    except ValueError as error:
        raise WireError(str(error)) from error
    return ReceivedPose(candidate.epoch, mesh)


@dataclass(frozen=True, slots=True, eq=False)
class NewMaps:
    """One frame's maps, and their points where these are wanted."""

    maps: ResidualMaps
    points: LinkPoints | None


class AnimationPath:
    """Every skeleton: repository → pose selection by σ → animation. One thread's own, but for ``live.note_maps``."""

    def __init__(self, settings: Settings, timer: StageTimer, clock: Clock) -> None:
        bounds = RepositorySettings(
            max_poses=settings.poses,
            max_bytes=settings.megabytes << 20,
            max_search_ns=int(settings.search_ms * 1e6),
            equal_share=settings.equal_share,
        )
        self._repository = PoseRepository(bounds, region_weights(settings.region_weights))
        self._selector = PoseSelector(
            SelectionSettings(
                search=settings.search,
                hold=settings.hold,
                hysteresis=settings.hysteresis,
                blended=settings.blended,
                withhold_factor=settings.withhold_factor,
            )
        )
        self.live = LivePath(timer)
        self._timer = timer
        self._clock = clock
        self._shown: ShownFrame | None = None  # the last one that was not withheld
        self._search_ns: deque[int] = deque(maxlen=SEARCHES_REMEMBERED)

    def show(self, newest: SkeletonToShow) -> Shown:
        """Take in what has arrived, and animate the best pose for the newest skeleton."""
        packet = newest.packet
        before = self._repository.pose_ids
        arrived: dict[int, RiggedMesh] = {}
        counts: Counter[str] = Counter()
        with self._timer.stage("repository"):
            self._follow_epoch(packet.epoch)
            while newest.arrived:
                self._add(newest.arrived.popleft(), packet.epoch, arrived, counts)
        T_world_link = forward_kinematics(newest.body, packet.pose)
        self._bound_search()  # before the choice: what is chosen stays
        frame = self._frame(packet, T_world_link)
        after = self._repository.pose_ids
        added = tuple(mesh for pose_id, mesh in arrived.items() if pose_id in after)
        return Shown(packet.epoch, frame, added, tuple(before - after), len(after), counts)

    @property
    def _on_screen(self) -> int | None:
        return None if self._shown is None else self._shown.pose_id

    def _frame(self, packet: SkeletonPacket, T_world_link: NDArray[np.float32]) -> ShownFrame:
        """The frame to show: the last good one, marked, where this one would be too distorted."""
        selection = self._select(T_world_link)
        if selection is None:
            self._shown = _shown_frame(packet, None, T_world_link, float("nan"))
            return self._shown
        if selection.withheld and self._shown is not None and self._shown.pose_id in self._repository.pose_ids:
            return replace(self._shown, withheld=True, links=T_world_link[:, :3])  # points are never withheld
        self._repository.count_use(selection.pose_id)
        mesh = self._mesh(selection.pose_id)
        meshes = [self._mesh(pose_id) for pose_id in selection.others]
        frame = _shown_frame(packet, mesh, T_world_link, selection.sigma)
        others = tuple(MovedPose(other.pose_id, link_motion(other, T_world_link)) for other in meshes)
        assert frame.motion is not None
        moved = [(mesh, frame.motion), *((other, pose.motion) for other, pose in zip(meshes, others, strict=True))]
        surfaces, live = self.live.surfaces(moved, T_world_link, packet.epoch, packet.capture_ns)
        self._shown = replace(frame, others=others, surfaces=surfaces, live=live)
        return self._shown

    def _mesh(self, pose_id: int) -> RiggedMesh:
        mesh = self._repository.get(pose_id)
        assert mesh is not None
        return mesh

    def _select(self, T_world_link: NDArray[np.float32]) -> Selection | None:
        begin_ns = self._clock.now_ns()
        selection = self._selector.select(self._repository, T_world_link)
        self._search_ns.append(self._clock.now_ns() - begin_ns)
        self._timer.add("selection", self._search_ns[-1])
        return selection

    def _bound_search(self) -> None:
        """Keep no more poses than can be searched in time."""
        if len(self._search_ns) < SEARCHES_REMEMBERED:
            return
        if self._repository.limit_search(int(median(self._search_ns)), self._on_screen):
            self._search_ns.clear()

    def _add(self, pose: ReceivedPose, epoch: int, arrived: dict[int, RiggedMesh], counts: Counter[str]) -> None:
        if pose.epoch != epoch:  # of a run that is over, or of one whose first skeleton has not come yet
            counts["pose of another run"] += 1
            return
        self._repository.add(pose.mesh, epoch, self._selector.threshold.value, self._on_screen)
        arrived[pose.mesh.pose_id] = pose.mesh

    def _follow_epoch(self, epoch: int) -> None:
        """Nothing of an old run is shown in a new one."""
        if epoch != self._repository.epoch:
            self._shown = None
            self._repository.reset(epoch)
            self.live.forget()


class MapPath:
    """Every residual packet → maps → where they are wanted, the person's points on their links. One thread's own.
    ``counts``: packets of no use, by cause."""

    def __init__(self, person: int, timer: StageTimer) -> None:
        self._person = person
        self._timer = timer
        self._decoder = ResidualDecoder(RESIDUAL_POINTS_MAX)

    @property
    def counts(self) -> Counter[str]:
        return Counter({"late": self._decoder.late, "without reference": self._decoder.without_reference})

    def take(self, message: bytes, bodies: Callable[[int], Mapping[int, Skeleton]], as_points: bool) -> list[NewMaps]:
        """The maps now, several where frames go in groups, [] where the packet shows nothing newer; ``bodies(epoch)``:
        sizes by revision.

        Raises:
            WireError: it cannot be decoded, or is another person's.
        """
        header = decode_residual_header(message)
        if header.person != self._person:
            raise WireError(f"residual packet of person {header.person}, expected {self._person}")
        with self._timer.stage("residual maps"):
            found = self._decoder.decode(message, bodies(header.epoch))
            return [NewMaps(maps, link_points(maps) if as_points else None) for maps in found]


def _shown_frame(
    packet: SkeletonPacket, mesh: RiggedMesh | None, T_world_link: NDArray[np.float32], sigma: float
) -> ShownFrame:
    return ShownFrame(
        capture_ns=packet.capture_ns,
        sequence=packet.sequence,
        pose_id=None if mesh is None else mesh.pose_id,
        motion=None if mesh is None else link_motion(mesh, T_world_link),
        joints=np.ascontiguousarray(T_world_link[:, :3, 3]),
        links=T_world_link[:, :3],
        sigma=sigma,
        region_sigma=None if mesh is None else region_scores(mesh, T_world_link),
        fit_confidence=packet.fit_confidence,
        confidence=packet.pose.confidence,
    )
