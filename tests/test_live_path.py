"""The mesh on screen follows residual maps from packet to picture: a shirt that changes is seen to, and fades."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from common.body.rigged_mesh import RiggedMesh, build_rigged_mesh
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.body.skinning import link_motion
from common.body.vertex_blend import VertexBlend
from common.geometry.triangle_mesh import TriangleMesh
from common.runtime.clock import ManualClock
from common.runtime.stage_timer import StageTimer
from common.wire.skeleton_packet import SkeletonPacket
from receiver.config import RepositorySettings
from receiver.live_path import FADE_NS, PERIOD_NS, STALE_NS, LivePath
from receiver.pipeline import AnimationPath, MapPath, ReceivedPose, Shown, SkeletonToShow
from receiver.residual_decoder import ResidualMaps
from receiver.viewer.offscreen_viewer import OffscreenViewer
from receiver.viewer.viewer import ViewMode
from tests.capsule_person import SHIRT, SKELETON, pose_at
from tests.capsule_views import capsule_views
from tests.changing_shirt import EPOCH, FRAME_NS, REVISION, ChangingShirt, reddish
from tests.posed_cloud import BODY
from tests.test_offscreen_viewer import FRONT

SECOND_NS = 1_000_000_000


class Receiver:
    """Maps and skeletons in, frames out; ``sequence`` counts skeletons, one every ``FRAME_NS``."""

    def __init__(self) -> None:
        clock = ManualClock()
        self.animation = AnimationPath(RepositorySettings(), StageTimer(clock), clock)
        self.maps = MapPath(0, StageTimer(clock))
        self.newest: ResidualMaps | None = None
        self.sequence = 0

    @property
    def now_ns(self) -> int:
        return self.sequence * FRAME_NS

    def packet(self, data: bytes) -> None:
        new = self.maps.take(data, lambda _: {REVISION: BODY}, False)
        assert new
        self.newest = new[-1].maps
        self.animation.live.note_maps(new[-1].maps)

    def skeleton(self, pose: SkeletonPose, *arrived: ReceivedPose, epoch: int = EPOCH) -> Shown:
        self.sequence += 1
        packet = SkeletonPacket(0, epoch, self.sequence, self.now_ns, REVISION, 1.0, pose)
        return self.animation.show(SkeletonToShow(packet, BODY, deque(arrived)))


@pytest.fixture
def shirt() -> ChangingShirt:
    return ChangingShirt()


def mesh_at(time_s: float) -> RiggedMesh:
    """Another candidate pose, 8, of the same person."""
    pose = pose_at(time_s)
    return build_rigged_mesh(8, round(time_s * 1e9), SKELETON, pose, capsule_views(pose))


def shown_for(here: Receiver, shirt: ChangingShirt, duration_ns: int, send: bool = True) -> list[Shown]:
    frames = []
    for _ in range(round(duration_ns / FRAME_NS)):
        pose = pose_at(here.now_ns / 1e9)
        if send:
            here.packet(shirt.packet(pose, here.now_ns))
        frames.append(here.skeleton(pose))
    return frames


@pytest.mark.parametrize("mode", ["live", "mesh"])
def test_a_shirt_that_turns_red_is_seen_to_although_no_new_mesh_comes(mode: ViewMode, shirt: ChangingShirt) -> None:
    here, viewer = Receiver(), OffscreenViewer(mode=mode)
    viewer.add_pose(shirt.mesh)
    viewer.show(here.skeleton(pose_at(0.0), ReceivedPose(EPOCH, shirt.mesh)).frame)
    before = viewer.render([FRONT])[0][0]
    assert reddish(before).sum() == 0
    shirts = (np.abs(before.astype(int) - SHIRT) < 20).all(axis=2).sum()
    viewer.show(shown_for(here, shirt, FADE_NS + 2 * FRAME_NS)[-1].frame)
    seen = reddish(viewer.render([FRONT])[0][0]).sum()
    assert seen > 0.5 * shirts if mode == "live" else seen == 0


def test_it_fades_in_stays_and_fades_out_when_maps_stop(shirt: ChangingShirt) -> None:
    here = Receiver()
    assert here.skeleton(pose_at(0.0), ReceivedPose(EPOCH, shirt.mesh)).frame.surfaces == ()
    rising = [shown.frame.live for shown in shown_for(here, shirt, FADE_NS + 3 * FRAME_NS)]
    assert 0 < rising[0] < rising[3] < rising[6] < 1
    assert rising[-1] == 1
    assert max(np.diff(rising)) < 0.12
    held = [shown.frame.live for shown in shown_for(here, shirt, STALE_NS - 3 * FRAME_NS, send=False)]
    assert set(held) == {1.0}
    last = shown_for(here, shirt, FADE_NS + 6 * FRAME_NS, send=False)
    falling = [shown.frame.live for shown in last]
    assert min(np.diff(falling)) > -0.12
    assert falling[-1] == 0
    assert last[-1].frame.surfaces == ()


def test_another_mesh_follows_at_once_and_as_much(shirt: ChangingShirt) -> None:
    here = Receiver()
    here.skeleton(pose_at(0.0), ReceivedPose(EPOCH, shirt.mesh))
    shown_for(here, shirt, FADE_NS + 3 * FRAME_NS)
    time_s = here.now_ns / 1e9
    frame = here.skeleton(pose_at(time_s), ReceivedPose(EPOCH, mesh_at(time_s))).frame
    assert frame.pose_id == 8
    assert [surface.pose_id for surface in frame.surfaces] == [8, 7]
    assert frame.live == 1


def test_all_that_are_blended_follow() -> None:
    """Two meshes with the shirt as it was: red as if there was one, not half of it."""
    pictures = []
    for copies in (1, 2):
        here, viewer, shirt = Receiver(), OffscreenViewer(mode="live"), ChangingShirt()
        meshes = [shirt.mesh, mesh_at(0.6)][:copies]
        for mesh in meshes:
            viewer.add_pose(mesh)
        here.skeleton(pose_at(0.0), *(ReceivedPose(EPOCH, mesh) for mesh in meshes))
        frame = shown_for(here, shirt, FADE_NS + 2 * FRAME_NS)[-1].frame
        assert len(frame.others) == copies - 1
        viewer.show(frame)
        pictures.append(viewer.render([FRONT])[0][0])
    alone, both = (reddish(picture).sum() for picture in pictures)
    assert both > 0.95 * alone > 0


def test_an_id_that_stands_for_another_mesh_is_worked_out_anew(shirt: ChangingShirt) -> None:
    """As when a whole pose follows its preview: what is known of the one has other vertices."""
    live = LivePath(StageTimer(ManualClock()))
    here = Receiver()
    shown_for(here, shirt, FRAME_NS)
    maps = here.newest
    assert maps is not None
    live.note_maps(maps)
    T_world_link = forward_kinematics(SKELETON, pose_at(0.0))
    whole = mesh_at(0.6)
    fewer = whole.mesh.faces[: len(whole.mesh.faces) // 2]
    kept = fewer.max() + 1
    preview = replace(
        whole,
        mesh=TriangleMesh(whole.mesh.vertices[:kept], fewer, whole.mesh.uv[:kept], whole.mesh.texture),
        vertex_link=whole.vertex_link[:kept],
        blend=VertexBlend(whole.blend.other[:kept], whole.blend.share[:kept], whole.blend.joint[:kept]),
    )
    found = []
    for mesh in (preview, whole):
        now_ns = maps.header.capture_ns + len(found)
        surfaces, _ = live.surfaces([(mesh, link_motion(mesh, T_world_link))], T_world_link, EPOCH, now_ns + FADE_NS)
        found += surfaces
    assert len(set(found)) == 2


def test_a_mesh_that_is_soon_back_is_not_worked_out_anew(shirt: ChangingShirt) -> None:
    here = Receiver()
    here.skeleton(pose_at(0.0), ReceivedPose(EPOCH, shirt.mesh), ReceivedPose(EPOCH, mesh_at(0.6)))
    shown_for(here, shirt, SECOND_NS)
    live, T_world_link = here.animation.live, forward_kinematics(SKELETON, pose_at(1.0))
    moved = [(mesh, link_motion(mesh, T_world_link)) for mesh in (shirt.mesh, mesh_at(0.6))]
    both, _ = live.surfaces(moved, T_world_link, EPOCH, here.now_ns)
    one, _ = live.surfaces(moved[:1], T_world_link, EPOCH, here.now_ns)
    again, _ = live.surfaces(moved, T_world_link, EPOCH, here.now_ns)
    assert (len(both), len(one)) == (2, 1)
    assert again == both


def test_in_a_frame_one_mesh_at_most_is_worked_out_anew(shirt: ChangingShirt) -> None:
    here = Receiver()
    here.skeleton(pose_at(0.0), ReceivedPose(EPOCH, shirt.mesh), ReceivedPose(EPOCH, mesh_at(0.6)))
    frames = [shown.frame.surfaces for shown in shown_for(here, shirt, SECOND_NS)]
    new = [len(set(after) - set(before)) for before, after in pairwise(frames)]
    assert max(new) == 1
    assert max(map(len, frames)) == 2
    assert sum(new) > SECOND_NS / PERIOD_NS


def test_it_is_worked_out_a_few_times_a_second_however_many_packets_come(shirt: ChangingShirt) -> None:
    here = Receiver()
    here.skeleton(pose_at(0.0), ReceivedPose(EPOCH, shirt.mesh))
    shown = shown_for(here, shirt, SECOND_NS)
    made = {surface for s in shown for surface in s.frame.surfaces}
    assert 5 <= len(made) <= SECOND_NS / PERIOD_NS


def test_maps_of_another_run_are_not_followed(shirt: ChangingShirt) -> None:
    here = Receiver()
    here.skeleton(pose_at(0.0), ReceivedPose(EPOCH, shirt.mesh))
    shown_for(here, shirt, FADE_NS + 3 * FRAME_NS)
    frame = here.skeleton(pose_at(1.0), ReceivedPose(EPOCH + 1, shirt.mesh), epoch=EPOCH + 1).frame
    assert frame.pose_id == 7
    assert (frame.surfaces, frame.live) == ((), 0)


def test_without_maps_any_more_the_mesh_is_itself_again(shirt: ChangingShirt) -> None:
    """Nobody wants them: the last one that showed them has switched."""
    here = Receiver()
    here.skeleton(pose_at(0.0), ReceivedPose(EPOCH, shirt.mesh))
    shown_for(here, shirt, FADE_NS + 3 * FRAME_NS)
    here.animation.live.note_maps(None)
    assert shown_for(here, shirt, FADE_NS + 2 * FRAME_NS, send=False)[-1].frame.live == 0
