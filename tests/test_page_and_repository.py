"""Whatever comes in whatever order: the repository, the page and what is on screen agree."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.rigged_mesh import RiggedMesh
from common.runtime.clock import ManualClock
from common.runtime.stage_timer import StageTimer
from common.wire.skeleton_packet import SkeletonPacket
from receiver.config import RepositorySettings
from receiver.pipeline import AnimationPath, ReceivedPose, Shown, SkeletonToShow
from tests.capsule_person import SKELETON
from tests.capsule_views import arms_down_by, captured

ANGLES_RAD = (0.2, 0.25, 0.7, 0.75, 1.2)


class Page:
    """What a page does with what the daemon tells it: ``remove_pose``, ``add_pose``, then ``show``."""

    def __init__(self) -> None:
        self.poses: dict[int, RiggedMesh] = {}
        self.on_screen: int | None = None

    def follow(self, shown: Shown) -> None:
        for pose_id in shown.removed:
            del self.poses[pose_id]  # KeyError: it was never told of that pose
        for mesh in shown.added:
            self.poses[mesh.pose_id] = mesh
        self.on_screen = shown.frame.pose_id


class SlowClock(ManualClock):
    """Every look at it costs some time: then searches take long and poses are pruned for it."""

    def __init__(self, step_ns: int) -> None:
        super().__init__(0)
        self._step_ns = step_ns

    def now_ns(self) -> int:
        self.advance(self._step_ns)
        return super().now_ns()


def pose(pose_id: int, preview: bool) -> RiggedMesh:
    mesh = captured(ANGLES_RAD[pose_id % len(ANGLES_RAD)], pose_id, pose_id)
    return replace(mesh, mesh=replace(mesh.mesh, texture=mesh.mesh.texture[::3, ::3])) if preview else mesh


EVENTS = st.lists(
    st.tuples(
        st.lists(st.tuples(st.integers(0, 12), st.booleans()), max_size=3),  # poses that came: id, whether a preview
        st.sampled_from(ANGLES_RAD),
        st.integers(0, 30).map(lambda n: int(n == 0)),  # now and then the sender starts anew
    ),
    min_size=40,
    max_size=90,
)


@settings(max_examples=25, deadline=None)
@given(
    EVENTS,
    st.sampled_from(["exhaustive", "threshold"]),
    st.booleans(),
    st.integers(1, 6),
    st.sampled_from([1_000, 4_000_000]),
)
def test_page_and_repository_agree_and_the_pose_on_screen_stays(events, search, hold, poses, step_ns):
    limits = RepositorySettings(poses=poses, search=search, hold=hold)
    clock = SlowClock(step_ns)
    path = AnimationPath(limits, StageTimer(ManualClock()), clock)
    page, epoch = Page(), 1
    for sequence, (arrived, angle, restarts) in enumerate(events):
        before, same_run = page.on_screen, not restarts
        epoch += restarts
        came = deque(ReceivedPose(epoch, pose(pose_id, preview)) for pose_id, preview in arrived)
        packet = SkeletonPacket(0, epoch, sequence, sequence, 1, 1.0, arms_down_by(angle), None)
        shown = path.show(SkeletonToShow(packet, SKELETON, came))
        page.follow(shown)
        assert len(page.poses) == shown.repository_poses <= max(poses, 2)  # the one on screen and a new one
        assert page.on_screen is None or page.on_screen in page.poses
        assert (page.on_screen is None) == (not page.poses)
        if before is not None and same_run:
            assert before in page.poses  # it was on screen until this very frame
