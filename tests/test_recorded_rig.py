"""Recordings: written and read back, played in time, and refused or thinned out when they are broken."""

import json
import shutil
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from common.geometry.camera_model import Camera, pixel_rays
from common.geometry.rigid_transform import look_at
from sender.capture.frame_set import CaptureError, DepthFrame, EndOfFrames
from sender.capture.recorded_rig import RecordedRig, open_recording
from sender.capture.recording_folder import write_recording

LAPTOP = Path(__file__).parents[1] / ".." / "shared" / "data" / "rgbd" / "kinect2_laptop"
PERIOD_NS = 20_000_000
CAMERAS = (
    Camera("left", 16, 12, 14.0, 15.0, 7.25, 5.5, look_at([1, 1, 2], [0, 1, 0]), np.array([0.1, -0.2, 0, 0, 0])),
    Camera("right", 20, 10, 18.0, 18.0, 9.5, 4.5, look_at([-1, 1, 2], [0, 1, 0])),
)


def frames(count: int = 4) -> list[DepthFrame]:
    rng = np.random.default_rng(0)
    made = []
    for number in range(count):
        for index, camera in enumerate(CAMERAS):
            depth = rng.integers(0, 5000, (camera.height, camera.width), np.uint16)
            colour = rng.integers(0, 255, (camera.height, camera.width, 3), np.uint8) if index == 0 else None
            made.append(DepthFrame(index, number, 10**12 + number * PERIOD_NS + index * 1_000_000, depth, colour))
    return made


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rooms = [np.full((12, 16), 4321, np.uint16), None]
    write_recording(tmp_path / "rec", CAMERAS, frames(), 50.0, rooms)
    return tmp_path / "rec"


def play(path: Path, **options: bool) -> tuple[list[DepthFrame], RecordedRig]:
    with closing(RecordedRig.open(path, **({"realtime": False} | options))) as rig:
        played = []
        try:
            while (frame := rig.read(1.0)) is not None and len(played) < 100:
                played.append(frame)
        except EndOfFrames:
            pass
    return played, rig


def change(folder: Path, edit: dict[str, Any], camera: int | None = None) -> None:
    """Overwrite fields of recording.json, or of one of its cameras; a value of ... removes the field."""
    file = folder / "recording.json"
    content = json.loads(file.read_text())
    target = content if camera is None else content["cameras"][camera]
    for key, value in edit.items():
        if value is ...:
            del target[key]
        else:
            target[key] = value
    file.write_text(json.dumps(content))


def test_what_was_written_is_read_back(folder: Path) -> None:
    played, rig = play(folder)
    written = frames()
    assert [(f.camera_index, f.sequence) for f in played] == [(f.camera_index, f.sequence) for f in written]
    for read, wrote in zip(played, written, strict=True):
        np.testing.assert_array_equal(read.depth_mm, wrote.depth_mm)
        assert read.depth_mm.dtype == np.uint16
        assert read.capture_ns - played[0].capture_ns == wrote.capture_ns - written[0].capture_ns
        if wrote.colour is None:
            assert read.colour is None
        else:
            assert read.colour is not None
            np.testing.assert_array_equal(read.colour, wrote.colour)
    assert rig.frame_rate_hz == 50
    assert rig.empty_room[1] is None
    assert (rig.empty_room[0] == 4321).all()  # type: ignore[union-attr]
    for camera, original in zip(rig.cameras, CAMERAS, strict=True):
        np.testing.assert_array_equal(camera.T_world_camera, original.T_world_camera)
        np.testing.assert_array_equal(camera.distortion, original.distortion)
        np.testing.assert_array_equal(camera.matrix, original.matrix)


def test_playing_in_time_keeps_the_distances_of_the_frames(folder: Path) -> None:
    with closing(RecordedRig.open(folder)) as rig:
        first = rig.read(1.0)
        assert first is not None
        for _ in range(5):
            frame = rig.read(1.0)
            assert frame is not None
            assert time.monotonic_ns() >= frame.capture_ns
        assert frame.capture_ns - first.capture_ns == 2 * PERIOD_NS + 1_000_000


def test_reading_times_out_before_the_next_frame_and_loses_nothing(folder: Path) -> None:
    change(folder, {"timestamps_ns": {str(n): n * 200_000_000 for n in range(4)}}, camera=0)
    shutil.rmtree(folder / "right")
    content = json.loads((folder / "recording.json").read_text())
    change(folder, {"cameras": content["cameras"][:1]})
    with closing(RecordedRig.open(folder)) as rig:
        assert rig.read(0.5) is not None
        assert rig.read(0.01) is None
        following = rig.read(1.0)
        assert following is not None
        assert following.sequence == 1


def test_a_loop_goes_on_in_time_and_numbers(folder: Path) -> None:
    played, _ = play(folder, loop=True)
    times = [f.capture_ns for f in played]
    assert len(played) == 100
    assert times == sorted(times)
    left = [f for f in played if f.camera_index == 0]
    assert [f.sequence for f in left[:9]] == list(range(9))
    np.testing.assert_array_equal(left[4].depth_mm, left[0].depth_mm)


def test_without_timestamps_the_frame_rate_counts(folder: Path) -> None:
    for camera in (0, 1):
        change(folder, {"timestamps_ns": ...}, camera)
    played, _ = play(folder)
    assert [f.capture_ns - played[0].capture_ns for f in played] == [n * PERIOD_NS for n in range(4) for _ in "lr"]


def test_cut_and_mask_are_applied(folder: Path) -> None:
    change(folder, {"near_m": 1.0, "far_m": 3.0}, camera=0)
    mask = np.zeros((12, 16), np.uint8)
    mask[:6] = 255
    (folder / "left" / "mask").mkdir()
    cv2.imwrite(str(folder / "left" / "mask" / "000001.png"), mask)
    played, _ = play(folder)
    originals = frames()
    for read, wrote in zip(played, originals, strict=True):
        expected = wrote.depth_mm.copy()
        if read.camera_index == 0:
            expected[(expected < 1000) | (expected > 3000)] = 0
            if read.sequence == 1:
                expected[6:] = 0
        np.testing.assert_array_equal(read.depth_mm, expected)


@pytest.mark.parametrize("fault", ["cut short", "not a picture", "8 bit", "wrong size", "colour gone bad"])
def test_a_broken_picture_drops_its_frame_and_says_which(folder: Path, fault: str) -> None:
    file = folder / "left" / "depth" / "000002.png"
    if fault == "cut short":
        file.write_bytes(file.read_bytes()[:60])
    elif fault == "not a picture":
        file.write_bytes(b"hello")
    elif fault == "8 bit":
        cv2.imwrite(str(file), np.zeros((12, 16), np.uint8))
    elif fault == "wrong size":
        cv2.imwrite(str(file), np.zeros((16, 12), np.uint16))
    else:
        file = folder / "left" / "color" / "000002.png"
        file.write_bytes(b"\x89PNG\r\n\x1a\n")
    played, rig = play(folder)
    assert len(played) == 7
    assert (0, 2) not in {(f.camera_index, f.sequence) for f in played}
    assert rig.dropped == 1
    assert str(file) in rig.last_error


@pytest.mark.parametrize(
    ("edit", "camera", "complaint"),
    [
        ({"format": "another"}, None, "not 'telepose recording'"),
        ({"version": 2}, None, "version 1"),
        ({"frame_rate_hz": 0}, None, "frame rate 0"),
        ({"frame_rate_hz": "fast"}, None, "fast"),
        ({"cameras": ...}, None, "'cameras' is missing"),
        ({"cameras": []}, None, "no cameras"),
        ({"cameras": [7]}, None, r"recording\.json"),
        ({"fx": ...}, 0, "without 'fx'"),
        ({"fx": -1}, 0, "intrinsics"),
        ({"width": "wide"}, 0, "wide"),
        ({"T_world_camera": [[1, 2], [3, 4]]}, 0, "pose"),
        ({"T_world_camera": None}, 0, r"recording\.json"),
        ({"folder": "nowhere"}, 0, "nowhere"),
        ({"folder": "../.."}, 0, "outside the recording"),
        ({"empty_room": "/etc/hostname"}, 0, "outside the recording"),
        ({"empty_room": "left/gone.png"}, 0, r"gone\.png"),
        ({"timestamps_ns": {"0": 0}}, 0, "no timestamp for frame 1"),
        ({"timestamps_ns": [1, 2]}, 0, "timestamps_ns"),
        ({"near_m": "far"}, 0, r"recording\.json"),
    ],
)
def test_a_malformed_recording_is_refused_with_the_fault(
    folder: Path, edit: dict[str, Any], camera: int | None, complaint: str
) -> None:
    change(folder, edit, camera)
    with pytest.raises(CaptureError, match=complaint):
        open_recording(folder)


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no recording here"):
        open_recording(tmp_path)
    (tmp_path / "recording.json").write_text("{")
    with pytest.raises(CaptureError, match=r"recording\.json"):
        open_recording(tmp_path)
    (tmp_path / "recording.json").write_text("[]")
    with pytest.raises(CaptureError, match="not a JSON object"):
        open_recording(tmp_path)


def test_an_existing_recording_is_not_written_over(folder: Path) -> None:
    with pytest.raises(CaptureError, match="not empty"):
        write_recording(folder, CAMERAS, frames(), 50.0)


def test_a_camera_without_frames_is_refused(folder: Path) -> None:
    for file in (folder / "right" / "depth").iterdir():
        file.unlink()
    with pytest.raises(CaptureError, match="no frames"):
        open_recording(folder)


@pytest.mark.skipif(not LAPTOP.exists(), reason="shared data is not there")
def test_depthkit_clip_faces_the_world_from_in_front() -> None:
    recording = open_recording(LAPTOP)
    assert len(recording.frames) == 48
    assert recording.frame_rate_hz == 24
    camera = recording.cameras[0]
    depth, colour = recording.load(0, 0)
    assert colour is not None
    assert depth[depth > 0].min() >= 520
    assert depth.max() <= 1260
    points = (pixel_rays(camera) * (depth[..., None] / 1000))[depth > 0]
    world = points @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    assert np.abs(np.median(world[:, [0, 2]], axis=0)).max() < 0.05
    assert camera.T_world_camera[1, 3] == pytest.approx(1.1)
    assert camera.T_world_camera[2, 3] > 0.5
    np.testing.assert_allclose(camera.T_world_camera[:3, 2], [0, 0, -1])


def test_depthkit_clip_without_frame_rate_is_refused(tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    cv2.imwrite(str(tmp_path / "depth" / "0000.png"), np.full((4, 6), 900, np.uint16))
    content = {"width": 6, "height": 4, "fx": 5, "fy": 5, "cx": 3, "cy": 2}
    (tmp_path / "intrinsics.json").write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="'fps' is missing"):
        open_recording(tmp_path)
    (tmp_path / "intrinsics.json").write_text(json.dumps(content | {"fps": 10}))
    assert len(open_recording(tmp_path).frames) == 1
