"""Both pipelines joined without a network: depth images in, shown frames out."""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Literal

import numpy as np
import pytest

from common.body.body_regions import REGION_INDEX, default_region_weights
from common.body.skeleton import Skeleton
from common.body.skeleton_pose import forward_kinematics, named_joint_positions, rest_pose
from common.runtime.clock import ManualClock
from common.runtime.stage_timer import StageTimer
from common.wire.body_message import decode_body
from common.wire.header import WireError
from common.wire.skeleton_packet import SkeletonPacket, decode_skeleton
from receiver.config import RepositorySettings
from receiver.pipeline import AnimationPath, ReceivedPose, SkeletonToShow, mesh_of
from sender.candidate_poses.pose_coverage import Coverage
from sender.candidate_poses.usable_pose_set import Quotients
from sender.capture.frame_set import FrameSet
from sender.config import CandidateSettings
from sender.pipeline import CandidatePath, TrackedFrame
from tests.rig_scene import IDENTITY, frame_set, performer, skeleton_path, tracked


def with_packet() -> list[TrackedFrame]:
    return [frame for frame in tracked() if frame.packet is not None]


def packet_of(frame: TrackedFrame) -> SkeletonPacket:
    assert frame.packet is not None
    return decode_skeleton(frame.packet)


def last_body() -> Skeleton:
    return decode_body([frame.body for frame in tracked() if frame.body is not None][-1]).skeleton


def timer() -> StageTimer:
    return StageTimer(ManualClock())


def animation_path() -> AnimationPath:
    return AnimationPath(RepositorySettings(), timer(), ManualClock())


def received_pose(frame: TrackedFrame) -> ReceivedPose:
    return mesh_of(CandidatePath(IDENTITY, CandidateSettings(), timer()).process(frame).encoded, 0)


def test_a_person_in_an_a_pose_is_found_and_followed():
    frames = with_packet()
    assert len(frames) >= 30  # of 45: found within the first half second
    last = frames[-1]
    packet = packet_of(last)
    truth = performer().named_joints(packet.capture_ns / 1e9)
    error_m = np.linalg.norm(named_joint_positions(last_body(), packet.pose) - truth, axis=1).mean()
    assert error_m < 0.06


def test_packets_are_small_and_numbered():
    packets = [packet_of(frame) for frame in with_packet()]
    assert all(len(frame.packet or b"") <= 250 for frame in with_packet())
    assert [packet.sequence for packet in packets] == list(range(len(packets)))
    assert {packet.epoch for packet in packets} == {IDENTITY.epoch}
    assert packets[-1].previous is not None


def test_the_body_is_told_before_the_first_packet_that_refers_to_it():
    known = set()
    for frame in with_packet():
        if frame.body is not None:
            known.add(decode_body(frame.body).revision)
        assert packet_of(frame).body_revision in known


def test_the_packet_says_what_the_sender_itself_meshes_with():
    frame = with_packet()[-1]
    assert frame.pose is not None
    np.testing.assert_array_equal(packet_of(frame).pose.rotations, frame.pose.rotations)


def test_a_missing_camera_and_an_empty_room_are_survived():
    path = skeleton_path()
    for sequence in range(1, 20):
        path.process(frame_set(sequence))
    full = frame_set(20)
    partial = path.process(FrameSet(full.capture_ns, (None, *full.frames[1:])))
    assert len(partial.views) == 3
    assert not partial.complete
    assert partial.packet is not None
    nobody = path.process(FrameSet(frame_set(21).capture_ns, (None,) * 4))
    assert nobody.views == ()
    if nobody.fit is not None:
        assert nobody.fit.confidence < 0.5


def test_a_doubtful_fit_never_becomes_a_candidate():
    frame = with_packet()[-1]
    assert frame.fit is not None
    path = CandidatePath(IDENTITY, CandidateSettings(least_confidence=0.5), timer())
    assert path.may_become_one(frame)
    doubtful = dataclasses.replace(frame, fit=dataclasses.replace(frame.fit, confidence=0.3))
    assert not path.may_become_one(doubtful)
    assert not path.may_become_one(dataclasses.replace(frame, views=()))
    assert not path.may_become_one(dataclasses.replace(frame, complete=False))


@pytest.mark.parametrize("choice", ["coverage", "paper"])
def test_candidates_gather_skeletons_and_what_the_poses_are_worth(choice: Literal["coverage", "paper"]) -> None:
    path = CandidatePath(IDENTITY, CandidateSettings(choice=choice), timer())
    frames = with_packet()
    found = None
    for frame in frames[-12:]:
        path.remember(frame)
        found = path.process(frame)
    assert found is not None
    if choice == "paper":
        assert isinstance(found.worth, Quotients)
        assert max(found.worth.chi.values()) > 0  # standing still, one pose animates its neighbours
    else:
        assert isinstance(found.worth, Coverage)
        assert found.worth.pose_ids == tuple(range(1, 13))
        assert found.worth.gains([12], ())[0] > 0


def test_a_doubtful_skeleton_does_not_count_when_poses_are_judged() -> None:
    frame = with_packet()[-1]
    assert frame.fit is not None
    path = CandidatePath(IDENTITY, CandidateSettings(), timer())
    path.remember(dataclasses.replace(frame, fit=dataclasses.replace(frame.fit, confidence=0.3)))
    nothing = path.process(frame).worth
    path.remember(frame)
    something = path.process(frame).worth
    assert isinstance(nothing, Coverage)
    assert isinstance(something, Coverage)
    assert (nothing.sigmas.shape[1], something.sigmas.shape[1]) == (0, 1)


def test_over_a_thin_link_poses_are_sent_smaller_and_a_preview_is_a_fraction_of_them() -> None:
    frame = with_packet()[-1]
    path = CandidatePath(IDENTITY, CandidateSettings(), timer())
    fine = path.process(frame)
    path.note_budget(len(fine.encoded))
    thin = path.process(frame)
    path.note_budget(10 * len(fine.encoded))
    assert len(thin.encoded) < 0.7 * len(fine.encoded)
    assert len(path.process(frame).encoded) == len(fine.encoded)
    assert len(fine.preview) < 0.3 * len(fine.encoded)
    assert mesh_of(fine.preview, 0).mesh.pose_id == mesh_of(fine.encoded, 0).mesh.pose_id


def test_a_skeleton_alone_shows_joints_and_no_mesh():
    shown = animation_path().show(SkeletonToShow(packet_of(with_packet()[-1]), last_body(), deque()))
    assert shown.frame.pose_id is None
    assert shown.frame.motion is None
    assert shown.repository_poses == 0


def test_a_received_pose_is_animated_by_the_next_skeleton():
    first, last = with_packet()[-10], with_packet()[-1]
    pose = received_pose(first)
    shown = animation_path().show(SkeletonToShow(packet_of(last), last_body(), deque([pose])))
    assert [mesh.pose_id for mesh in shown.added] == [pose.mesh.pose_id]
    assert shown.frame.pose_id == pose.mesh.pose_id
    assert np.isfinite(shown.frame.sigma)
    assert shown.frame.region_sigma is not None
    seen = np.isfinite(shown.frame.region_sigma)
    assert seen[REGION_INDEX["left_forearm"]]
    weighted = (shown.frame.region_sigma * default_region_weights())[seen]
    assert weighted.mean() == pytest.approx(shown.frame.sigma, rel=1e-3)  # DISPOSE Eq. (2)
    moved = np.abs(shown.frame.motion - np.eye(3, 4)).max()
    assert 0 < moved < 1


def test_a_new_run_of_the_sender_starts_with_an_empty_repository():
    frame = with_packet()[-1]
    path = animation_path()
    path.show(SkeletonToShow(packet_of(frame), last_body(), deque([received_pose(frame)])))
    restarted = dataclasses.replace(packet_of(frame), epoch=IDENTITY.epoch + 1)
    shown = path.show(SkeletonToShow(restarted, last_body(), deque([received_pose(frame)])))
    assert len(shown.removed) == 1
    assert shown.repository_poses == 0
    assert shown.counts["pose of another run"] == 1
    assert shown.frame.pose_id is None


def test_a_skeleton_that_would_tear_the_mesh_is_withheld_and_the_last_good_frame_stays_marked() -> None:
    frame = with_packet()[-1]
    path = animation_path()
    good = packet_of(frame)
    path.show(SkeletonToShow(good, last_body(), deque([received_pose(frame)])))
    for number in range(1, 21):  # the session learns what σ is usual
        shown = path.show(SkeletonToShow(dataclasses.replace(good, sequence=number), last_body(), deque()))
        assert not shown.frame.withheld
    torn = dataclasses.replace(good, pose=rest_pose(good.pose.root_position), sequence=21)
    shown = path.show(SkeletonToShow(torn, last_body(), deque()))
    assert (shown.frame.withheld, shown.frame.sequence) == (True, 20)
    np.testing.assert_array_equal(shown.frame.joints, forward_kinematics(last_body(), good.pose)[:, :3, 3])
    assert not path.show(SkeletonToShow(good, last_body(), deque())).frame.withheld
    unmindful = AnimationPath(RepositorySettings(withhold_factor=0), timer(), ManualClock())
    for packet in (*[good] * 20, torn):
        shown = unmindful.show(SkeletonToShow(packet, last_body(), deque([received_pose(frame)])))
    assert not shown.frame.withheld


def test_another_persons_pose_is_refused():
    encoded = CandidatePath(IDENTITY, CandidateSettings(), timer()).process(with_packet()[-1]).encoded
    with pytest.raises(WireError, match="person"):
        mesh_of(encoded, person=3)
