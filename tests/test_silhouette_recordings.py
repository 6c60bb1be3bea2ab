"""Recordings of colour cameras without depth: our own folders, and videos or silhouettes with a calibration."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from common.geometry.camera_model import Camera, project
from sender.capture.calibrated_videos import CalibratedVideos
from sender.capture.frame_set import CaptureError, ColourFrame, EndOfFrames
from sender.capture.recorded_rig import RecordedRig, open_recording
from sender.capture.recording_folder import write_recording
from sender.reconstruction.hull_people import connected_volumes, realness
from sender.reconstruction.hull_points import surface_points
from sender.reconstruction.silhouette import SilhouetteModel
from sender.reconstruction.visual_hull import VisualHull

W, H = 64, 48
CAMERAS = [Camera(f"cam{i}", W, H, 60.0, 60.0, 31.5, 23.5, np.eye(4)) for i in (1, 2)]
REAL = Path(__file__).parents[2] / "shared" / "data" / "rgbd"
Z_UP = {"K": [[60, 0, 31.5], [0, 61, 23.5], [0, 0, 1]], "dist_k1k2p1p2k3": [-0.1, 0, 0, 0, 0]}
# Two metres along the world's −y and one up, looking along +y: camera x is world x, camera y is −z, camera z is y.
LOOKING_NORTH = {"R_world_to_cam": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "t_world_to_cam_mm": [0, 1000, 2000]}


def picture(value: int) -> np.ndarray:
    return np.full((H, W, 3), (value, 2 * value, 40), np.uint8)


def frames(count: int = 3, silhouettes: bool = False) -> list[ColourFrame]:
    made = []
    for number in range(count):
        for index in range(len(CAMERAS)):
            silhouette = np.full((H, W), 255 * (number % 2), np.uint8) if silhouettes else None
            colour = None if silhouettes else picture(20 + 10 * number + index)
            made.append(ColourFrame(index, number, 10**12 + number * 40_000_000, colour, silhouette))
    return made


def played(path: Path) -> tuple[list[ColourFrame], RecordedRig]:
    rig = RecordedRig.open(path, realtime=False)
    read: list[ColourFrame] = []
    try:
        while True:
            frame = rig.read(1.0)
            assert isinstance(frame, ColourFrame)
            read.append(frame)
    except EndOfFrames:
        return read, rig
    finally:
        rig.close()


def video(file: Path, values: list[int], size: tuple[int, int] = (W, H)) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 25, size)
    for value in values:
        writer.write(np.full((size[1], size[0], 3), value, np.uint8))
    writer.release()


def calibrated(path: Path, **changed: Any) -> Path:
    cameras = dict.fromkeys(("cam1", "cam2"), Z_UP | LOOKING_NORTH)
    content = {"image_size": [W, H], "fps": 25, "cameras": cameras} | changed
    (path / "calibration.json").write_text(json.dumps(content))
    return path


def two_videos(path: Path, **changed: Any) -> Path:
    for name in ("cam1", "cam2"):
        video(path / name / "video.avi", [40, 80, 120, 160])
        video(path / name / "background.avi", [10] * 6)
    return calibrated(path, **changed)


def test_a_folder_of_colour_comes_back_with_its_empty_room(tmp_path: Path):
    write_recording(tmp_path, CAMERAS, frames(), 25, [picture(5)[None], picture(6)[None]])
    read, rig = played(tmp_path)
    assert not rig.has_depth
    assert len(read) == 6
    for got, wrote in zip(read, frames(), strict=True):
        assert got.silhouette is None
        np.testing.assert_array_equal(got.colour, wrote.colour)
    np.testing.assert_array_equal(rig.empty_room[1], picture(6)[None])


def test_a_folder_of_silhouettes_needs_no_empty_room(tmp_path: Path):
    write_recording(tmp_path, CAMERAS, frames(silhouettes=True), 25)
    read, rig = played(tmp_path)
    assert rig.empty_room == (None, None)
    for got, wrote in zip(read, frames(silhouettes=True), strict=True):
        assert got.colour is None
        np.testing.assert_array_equal(got.silhouette, wrote.silhouette)


def test_colour_alone_is_refused_without_an_empty_room(tmp_path: Path):
    write_recording(tmp_path, CAMERAS, frames(), 25)
    with pytest.raises(CaptureError, match=r"recording\.json: camera cam1: colour alone needs an empty_room"):
        open_recording(tmp_path)


def test_depth_for_some_cameras_only_is_refused(tmp_path: Path):
    write_recording(tmp_path, CAMERAS, frames(silhouettes=True), 25)
    (tmp_path / "cam2" / "depth").mkdir()
    with pytest.raises(CaptureError, match="cam1 have no depth"):
        open_recording(tmp_path)


def test_a_calibration_with_z_up_in_millimetres_becomes_metres_with_y_up(tmp_path: Path):
    recording = open_recording(two_videos(tmp_path))
    assert isinstance(recording, CalibratedVideos)
    camera = recording.cameras[0]
    np.testing.assert_allclose(camera.T_world_camera[:3, 3], [0, 1, 2], atol=1e-9)  # 2 m south is +z
    ahead, depth = project(camera, np.array([[0.0, 1.0, 0.0]]))
    np.testing.assert_allclose(ahead[0], [31.5, 23.5], atol=1e-6)
    assert depth[0] == pytest.approx(2.0)
    higher, _ = project(camera, np.array([[0.0, 1.5, 0.0]]))
    assert higher[0, 1] < 23.5
    assert camera.distortion[0] == -0.1


def test_videos_play_in_order_with_the_empty_room(tmp_path: Path):
    read, rig = played(two_videos(tmp_path))
    assert [(f.camera_index, f.sequence) for f in read] == [(c, n) for n in range(4) for c in range(2)]
    assert [int(np.median(f.colour)) for f in read[::2] if f.colour is not None] == pytest.approx(
        [40, 80, 120, 160], abs=3
    )
    times = [frame.capture_ns - read[0].capture_ns for frame in read[::2]]
    assert times == [0, 40_000_000, 80_000_000, 120_000_000]
    assert rig.empty_room[0] is not None
    assert rig.empty_room[0].shape == (6, H, W, 3)
    recording = open_recording(tmp_path)
    backwards = [int(np.median(recording.load(0, number)[1])) for number in (3, 0, 2)]  # type: ignore[arg-type]
    assert backwards == pytest.approx([160, 40, 120], abs=3)


def test_silhouettes_go_before_a_video(tmp_path: Path):
    for name in ("cam1", "cam2"):
        (tmp_path / name / "silhouette").mkdir(parents=True)
        for number in (3, 4):
            cv2.imwrite(str(tmp_path / name / "silhouette" / f"{number:04d}.png"), np.full((H, W), 255, np.uint8))
    read, rig = played(calibrated(tmp_path))
    assert [(f.camera_index, f.sequence) for f in read] == [(0, 3), (1, 3), (0, 4), (1, 4)]
    assert read[0].colour is None
    assert read[0].silhouette is not None
    assert (read[0].silhouette == 255).all()
    assert rig.empty_room == (None, None)


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"fps": "often"}, "could not convert"),
        ({"fps": 0}, "0.0 frames a second"),
        ({"image_size": [W]}, "values to unpack"),
        ({"cameras": {}}, "no cameras"),
        ({"cameras": []}, "no attribute"),
        ({"cameras": {"cam1": Z_UP}}, "'R_world_to_cam' is missing"),
        ({"cameras": {"cam1": Z_UP | LOOKING_NORTH | {"K": [1, 2]}}}, "cam1: K"),
        ({"cameras": {"../cam1": Z_UP | LOOKING_NORTH}}, "not a folder's name"),
        ({"cameras": {"cam1": Z_UP | LOOKING_NORTH | {"R_world_to_cam": [[1, 2, 3]] * 3}}}, "rigid"),
    ],
)
def test_a_malformed_calibration_is_refused_by_name(tmp_path: Path, changed: dict[str, Any], fault: str):
    with pytest.raises(CaptureError, match=fault) as refused:
        open_recording(two_videos(tmp_path, **changed))
    assert "calibration.json" in str(refused.value)


def test_missing_and_broken_videos_are_refused_by_name(tmp_path: Path):
    two_videos(tmp_path)
    (tmp_path / "cam2" / "background.avi").write_bytes(b"no video")
    with pytest.raises(CaptureError, match=r"cam2/background\.avi: no video"):
        open_recording(tmp_path)
    video(tmp_path / "cam2" / "background.avi", [1, 2], (32, 24))
    with pytest.raises(CaptureError, match=r"cam2/background\.avi: 32×24, not 64×48"):
        open_recording(tmp_path)
    (tmp_path / "cam1" / "video.avi").unlink()
    with pytest.raises(CaptureError, match=r"cam1/video\.avi: no video"):
        open_recording(tmp_path)


@pytest.mark.skipif(not (REAL / "uu_seated_4cam").is_dir(), reason="no ../shared/data/rgbd/uu_seated_4cam")
def test_the_seated_persons_hull_is_a_seated_person():
    recording = open_recording(REAL / "uu_seated_4cam")
    views = []
    for index, camera in enumerate(recording.cameras):
        model = SilhouetteModel(camera, recording.empty_room[index])
        views.append(model.silhouette(ColourFrame(index, 0, 0, recording.load(index, 0)[1])))
    cloud = surface_points(VisualHull(views), 2500)
    volumes = connected_volumes(cloud.positions)
    person = cloud.positions[volumes == 0]
    assert len(person) > 0.8 * len(cloud)
    assert person[:, 1].max() == pytest.approx(1.40, abs=0.08)  # as its README says, the chair included
    assert np.percentile(person[:, 1], 1) == pytest.approx(0.0, abs=0.08)  # on the floor
    assert np.ptp(person[:, [0, 2]], axis=0).max() < 1.3


@pytest.mark.skipif(not (REAL / "uu_walkers_4cam").is_dir(), reason="no ../shared/data/rgbd/uu_walkers_4cam")
def test_the_walkers_hull_has_four_people():
    recording = open_recording(REAL / "uu_walkers_4cam")
    models = [SilhouetteModel(camera, None) for camera in recording.cameras]
    views = [
        model.silhouette(ColourFrame(index, 0, 0, None, recording.load(index, 0)[0]))
        for index, model in enumerate(models)
    ]
    cloud = surface_points(VisualHull(views), 10_000)
    volumes = connected_volumes(cloud.positions)
    real = realness(cloud.positions, volumes, [view.camera for view in views])
    heights = [np.ptp(cloud.positions[volumes == index, 1]) for index in np.flatnonzero(real > 0.4)]
    assert len(heights) == 4
    assert all(1.6 < height < 2.15 for height in heights)
