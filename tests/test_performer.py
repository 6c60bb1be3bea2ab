"""Performers: the built-in person, the bodies of the data folder, and the motions they are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX, NAMED_JOINTS, human_skeleton
from common.geometry import quaternion
from sender.capture.body_performer import to_and_fro
from sender.capture.builtin_body import builtin_body
from sender.capture.choreography import ROUTINE_S
from sender.capture.frame_set import CaptureError
from sender.capture.mocap import clip_names
from sender.capture.performer import Performer, open_performer
from sender.capture.retarget import _swivelled
from sender.capture.skinned_body import SkinnedBody

DATA = Path(__file__).parents[1] / "../shared/data"
needs_data = pytest.mark.skipif(not (DATA / "bodies").exists(), reason="bodies not there (../shared/data)")
JOINT = {name: index for index, (name, _) in enumerate(NAMED_JOINTS)}
Floats = NDArray[np.floating]


@pytest.fixture(scope="module")
def body() -> SkinnedBody:
    return builtin_body()


@pytest.fixture(scope="module")
def person() -> Performer:
    return open_performer("builtin")


def bodies() -> list[str]:
    return sorted(file.stem for file in (DATA / "bodies").glob("*.npz"))


def joint_path(performer: Performer, start_s: float, stop_s: float, rate_hz: float = 60.0) -> Floats:
    return np.array([performer.named_joints(t) for t in np.arange(start_s, stop_s, 1 / rate_hz)], float)


def facing(joints: Floats) -> Floats:
    """Unit horizontal direction the hips face: from right to left, turned to the front."""
    across = joints[JOINT["left_hip"]] - joints[JOINT["right_hip"]]
    forward = np.cross(across, [0.0, 1.0, 0.0])
    unit: Floats = forward / np.linalg.norm(forward)
    return unit


# --- the built-in body -----------------------------------------------------------------------------------------


def test_builtin_surface_is_closed_and_faces_outwards(body: SkinnedBody) -> None:
    faces = body.point_of_vertex[body.mesh.faces]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
    a, b, c = (body.points[faces[:, k]].astype(float) for k in range(3))
    litres = 1000 * np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert 60 < litres < 85  # an adult weighs about as many kilograms


def test_builtin_mesh_is_textured_and_light_enough(body: SkinnedBody) -> None:
    mesh = body.mesh
    assert mesh.uv is not None
    assert mesh.texture is not None
    assert len(mesh.faces) < 25_000
    assert mesh.faces.dtype == np.int32
    assert mesh.vertex_colours.shape == (len(mesh.uv), 3)
    assert ((mesh.uv > 0) & (mesh.uv < 1)).all()
    height, width = mesh.texture.shape[:2]
    texels = (mesh.uv * [width, height]).astype(int)
    np.testing.assert_array_equal(mesh.texture[texels[:, 1], texels[:, 0]], mesh.vertex_colours)


def test_builtin_face_is_in_front_and_hair_behind(body: SkinnedBody) -> None:
    rest, colours = body.points[body.point_of_vertex], body.mesh.vertex_colours.astype(int)
    head = (rest[:, 1] > 1.62) & (rest[:, 1] < 1.72)
    front, back = (colours[head & side].mean(axis=0) for side in (rest[:, 2] > 0.08, rest[:, 2] < -0.08))
    assert front[0] > back[0] + 60


def test_builtin_proportions_are_not_those_fitting_starts_from(body: SkinnedBody) -> None:
    hip, knee, ankle = (body.heads[body.joint(name)] for name in ("LeftUpLeg", "LeftLeg", "LeftFoot"))
    lengths = np.linalg.norm(human_skeleton(1.79).tips, axis=1)
    average = lengths[LINK_INDEX["left_thigh"]] / lengths[LINK_INDEX["left_shin"]]
    assert abs(np.linalg.norm(knee - hip) / np.linalg.norm(ankle - knee) / average - 1) > 0.05


def test_weights_are_a_partition_and_do_not_leak_to_the_other_side(body: SkinnedBody) -> None:
    np.testing.assert_allclose(body.skin_weights.sum(axis=1), 1, atol=1e-6)
    names = np.array(body.joint_names)
    right_limb = np.isin(names, [n for n in names if n.startswith("Right") and n.endswith(("Arm", "Leg", "Foot"))])
    far_left = body.points[:, 0] > 0.1
    assert (body.skin_weights[far_left] * right_limb[body.skin_joints[far_left]]).max() < 1e-4


# --- skinning --------------------------------------------------------------------------------------------------


def test_skinning_agrees_with_the_plain_sum(body: SkinnedBody) -> None:
    rng = np.random.default_rng(3)
    local = quaternion.from_rotation_vector(rng.normal(0, 0.4, (len(body.parents), 3)))
    root = np.array([0.3, 1.1, -0.2])
    rotation, position = quaternion.to_matrix(local), np.zeros((len(local), 3))
    position[0] = root
    for j, parent in enumerate(body.parents[1:], 1):
        position[j] = position[parent] + rotation[parent] @ (body.heads[j] - body.heads[parent])
        rotation[j] = rotation[parent] @ rotation[j]
    moved = rotation[body.skin_joints] @ (body.points[:, None] - body.heads[body.skin_joints])[..., None]
    expected = np.sum(body.skin_weights[..., None] * (moved[..., 0] + position[body.skin_joints]), axis=1)
    transforms = body.joint_transforms(local, root)
    np.testing.assert_allclose(transforms[:, :, 3], position, atol=1e-12)
    np.testing.assert_allclose(body.surface(transforms), expected[body.point_of_vertex], atol=1e-5)


# --- the routine -----------------------------------------------------------------------------------------------


def test_starts_in_an_a_pose_on_the_floor_facing_z(person: Performer) -> None:
    joints, surface = person.named_joints(0.4), person.surface(0.4)
    assert surface.dtype == np.float32
    assert surface[:, 1].min() == pytest.approx(0, abs=2e-3)
    assert joints.shape == (16, 3)
    assert facing(joints)[2] > 0.999
    arm = joints[JOINT["left_wrist"]] - joints[JOINT["left_shoulder"]]
    assert np.rad2deg(np.arctan2(-arm[1], arm[0])) == pytest.approx(45, abs=5)
    lowest = surface[surface[:, 1] < 0.03]
    ankles = joints[[JOINT["left_ankle"], JOINT["right_ankle"]]]
    assert lowest[:, 2].max() > ankles[:, 2].max() + 0.15  # the feet point forward
    np.testing.assert_array_equal(person.surface(0.0), person.surface(0.99))


def test_goes_through_a_t_pose(person: Performer) -> None:
    joints = person.named_joints(2 + 6.9)
    for side in ("left", "right"):
        drop = joints[JOINT[f"{side}_shoulder"]] - joints[JOINT[f"{side}_wrist"]]
        assert abs(drop[1]) < 0.06
        assert abs(drop[0]) > 0.5


def test_turns_once_around(person: Performer) -> None:
    heading = np.array([facing(joints) for joints in joint_path(person, 2 + 14.6, 2 + 20, 30)])
    angle = np.unwrap(np.arctan2(heading[:, 0], heading[:, 2]))
    assert angle[-1] - angle[0] == pytest.approx(2 * np.pi, abs=0.05)
    assert np.diff(angle).min() > -0.02


def test_always_stands_on_the_floor_near_the_origin(person: Performer) -> None:
    for time_s in np.arange(2, 2 + ROUTINE_S, 0.37):
        assert person.surface(time_s)[:, 1].min() == pytest.approx(0, abs=2e-3)
    assert np.abs(joint_path(person, 0, 33, 10)[:, JOINT["pelvis"]][:, [0, 2]]).max() < 0.5


def test_the_foot_that_stands_does_not_slide_during_the_kick(person: Performer) -> None:
    kick = joint_path(person, 2 + 26.9, 2 + 28.1)
    assert np.ptp(kick[:, JOINT["left_ankle"]], axis=0).max() < 0.02
    assert np.ptp(kick[:, JOINT["right_ankle"]][:, 2]) > 0.8


def test_moves_as_a_person_can_and_loops_without_a_jump(person: Performer) -> None:
    path = joint_path(person, 0, 2 + ROUTINE_S + 2)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=2) * 60
    acceleration = np.linalg.norm(np.diff(path, 2, axis=0), axis=2) * 3600
    assert speed.max() < 6
    assert acceleration.max() < 80
    assert person.duration_s == pytest.approx(2 + ROUTINE_S)
    np.testing.assert_allclose(person.surface(5.25 + ROUTINE_S), person.surface(5.25), atol=1e-5)


# --- playing to and fro ----------------------------------------------------------------------------------------


@given(st.floats(0, 100), st.floats(0.6, 30))
def test_to_and_fro_stays_on_the_track_and_never_runs_faster(time_s: float, length_s: float) -> None:
    here, later = to_and_fro(time_s, length_s, 0.25), to_and_fro(time_s + 0.01, length_s, 0.25)
    assert 0 <= here <= length_s
    assert abs(later - here) <= 0.01 + 1e-9


def test_to_and_fro_reaches_both_ends_and_turns_gently() -> None:
    places = np.array([to_and_fro(t, 3.0, 0.25) for t in np.arange(0, 6.5 + 1e-9, 0.01)])
    assert places[0] == pytest.approx(0)
    assert places[325] == pytest.approx(3)
    assert places[-1] == pytest.approx(0)
    assert np.abs(np.diff(places, 2)).max() < 0.01 * 0.05  # speed changes by less than 5 % in 10 ms


# --- bodies and motions of the data folder -----------------------------------------------------------------------


def test_swivelled_limb_keeps_its_end_and_comes_back() -> None:
    rng = np.random.default_rng(5)
    axis = rng.normal(size=3)
    towards = quaternion.from_rotation_vector(rng.normal(size=3))
    about = quaternion.from_rotation_vector(2.9 * axis / np.linalg.norm(axis))
    flipped = quaternion.multiply(towards, about)
    back = _swivelled(flipped, towards, axis)
    assert quaternion.angle_between(back, towards) < 1e-6
    nearby = quaternion.multiply(quaternion.from_rotation_vector(np.array([0.1, 0.0, 0.0])), flipped)
    kept = _swivelled(nearby, towards, axis)
    np.testing.assert_allclose(quaternion.to_matrix(kept) @ axis, quaternion.to_matrix(nearby) @ axis, atol=1e-9)
    assert quaternion.angle_between(kept, towards) < 0.11


@needs_data
@pytest.mark.parametrize("name", bodies())
@pytest.mark.parametrize("motion", ["14_06", "16_17", "05_08"])
def test_clips_play_smoothly_on_the_floor_near_the_origin(name: str, motion: str) -> None:
    person = open_performer(name, motion, DATA)
    assert person.mesh.texture is not None
    assert facing(person.named_joints(0.5))[2] > 0.99
    assert facing(person.named_joints(2.0))[2] > 0.98
    path = joint_path(person, 0, min(person.duration_s, 12.0) + 1)
    assert np.linalg.norm(path[:, JOINT["pelvis"]][:, [0, 2]], axis=1).max() < 0.8
    assert (np.linalg.norm(np.diff(path, axis=0), axis=2) * 60).max() < 10
    lowest = [person.surface(t)[:, 1].min() for t in np.arange(0, 12, 0.5)]
    assert min(lowest) > -0.06
    assert np.median(np.abs(lowest)) < 0.05


@needs_data
def test_bones_keep_their_lengths_in_every_motion() -> None:
    person = open_performer(bodies()[0], "127_02", DATA)
    path = joint_path(person, 0, 10, 5)
    for upper, lower in (("left_hip", "left_knee"), ("right_knee", "right_ankle"), ("left_elbow", "left_wrist")):
        lengths = np.linalg.norm(path[:, JOINT[upper]] - path[:, JOINT[lower]], axis=1)
        assert np.ptp(lengths) < 1e-5


@needs_data
def test_t_pose_of_a_clip_is_a_t_pose_of_the_body() -> None:
    person = open_performer(bodies()[-1], "127_02", DATA)  # starts in a T-pose
    joints = person.named_joints(2.0)
    assert abs(joints[JOINT["left_wrist"], 1] - joints[JOINT["left_shoulder"], 1]) < 0.12
    assert joints[JOINT["left_wrist"], 0] - joints[JOINT["right_wrist"], 0] > 1.15


@needs_data
def test_builtin_person_plays_clips_and_bodies_play_the_routine() -> None:
    clip = open_performer("builtin", clip_names(DATA / "mocap")[0], DATA)
    assert np.isfinite(clip.surface(4.0)).all()
    routine = open_performer(bodies()[0], None, DATA)
    assert routine.surface(2 + 6.9)[:, 1].min() == pytest.approx(0, abs=5e-3)


@needs_data
def test_unknown_names_are_answered_with_those_there_are() -> None:
    with pytest.raises(CaptureError, match=f"no performer 'nobody' .*builtin, {bodies()[0]}"):
        open_performer("nobody", None, DATA)
    with pytest.raises(CaptureError, match=f"no motion 'swim' .*{clip_names(DATA / 'mocap')[0]}"):
        open_performer("builtin", "swim", DATA)


def test_data_folder_is_asked_for_where_it_is_needed() -> None:
    with pytest.raises(CaptureError, match="needs a data folder"):
        open_performer("somebody")
    with pytest.raises(CaptureError, match=r"needs a data folder with mocap/clips\.json"):
        open_performer("builtin", "walk")


def test_file_that_is_no_body_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bodies").mkdir()
    (tmp_path / "bodies/junk.npz").write_bytes(b"not a zip")
    np.savez(tmp_path / "bodies/empty.npz", vertices=np.zeros((3, 3)))
    with pytest.raises(CaptureError, match="cannot read body"):
        open_performer("junk", None, tmp_path)
    with pytest.raises(CaptureError, match="has no array"):
        open_performer("empty", None, tmp_path)
