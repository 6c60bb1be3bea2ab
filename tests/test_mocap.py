"""Motion capture files: kinematics against the data set's own reference, and what is said about broken files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sender.capture.mocap import METRES_PER_UNIT, MocapError, clip_names, read_clip

MOCAP = Path(__file__).parents[1] / "../shared/data/mocap"
needs_clips = pytest.mark.skipif(not MOCAP.exists(), reason="motion capture data not there (../shared/data/mocap)")

SKELETON = """# a comment
:version 1.10
:units
  length 0.45
:bonedata
  begin
    id 1
    name lfemur
    direction 0 -1 0
    length 8
    axis 0 0 20 XYZ
    dof rx ry rz
  end
  begin
    id 2
    name ltibia
    direction 0 -2 0
    length 7
    axis 0 0 0 XYZ
    dof rx
  end
:hierarchy
  begin
    root lfemur
    lfemur ltibia
  end
"""
ANGLES = """:FULLY-SPECIFIED
:DEGREES
1
root 0 0 0 0 0 0
lfemur 0 0 0
ltibia 0
2
root 1 20 3 0 90 0
ltibia 90
lfemur 0 0 0
"""


def write_clip(folder: Path, skeleton: str = SKELETON, angles: str = ANGLES) -> Path:
    (folder / "a.asf").write_text(skeleton)
    (folder / "a.amc").write_text(angles)
    (folder / "clips.json").write_text(json.dumps({"walk": {"asf": "a.asf", "amc": "a.amc", "fps": 60}}))
    return folder


@needs_clips
def test_every_clip_matches_the_reference_positions_to_a_millimetre() -> None:
    reference = json.loads((MOCAP / "fk_reference.json").read_text())
    for name in clip_names(MOCAP):
        clip = read_clip(MOCAP, name)
        joints = [clip.bone(joint) for joint in reference[name]["joints"]]
        for frame, positions in reference[name]["frames"].items():
            np.testing.assert_allclose(clip.tails[int(frame), joints], positions, atol=1e-3, err_msg=name)


@needs_clips
def test_clip_has_the_rate_and_frames_the_list_promises() -> None:
    table = json.loads((MOCAP / "clips.json").read_text())
    name = clip_names(MOCAP)[0]
    clip = read_clip(MOCAP, name)
    assert clip.frame_rate_hz == table[name]["fps"]
    assert clip.rotations.shape == (table[name]["n_frames"], 31, 3, 3)


def test_bones_hang_together_and_turn_with_their_parents(tmp_path: Path) -> None:
    clip = read_clip(write_clip(tmp_path), "walk")
    assert clip.bones == ("root", "lfemur", "ltibia")
    hip, knee, ankle = np.array([0, 0, 0]), np.array([0, -8, 0]), np.array([0, -15, 0])
    np.testing.assert_allclose(clip.tails[0] / METRES_PER_UNIT, [hip, knee, ankle], atol=1e-9)
    # Second frame: heading 90 degrees about y (the person's front, +z, to +x); the knee bends the shin backwards.
    hip, knee, ankle = np.array([1, 20, 3]), np.array([1, 12, 3]), np.array([1 - 7, 12, 3])
    np.testing.assert_allclose(clip.tails[1] / METRES_PER_UNIT, [hip, knee, ankle], atol=1e-9)


def test_bone_axes_turn_the_sense_of_its_angles(tmp_path: Path) -> None:
    angles = ANGLES.replace("lfemur 0 0 0\nltibia 0", "lfemur 0 90 0\nltibia 0")
    clip = read_clip(write_clip(tmp_path, angles=angles), "walk")
    along_its_y = np.array([-np.sin(np.deg2rad(20)), np.cos(np.deg2rad(20)), 0])  # Rz(20 deg) of y
    np.testing.assert_allclose(clip.rotations[0, 1] @ along_its_y, along_its_y, atol=1e-9)
    assert np.trace(clip.rotations[0, 1]) == pytest.approx(1.0)  # a right angle


def test_unknown_motion_lists_those_there_are(tmp_path: Path) -> None:
    with pytest.raises(MocapError, match=r"no motion 'swim' .* there are: walk"):
        read_clip(write_clip(tmp_path), "swim")


def test_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(MocapError, match=r"nowhere.clips\.json"):
        clip_names(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("skeleton", "angles", "message"),
    [
        (SKELETON, ANGLES.replace("ltibia 90", "ltibia 90 1"), r"a\.amc:9: expected 1 finite numbers, got '90 1'"),
        (SKELETON, ANGLES.replace("ltibia 90", "ltibia x"), r"a\.amc:9: could not convert"),
        (SKELETON, ANGLES.replace("ltibia 90\n", ""), r"a\.amc: 2 frames, incomplete for ltibia"),
        (SKELETON, ANGLES.replace("ltibia 90", "tail 90"), r"a\.amc:9: 'tail' is not a moving bone"),
        (SKELETON, ANGLES.replace("ltibia 90", "ltibia 90\nltibia 9"), r"a\.amc:10: ltibia is out of place in frame 2"),
        (SKELETON, ":DEGREES\n", r"a\.amc: 0 frames"),
        (SKELETON.replace("lfemur ltibia", "hip ltibia"), ANGLES, r"a\.asf: the hierarchy does not connect ltibia"),
        (SKELETON.replace("direction 0 -2 0", "direction 0 0 0"), ANGLES, r"a\.asf:21: bone ltibia has no direction"),
        (SKELETON.replace("    length 7\n", ""), ANGLES, r"a\.asf:20: bone without length"),
        (SKELETON.replace("dof rx ry rz", "dof rx ry tz"), ANGLES, r"lfemur has angles .*, expected rx, ry, rz"),
    ],
)
def test_broken_files_are_refused_with_place_and_reason(
    tmp_path: Path, skeleton: str, angles: str, message: str
) -> None:
    with pytest.raises(MocapError, match=message):
        read_clip(write_clip(tmp_path, skeleton, angles), "walk")


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_text_is_read_or_refused_never_anything_else(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    lines = (SKELETON + "\0" + ANGLES).splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        index = data.draw(st.integers(0, len(lines) - 1))
        lines[index] = data.draw(
            st.sampled_from(["", "end", "begin", "name", "3", ":hierarchy", "root", "axis", lines[index][:-2]])
        )
    skeleton, _, angles = "\n".join(lines).partition("\0")
    folder = write_clip(tmp_path_factory.mktemp("damaged"), skeleton, angles)
    try:
        clip = read_clip(folder, "walk")
    except MocapError:
        return
    assert np.isfinite(clip.tails).all()
