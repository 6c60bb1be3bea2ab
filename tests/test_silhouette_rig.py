"""Rigs of colour cameras without depth, end to end: frames in, skeleton packets out, and never a candidate pose."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from common.body.skeleton_pose import named_joint_positions
from common.runtime.clock import ManualClock
from common.runtime.stage_timer import StageTimer
from common.wire.skeleton_packet import decode_skeleton
from sender.capture.frame_set import ColourFrame, FrameSet
from sender.capture.rig_layout import RigSettings
from sender.capture.virtual_rig import VirtualRig
from sender.config import CandidateSettings
from sender.fitting.open_tracker import open_tracker
from sender.pipeline import CandidatePath, SkeletonPath, TrackedFrame
from sender.reconstruction.person_points import HullReconstruction
from tests.rig_scene import IDENTITY, RATE_HZ, frame_set, performer, renderer

CAMERAS = renderer().cameras
FRAMES = 15


def colour_frames(sequence: int) -> FrameSet:
    """The rig's frames without their depth."""
    full = frame_set(sequence)
    colours = (
        ColourFrame(frame.camera_index, frame.sequence, frame.capture_ns, frame.colour)
        for frame in full.frames
        if frame is not None
    )
    return FrameSet(full.capture_ns, tuple(colours))


def rooms() -> list[np.ndarray]:
    return [renderer().empty_room_colour(index)[None] for index in range(len(CAMERAS))]


def reconstruction(inside: bool = False) -> HullReconstruction:
    return HullReconstruction(CAMERAS, rooms(), inside=inside)


def skeleton_path(tracker: str = "gauss-newton") -> SkeletonPath:
    timer, clock = StageTimer(ManualClock()), ManualClock()
    made = reconstruction(inside=tracker == "particles")
    return SkeletonPath(IDENTITY, made, open_tracker(tracker), RATE_HZ, timer, clock)


@cache
def tracked(tracker: str) -> tuple[TrackedFrame, ...]:
    path = skeleton_path(tracker)
    return tuple(path.process(colour_frames(sequence)) for sequence in range(1, FRAMES + 1))


@pytest.mark.parametrize("tracker", ["gauss-newton", "particles"])
def test_a_person_before_colour_cameras_is_found_and_followed(tracker: str):
    last = tracked(tracker)[-1]
    assert last.packet is not None
    assert last.fit is not None
    assert decode_skeleton(last.packet).fit_confidence > 0.2
    truth = performer().named_joints(last.capture_ns / 1e9)
    error_m = np.linalg.norm(named_joint_positions(last.fit.skeleton, last.fit.pose) - truth, axis=1).mean()
    assert error_m < 0.10  # a hull is wider than the person in it


def test_without_depth_nothing_becomes_a_candidate():
    candidates = CandidatePath(IDENTITY, CandidateSettings(least_confidence=0.0), StageTimer(ManualClock()))
    assert all(frame.views == () for frame in tracked("gauss-newton"))
    assert not any(candidates.may_become_one(frame) for frame in tracked("gauss-newton"))


def test_the_points_lie_around_the_person_and_inside_only_once_there_is_a_pose():
    timer = StageTimer(ManualClock())
    found = reconstruction().person(colour_frames(3), None, timer)
    joints = performer().named_joints(3 / RATE_HZ)
    assert len(found.cloud) > 2000
    assert found.certainty == 1.0
    low, high = joints.min(axis=0) - 0.25, joints.max(axis=0) + 0.25
    assert ((found.cloud.positions > low) & (found.cloud.positions < high)).all(axis=1).mean() > 0.98
    with_particles = reconstruction(inside=True)
    assert np.abs(with_particles.person(colour_frames(3), None, timer).cloud.normals).sum(axis=1).min() > 0.9
    assert (with_particles.person(colour_frames(3), joints, timer).cloud.normals == 0).all()


def test_missing_cameras_and_an_empty_room_are_survived():
    path = skeleton_path()
    for sequence in range(1, 10):
        path.process(colour_frames(sequence))
    full = colour_frames(10)
    fewer = path.process(FrameSet(full.capture_ns, (None, *full.frames[1:])))
    assert fewer.fit is not None
    assert fewer.fit.confidence > 0.2
    assert not fewer.complete
    for sequence, frames in ((11, (None, None, None, full.frames[3])), (12, (None,) * 4)):
        alone = path.process(FrameSet(round(sequence / RATE_HZ * 1e9), frames))
        assert alone.fit is not None
        assert alone.fit.confidence == 0
    empty = (ColourFrame(index, 13, 0, room[0]) for index, room in enumerate(rooms()))
    nobody = path.process(FrameSet(round(13 / RATE_HZ * 1e9), tuple(empty)))
    assert nobody.fit is not None
    assert nobody.fit.confidence == 0


def test_a_hull_that_is_not_surely_the_persons_lowers_the_packets_confidence(monkeypatch: pytest.MonkeyPatch):
    path = skeleton_path()
    for sequence in range(1, 10):
        sure = path.process(colour_frames(sequence))
    person = HullReconstruction.person

    def unsure(self, *arguments):
        return dataclasses.replace(person(self, *arguments), certainty=0.25)

    monkeypatch.setattr(HullReconstruction, "person", unsure)
    doubtful = path.process(colour_frames(10))
    assert sure.packet is not None
    assert doubtful.packet is not None
    assert doubtful.fit is not None
    packet = decode_skeleton(doubtful.packet)
    assert packet.fit_confidence == pytest.approx(doubtful.fit.confidence, abs=0.01)
    assert packet.fit_confidence < 0.3 < decode_skeleton(sure.packet).fit_confidence


def test_a_rig_can_be_read_as_if_it_had_no_depth():
    rig = VirtualRig.start(RigSettings(cameras=2, width=64, height=48), depth=False)
    try:
        assert not rig.has_depth
        assert [room.shape for room in rig.empty_room if room is not None] == [(1, 48, 64, 3)] * 2
        frame = rig.read(10.0)
        assert isinstance(frame, ColourFrame)
        assert frame.shape == (48, 64)
        colour, room = frame.colour, rig.empty_room[frame.camera_index]
        assert colour is not None
        assert room is not None
        differs = (colour != room[0]).any(axis=2)
        assert 0.01 < differs.mean() < 0.4  # the performer, and nothing else
    finally:
        rig.close()
