"""What the limb trackers are measured against, and the bench's rows."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from common.body.skeleton import LINK_INDEX, SIDES
from scripts import bench_particles
from scripts.bench_particles import LIMBS, Variant, _truth, follow
from scripts.limb_truth import LinkedBody, linked_body, posed_joints
from sender.capture.body_performer import PoseTrack
from sender.capture.builtin_body import builtin_body
from sender.capture.choreography import routine
from sender.capture.mocap import read_clip
from sender.capture.retarget import retarget
from sender.capture.skinned_body import load_body
from sender.fitting.ellipsoid_body import ellipsoid_body, link_transforms
from sender.fitting.limb_tracker import IMPROVED, PUBLISHED
from sender.fitting.motion_noise import default_noise

DATA = Path(__file__).parents[2] / "shared" / "data"


@cache
def builtin() -> tuple[LinkedBody, PoseTrack]:
    body = builtin_body()
    track = retarget(body, routine())
    return linked_body(body, track), track


def real(body: str, clip: str) -> tuple[LinkedBody, PoseTrack]:
    if not (DATA / "mocap" / "clips.json").exists():
        pytest.skip("needs ../shared/data with bodies and motion capture")
    skinned = load_body(DATA / "bodies" / f"{body}.npz")
    track = retarget(skinned, read_clip(DATA / "mocap", clip))
    return linked_body(skinned, track), track


def positions_off_m(linked: LinkedBody, track: PoseTrack, kind: str, joints: tuple[str, ...]) -> float:
    """How far the model at its true angles puts joints from where the body has them, at worst over 3 s."""
    worst = 0.0
    for limb in LIMBS[kind]:
        body = ellipsoid_body(linked.skeleton, limb.links)
        for T_world_joint in list(posed_joints(linked.body, track, 30, 3.0))[::6]:
            T_carrier, angles = _truth(linked, body, limb, T_world_joint)
            T = link_transforms(body, angles[None], T_carrier)[0]
            true = linked.link_transforms(T_world_joint)
            for row, name in enumerate(limb.links):
                if name.endswith(joints):
                    worst = max(worst, float(np.linalg.norm(T[row, :, 3] - true[LINK_INDEX[name], :3, 3])))
                if name.endswith("forearm"):  # the wrist
                    wrist = T[row, :, :3] @ linked.skeleton.tips[LINK_INDEX[name]] + T[row, :, 3]
                    hand = true[LINK_INDEX[name.replace("forearm", "hand")], :3, 3]
                    worst = max(worst, float(np.linalg.norm(wrist - hand)))
    return worst


def test_the_true_angles_put_the_builtin_bodys_joints_where_they_are() -> None:
    linked, track = builtin()
    assert positions_off_m(linked, track, "legs", ("shin", "foot")) < 0.005
    assert positions_off_m(linked, track, "arm", ("forearm",)) < 0.005


@pytest.mark.parametrize("body", ["male_avg", "female_slim"])
def test_the_true_angles_put_real_bodies_joints_where_they_are(body: str) -> None:
    linked, track = real(body, "127_04")
    assert positions_off_m(linked, track, "legs", ("shin", "foot")) < 0.010
    assert positions_off_m(linked, track, "arm", ("forearm",)) < 0.005


def test_the_points_are_those_of_the_limb_alone() -> None:
    linked, _ = builtin()
    rest = linked.body.points[linked.body.point_of_vertex]
    for kind, below in (("legs", True), ("arm", False)):
        for limb in LIMBS[kind]:
            faces = linked.faces_of(limb.surface)
            corners = rest[np.unique(faces)]
            hip = linked.body.heads[linked.joints[LINK_INDEX["left_thigh"]], 1]
            assert len(faces) > 50
            if below:
                assert corners[:, 1].max() < hip + 0.15
                assert {np.sign(x) for x in corners[:, 0]} == {-1, 1}
            else:
                assert len({np.sign(x) for x in corners[:, 0]}) == 1


def test_frames_are_the_tracks_own_at_the_rate_asked_for() -> None:
    linked, track = builtin()
    count = len(list(posed_joints(linked.body, track, 30, 1.0)))
    assert count == 31
    assert len(list(posed_joints(linked.body, track, 30 / 8, 1.0))) == 4


@pytest.mark.parametrize(("settings", "bound_deg"), [(PUBLISHED, 8.0), (IMPROVED, 3.5)])
def test_trackers_follow_the_legs_of_the_builtin_performer(settings: object, bound_deg: float) -> None:
    linked, track = builtin()
    limb = LIMBS["legs"][0]
    noise = default_noise(ellipsoid_body(linked.skeleton, limb.links))
    variant = Variant("", IMPROVED if settings is IMPROVED else PUBLISHED, points=1500)
    result = follow(linked, track, limb, variant, noise, 1.0)
    assert len(result.errors_deg) == len(result.cpu_ms) == 30
    assert np.mean(result.errors_deg) < bound_deg


def test_rows_are_complete_without_any_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_particles, "VARIANTS", bench_particles.VARIANTS[:2])
    monkeypatch.setattr(bench_particles, "POINTS", 600)
    rows = bench_particles.run(None, seconds=0.2)
    cases = {row["case"] for row in rows}
    assert cases == {f"{k}/builtin/routine/{v}" for k in ("legs", "arm") for v in ("published", "improved")}
    metrics = {"angle_error_mean_deg", "angle_error_max_deg", "ms_per_frame_p50", "ms_per_frame_p99"}
    assert all({row["metric"] for row in rows if row["case"] == case} == metrics for case in cases)
    assert all(row["value"] is not None and np.isfinite(row["value"]) for row in rows)


def test_an_unknown_clip_is_refused() -> None:
    if not (DATA / "mocap" / "clips.json").exists():
        pytest.skip("needs ../shared/data with bodies and motion capture")
    with pytest.raises(SystemExit, match="no clip nonsense"):
        bench_particles.run(DATA, 0.1, ("nonsense",))


def test_both_sides_are_tracked_as_arms() -> None:
    assert [limb.carrier for limb in LIMBS["arm"]] == [f"{side}_clavicle" for side in SIDES]
