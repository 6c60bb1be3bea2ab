"""UTD-MHAD sequences: the world they are put into, and what is refused."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.skeleton import NAMED_JOINTS
from common.geometry.camera_model import pixel_rays, project
from sender.capture.frame_set import CaptureError
from sender.capture.recorded_rig import RecordedRig, open_recording
from sender.capture.utd_mhad import UtdMhadSequence

DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "rgbd" / "utd_mhad"
with_data = pytest.mark.skipif(not DATA.exists(), reason="shared data is not there")
SEQUENCES = ("a1_s1", "a10_s2", "a22_s4")


def sequence(name: str) -> UtdMhadSequence:
    return UtdMhadSequence(DATA / "Depth" / f"{name}_t1_depth.mat")


def cloud(recording: UtdMhadSequence, number: int) -> np.ndarray:
    """World points (N, 3) of a frame."""
    depth, _ = recording.load(0, number)
    camera = recording.cameras[0]
    points = (pixel_rays(camera) * (depth[..., None] / 1000))[depth > 0]
    return points @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]


@with_data
@pytest.mark.parametrize("name", SEQUENCES)
def test_person_stands_on_the_floor_at_the_origin_and_faces_the_camera(name: str) -> None:
    points = cloud(sequence(name), 0)
    assert np.percentile(points[:, 1], 0.5) == pytest.approx(0.0, abs=0.06)
    assert 1.5 < points[:, 1].max() < 1.95
    assert np.abs(np.median(points[:, [0, 2]], axis=0)).max() < 0.1
    joints = sequence(name).joints(0)
    left_shoulder, right_shoulder, head, left_foot = joints[4], joints[8], joints[0], joints[15]
    assert left_shoulder[0] > right_shoulder[0] + 0.15  # left is +X
    assert head[1] > 1.3
    assert abs(left_foot[1]) < 0.2


@with_data
@pytest.mark.parametrize("name", SEQUENCES)
def test_joints_lie_on_the_person_in_the_image(name: str) -> None:
    recording = sequence(name)
    on_person = []
    for number in range(0, len(recording.frames), 10):
        pixels, _ = project(recording.cameras[0], recording.joints(number))
        u, v = np.rint(pixels).astype(int).T
        depth, _ = recording.load(0, number)
        on_person.append((depth[v.clip(0, 239), u.clip(0, 319)] > 0).mean())
    assert np.mean(on_person) > 0.8


@with_data
def test_folder_opens_and_plays_its_first_sequence() -> None:
    rig = RecordedRig.open(DATA, realtime=False)
    frame = rig.read(1.0)
    rig.close()
    assert frame is not None
    assert frame.depth_mm.shape == (240, 320)
    assert frame.depth_mm.flags.c_contiguous
    assert frame.colour is None
    assert rig.frame_rate_hz == 30


def made(folder: Path, **variables: np.ndarray) -> Path:
    file = folder / "a1_s1_t1_depth.mat"
    scipy.io.savemat(file, variables)
    return file


def test_images_are_unmirrored_and_frames_come_in_order(tmp_path: Path) -> None:
    depth = np.zeros((24, 32, 3), np.uint16)
    depth[10, 2] = 2000, 2001, 2002
    recording = UtdMhadSequence(made(tmp_path, d_depth=depth))
    for number in range(3):
        image, _ = recording.load(0, number)
        assert image[10, 29] == 2000 + number
        assert np.count_nonzero(image) == 1


@pytest.mark.parametrize(
    ("variables", "complaint"),
    [
        ({"other": np.zeros(3)}, "no variable d_depth"),
        ({"d_depth": np.zeros((4, 5, 2))}, "float64"),
        ({"d_depth": np.zeros((4, 5), np.uint16)}, r"\(4, 5\)"),
        ({"d_depth": np.zeros((4, 5, 2), np.uint16)}, "no depth reading"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, variables: dict[str, np.ndarray], complaint: str) -> None:
    with pytest.raises(CaptureError, match=complaint):
        open_recording(made(tmp_path, **variables))


def test_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="gone"):
        open_recording(tmp_path / "gone.mat")
    (tmp_path / "Depth").mkdir()
    with pytest.raises(CaptureError, match="no \\*_depth"):
        open_recording(tmp_path)
    recording = UtdMhadSequence(made(tmp_path, d_depth=np.full((4, 5, 1), 9, np.uint16)))
    with pytest.raises(CaptureError, match="skeleton"):
        recording.joints(0)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damaged_files_raise_capture_errors_only(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    file = made(tmp_path_factory.mktemp("mat"), d_depth=np.full((4, 5, 2), 900, np.uint16))
    content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(content[: data.draw(st.integers(1, len(content)))])
    with contextlib.suppress(CaptureError):
        open_recording(file)


@with_data
def test_the_start_joints_are_the_sdks_in_our_order() -> None:
    recording = sequence("a1_s1")
    joints, sdk = recording.start_joints, recording.joints(0)
    assert joints is not None
    named = {name: joints[row] for row, (name, _) in enumerate(NAMED_JOINTS)}
    np.testing.assert_array_equal(named["left_wrist"], sdk[6])
    np.testing.assert_array_equal(named["right_knee"], sdk[17])
    assert named["pelvis"][1] < named["chest"][1] < named["neck"][1] < named["head"][1] < sdk[0][1]
    assert named["left_shoulder"][0] > named["right_shoulder"][0]  # facing us, the left hand is at +X
