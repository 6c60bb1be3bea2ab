"""Recorded skeletons: read, refused when broken, played, and sent as our own skeletons through the sender's path."""

from __future__ import annotations

import dataclasses
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from common.body.skeleton import LINK_INDEX
from common.body.skeleton_pose import named_joint_positions
from common.runtime.clock import ManualClock, MonotonicClock
from common.runtime.stage_timer import StageTimer
from common.wire.body_message import decode_body
from common.wire.skeleton_packet import decode_skeleton
from sender.capture.capture_thread import CaptureThread
from sender.capture.frame_set import CaptureError, EndOfFrames, FrameSet
from sender.capture.open_source import open_source
from sender.capture.outside_skeleton import (
    KINECT_V1_JOINTS,
    KINECT_V2_JOINTS,
    OutsideSkeleton,
    Sensor,
    SkeletonRecording,
)
from sender.capture.recorded_skeletons import RecordedSkeletons
from sender.capture.skeleton_recording import open_skeleton_recording, write_skeleton_recording
from sender.capture.synchronizer import Synchronizer
from sender.capture.utd_mhad import UtdMhadSequence
from sender.config import CaptureSettings
from sender.fitting.open_tracker import open_tracker
from sender.fitting.outside_joints import sensor_joints
from sender.fitting.outside_tracker import OutsideTracker
from sender.pipeline import SkeletonPath, StreamIdentity, TrackedFrame
from sender.reconstruction.person_points import HullReconstruction
from tests.capsule_person import SKELETON, pose_at
from tests.outside_people import FRAME_NS, SENSORS, person_at, recording, row_of, seen

DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "rgbd"
PAIR, UTD = DATA / "kinect2_pair_skeletons", DATA / "utd_mhad"


def path_of(recorded: SkeletonRecording) -> SkeletonPath:
    clock = ManualClock()
    outside = OutsideTracker(recorded.kind, recorded.sensors)
    tracker, timer = open_tracker("gauss-newton"), StageTimer(clock)
    return SkeletonPath(
        StreamIdentity(0, 5), HullReconstruction((), (), 2500, False), tracker, 30.0, timer, clock, None, outside
    )


def sent(recorded: SkeletonRecording) -> list[TrackedFrame]:
    path, frames = path_of(recorded), []
    source = RecordedSkeletons(recorded, realtime=False)
    try:
        while (instant := source.read(1.0)) is not None:
            frames.append(path.process(instant))
    except EndOfFrames:
        return frames
    raise AssertionError("the recording stopped without an end")


@pytest.mark.parametrize("kind", ["kinect-v1", "kinect-v2"])
def test_skeletons_go_out_as_packets_that_a_receiver_can_show(kind):
    frames = sent(recording(30, kind))
    assert all(frame.packet is not None for frame in frames)
    assert all(len(frame.packet or b"") <= 250 for frame in frames)
    assert not any(frame.views for frame in frames)
    body = decode_body([frame.body for frame in frames if frame.body is not None][-1]).skeleton
    packet = decode_skeleton(frames[-1].packet or b"")
    away = named_joint_positions(body, packet.pose) - named_joint_positions(SKELETON, pose_at(29 * FRAME_NS / 1e9))
    assert np.linalg.norm(away, axis=1).max() < 0.025
    assert packet.fit_confidence > 0.95
    assert len([frame for frame in frames if frame.body is not None]) <= 6  # sizes settle


def test_what_no_sensor_tracks_is_not_believed_by_the_receiver_either():
    instants = []
    for frame in range(10):
        confidence = np.ones(25)
        confidence[[row_of("right_elbow"), row_of("right_wrist")]] = 0.0
        instants.append((seen(frame, 0, person_at(frame), confidence),))
    frames = sent(dataclasses.replace(recording(), instants=tuple(instants)))
    pose = decode_skeleton(frames[-1].packet or b"").pose
    assert pose.confidence[LINK_INDEX["right_forearm"]] == 0
    assert pose.confidence[LINK_INDEX["left_forearm"]] == 1


def test_without_a_trunk_there_is_no_skeleton_and_the_status_says_why():
    confidence = np.ones(25)
    confidence[row_of("spine_base")] = 0.0
    tracker = OutsideTracker("kinect-v2", SENSORS)
    assert tracker.track((seen(0, 0, person_at(0), confidence),)) is None
    assert "trunk" in tracker.status


def test_what_was_written_is_read_back(tmp_path):
    file, written = tmp_path / "two.jsonl", recording(5)
    write_skeleton_recording(file, written)
    read = open_skeleton_recording(file)
    assert (read.kind, read.sensors, read.frame_rate_hz) == (written.kind, written.sensors, written.frame_rate_hz)
    for ours, theirs in zip(written.instants, read.instants, strict=True):
        for a, b in zip(ours, theirs, strict=True):
            assert (a.capture_ns, a.sensor) == (b.capture_ns, b.sensor)
            np.testing.assert_allclose(a.joints, b.joints, atol=1e-4)
            np.testing.assert_allclose(a.confidence, b.confidence, atol=1e-3)


def lines_of(file: Path) -> list[Any]:
    return [json.loads(line) for line in file.read_text().splitlines()]


def test_a_joint_that_is_null_is_not_tracked(tmp_path):
    file = tmp_path / "one.jsonl"
    write_skeleton_recording(file, recording(2))
    lines = lines_of(file)
    del lines[1]["skeletons"][0]["confidence"]
    lines[1]["skeletons"][0]["joints"][3] = None
    file.write_text("\n".join(map(json.dumps, lines)))
    skeleton = open_skeleton_recording(file).instants[0][0]
    assert skeleton.confidence[3] == 0
    assert skeleton.confidence.sum() == 24


@pytest.mark.parametrize(
    ("line", "change", "complaint"),
    [
        (0, {"format": "telepose recording"}, "line 1: not 'telepose skeletons'"),
        (0, {"version": 2}, "line 1"),
        (0, {"joints": "kinect-v3"}, "line 1: joints 'kinect-v3'"),
        (0, {"frame_rate_hz": 0}, "line 1: frame rate 0"),
        (0, {"sensors": []}, "line 1: 0 sensors"),
        (0, {"sensors": [{"name": "a"}]}, "line 1: 'position' is missing"),
        (0, {"sensors": [{"name": "a", "position": [0, 1]}]}, "line 1: sensor a"),
        (2, {"skeletons": []}, "line 3: skeletons of sensors"),
        (2, {"skeletons": 7}, "line 3"),
        (2, {"sensor": 2}, "line 3: skeletons of sensors"),
        (2, {"sensor": 1}, "line 3: skeletons of sensors"),
        (2, {"time_ns": -1}, "line 3: time_ns"),
        (2, {"joints": [[0, 0, 0]] * 24}, "line 3: 24 joints, kinect-v2 has 25"),
        (2, {"joints": [[0, 0, float("nan")]] * 25}, "line 3: a joint is not finite"),
        (2, {"joints": [[0, 0, 1e300]] * 25}, "line 3: a joint is not finite"),
        (2, {"joints": [[0, 0]] * 25}, "line 3"),
        (2, {"joints": "x" * 25}, "line 3"),
        (2, {"confidence": [1] * 24}, "line 3: confidence is"),
        (2, {"confidence": [2] * 25}, "line 3: a confidence lies outside"),
    ],
)
def test_a_malformed_file_is_refused_with_file_line_and_fault(tmp_path, line, change, complaint):
    file = tmp_path / "bad.jsonl"
    write_skeleton_recording(file, recording(3))
    lines = lines_of(file)
    target = lines[line] if line == 0 or "skeletons" in change else lines[line]["skeletons"][0]
    target.update(change)
    file.write_text("\n".join(map(json.dumps, lines)))
    with pytest.raises(CaptureError, match=complaint) as refused:
        open_skeleton_recording(file)
    assert str(file) in str(refused.value)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "line 1"),
        (b"[[", "line 1"),
        (b"[" * 60_000, "line 1"),
        (b"7\n", "line 1"),
        (b"\xff\xfe\x00", "utf-8"),
        (b"x" * 100_000, "longer than"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path, content, complaint):
    file = tmp_path / "bad.jsonl"
    file.write_bytes(content)
    with pytest.raises(CaptureError, match=complaint):
        open_skeleton_recording(file)
    with pytest.raises(CaptureError, match=r"gone\.jsonl"):
        open_skeleton_recording(tmp_path / "gone.jsonl")


def test_a_file_cut_short_and_times_that_run_back_are_refused(tmp_path):
    file = tmp_path / "bad.jsonl"
    write_skeleton_recording(file, recording(3))
    whole = file.read_text()
    file.write_text(whole[:-40])
    with pytest.raises(CaptureError, match="line 4"):
        open_skeleton_recording(file)
    lines = whole.splitlines()
    file.write_text("\n".join([lines[0], lines[2], lines[1]]))
    with pytest.raises(CaptureError, match="line 3: earlier"):
        open_skeleton_recording(file)
    file.write_text(lines[0])
    with pytest.raises(CaptureError, match="not a single skeleton"):
        open_skeleton_recording(file)


@pytest.mark.parametrize(
    ("joints", "confidence"), [(np.zeros((21, 3)), np.ones(21)), (np.zeros((20, 2)), np.ones(20)), (np.zeros(20), 1)]
)
def test_a_skeleton_of_unknown_shape_is_refused(joints, confidence):
    with pytest.raises(ValueError, match="joints are"):
        OutsideSkeleton(0, 0, joints, np.asarray(confidence))


def test_a_recording_plays_in_its_own_time_and_goes_round(tmp_path):
    file = tmp_path / "two.jsonl"
    write_skeleton_recording(file, recording(3))
    source = open_source(CaptureSettings(source="recording", recording=file, loop=True))
    assert isinstance(source, RecordedSkeletons)
    times = []
    while len(times) < 7:
        frames = source.read(0.5)
        assert isinstance(frames, FrameSet)
        assert {skeleton.capture_ns for skeleton in frames.skeletons} == {frames.capture_ns}
        assert MonotonicClock().now_ns() >= frames.capture_ns
        times.append(frames.capture_ns)
    np.testing.assert_allclose(np.diff(times), FRAME_NS, atol=2)
    assert source.read(0.001) is None
    source.close()


async def test_the_capture_thread_hands_sets_of_skeletons_on(tmp_path):
    delivered: list[FrameSet] = []
    done = threading.Event()
    source = RecordedSkeletons(recording(4), realtime=False)
    thread = CaptureThread(source, Synchronizer(0, 1, 1, []), delivered.append, MonotonicClock())
    await thread.run()
    done.set()
    assert [len(frames.skeletons) for frames in delivered] == [2] * 4
    assert thread.sets == 4


def table(rows: list[str]) -> str:
    columns = "Study,KinectConfig,Scenario,Tracker_Time,Person#,Skeleton#,Skeleton_Time,Skeleton_Init_Angle,"
    columns += "Skeleton_Init_Dist,Kinect#,Kinect_Tilt_Angle,Kinect_Height"
    parts = [joint.split("_") for joint in KINECT_V2_JOINTS]
    names = ["".join(w.capitalize() for w in (p[1:] + p[:1] if p[0] in ("left", "right") else p)) for p in parts]
    return "\n".join([",".join([columns, *(f"{name}_{axis}" for name in names for axis in "XYZ")]), *rows])


def table_row(tracker_ms: int, ticks: int, sensor: str, angle: float = 0.0) -> str:
    joints = ",".join(f"{v:.5f}" for v in (person_at(0) * (-1, 1, -1) + (0, -1, 2.5)).ravel())
    return f"12,0,1,{tracker_ms},0,0,{ticks},{angle},2.5,{sensor},0,100,{joints}"


def test_a_table_of_two_kinects_is_read_into_our_world(tmp_path):
    file = tmp_path / "table.csv"
    rows = [
        table_row(1000 + 35 * f, 5_000_000 + 330_000 * f + s, "ab"[s], -s * np.pi / 2)
        for f in (0, 1, 2)
        for s in (0, 1)
    ]
    file.write_text(table(rows))
    read = open_skeleton_recording(file)
    assert len(read.instants) == 3
    np.testing.assert_allclose(read.instants[0][0].joints, person_at(0), atol=1e-4)
    np.testing.assert_allclose(read.sensors[0].position, (0, 1, 2.5), atol=1e-4)
    np.testing.assert_allclose(np.abs(read.sensors[1].position), (2.5, 1, 0), atol=1e-4)
    assert read.instants[1][0].capture_ns - read.instants[0][0].capture_ns == 33_000_000


def test_older_rows_after_newer_ones_are_left_out(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text(table([table_row(1000 + 35 * i, ticks, "a") for i, ticks in enumerate((10, 30, 20, 40))]))
    times = [instant[0].capture_ns for instant in open_skeleton_recording(file).instants]
    assert times == [0, 2000, 3000]


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "no column Tracker_Time"),
        ("a,b\n1,2", "no column Tracker_Time"),
        (table([]), "no rows"),
        (table(["1,2,3"]), "line 2: 3 cells"),
        (
            table([table_row(1, 2, "a"), table_row(1, 2, "a").replace("2.5", "nan", 1)]),
            "line 3: a number is not finite",
        ),
        (table([table_row(1, 2, "a") + "x"]), "line 2: could not convert"),
    ],
)
def test_a_malformed_table_is_refused(tmp_path, content, complaint):
    file = tmp_path / "table.csv"
    file.write_text(content)
    with pytest.raises(CaptureError, match=complaint):
        open_skeleton_recording(file)


@pytest.mark.skipif(not PAIR.exists(), reason="shared data is not there")
def test_the_real_pair_stands_upright_before_its_sensors():
    read = open_skeleton_recording(next(PAIR.glob("*_Kinect_2_*.csv")))
    assert len(read.sensors) == 2
    assert len(read.instants) > 1500
    first = read.instants[0][0].joints
    assert 1.4 < first[row_of("head"), 1] < 1.8
    assert abs(first[row_of("left_foot"), 1]) < 0.15
    a, b = (np.array(sensor.position)[[0, 2]] for sensor in read.sensors)
    assert np.rad2deg(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))) == pytest.approx(72, abs=5)


@pytest.mark.skipif(not UTD.exists(), reason="shared data is not there")
def test_the_sdks_20_joints_of_a_kinect_v1_become_our_skeleton():
    sequence = UtdMhadSequence(UTD / "Depth" / "a1_s1_t1_depth.mat")
    order = ["head", "shoulder_centre", "spine", "hip_centre"]
    order += [f"{s}_{j}" for s in ("left", "right") for j in ("shoulder", "elbow", "wrist", "hand")]
    order += [f"{s}_{j}" for s in ("left", "right") for j in ("hip", "knee", "ankle", "foot")]
    rows = [order.index(joint) for joint in KINECT_V1_JOINTS]
    tracker = OutsideTracker("kinect-v1", [Sensor("kinect", (0.0, 1.0, 2.5))])
    for frame in range(40):
        joints = sequence.joints(frame)[rows]
        fit = tracker.track((seen(frame, 0, joints),))
        assert fit is not None
    ours = sensor_joints(fit.skeleton, fit.pose, "kinect-v1")
    assert np.linalg.norm(ours - joints, axis=1).mean() < 0.03  # its bones do not keep their lengths
