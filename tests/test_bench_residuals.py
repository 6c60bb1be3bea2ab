"""The residuals bench: every codec brings the points back, likeness means what it says, recordings can be read."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from common.body.skeleton_pose import forward_kinematics
from common.geometry.point_cloud import PointCloud
from scripts.bench_residuals import LOOKED_AT_EVERY, POINT_BYTES, _residual, _rival, _rows, _video
from scripts.residual_figures import frames_chart, rate_chart, residual_clouds
from scripts.residual_quality import likeness
from scripts.residual_rivals import filmed, rivals
from scripts.residual_sequences import PosedSequence, PosedViews, recorded_sequence
from scripts.run_bench import Row
from tests.capsule_person import pose_at
from tests.capsule_views import capsule_views, ring_camera
from tests.posed_cloud import BODY, posed_cloud

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"


@cache
def short_sequence(length: int = LOOKED_AT_EVERY + 1) -> PosedSequence:
    """The capsule person moving before four cameras."""
    frames = []
    for k in range(length):
        pose = pose_at(k / 30)
        frames.append(PosedViews(capsule_views(pose), BODY, 1, forward_kinematics(BODY, pose)))
    return PosedSequence("capsules", tuple(ring_camera(n) for n in range(4)), frames)


def test_a_cloud_is_like_itself_and_less_so_the_more_it_is_moved() -> None:
    truth, _ = posed_cloud(pose_at(0), 10_000)
    assert likeness(truth, truth, 1.75).psnr_db == 99.0
    noise = np.random.default_rng(0).normal(0, 1, truth.positions.shape).astype(np.float32)
    moved = [PointCloud(truth.positions + noise * s, truth.normals, truth.colours) for s in (0.001, 0.004, 0.016)]
    db = [likeness(truth, cloud, 1.75).psnr_db for cloud in moved]
    assert db[0] > db[1] > db[2] > 10
    assert likeness(truth, moved[1], 1.75).worst_view_db <= db[1]


def test_residuals_bring_more_the_more_of_them_there_are() -> None:
    measured = [_residual(short_sequence(), level) for level in (0.0, 25.0, 100.0)]
    sizes = [np.mean(m.sizes) for m in measured]
    last_db = [m.likeness[LOOKED_AT_EVERY].psnr_db for m in measured]
    assert sizes[0] < sizes[1] < sizes[2]
    assert last_db[0] < last_db[1] < last_db[2]


def test_maps_as_video_take_less_and_say_what_they_are_late() -> None:
    pytest.importorskip("av")
    sequence = short_sequence(3 * LOOKED_AT_EVERY)
    measured, alone = _video(sequence, 50.0), _residual(sequence, 50.0)
    assert len(measured.sizes) == 16  # two whole groups
    assert np.mean(measured.sizes) < np.mean(alone.sizes)
    assert measured.likeness[LOOKED_AT_EVERY].psnr_db > alone.likeness[LOOKED_AT_EVERY].psnr_db - 3
    figures = {r["metric"]: r["value"] for r in _rows("capsules/arms/4/residual-video/50", sequence, measured, 50.0)}
    assert figures["added_delay_ms"] > 7e3 / 30
    assert figures["psnr_late_db"] < figures["psnr_db"] + 1


@pytest.mark.parametrize("name", [n for n in rivals() if n.split("/")[0] in ("yang", "rvl", "draco")])
def test_rivals_that_code_frame_by_frame_show_the_person(name: str) -> None:
    pytest.importorskip("DracoPy")
    sequence = short_sequence()
    measured = _rival(sequence, rivals()[name](sequence))
    assert min(seen.psnr_db for seen in measured.likeness.values()) > 17
    assert 1000 < np.mean(measured.sizes) < sequence.raw_bytes / 8


@pytest.mark.parametrize("name", ["h264", "h265"])
def test_video_shows_the_person_better_at_a_higher_rate(name: str) -> None:
    pytest.importorskip("av")
    sequence = short_sequence()
    measured = [_rival(sequence, filmed(name, rate_bps, sequence)) for rate_bps in (0.6e6, 10e6)]
    low, high = (m.likeness[LOOKED_AT_EVERY].psnr_db for m in measured)
    assert 17 < low < high
    assert np.mean(measured[0].sizes) < np.mean(measured[1].sizes)


def test_ratios_are_to_the_images_and_to_the_points() -> None:
    sequence = short_sequence()
    measured = _residual(sequence, 50.0)
    figures = {row["metric"]: row["value"] for row in _rows("capsules/arms/4/residual/50", sequence, measured, 50.0)}
    size = np.mean(measured.sizes)
    assert figures["bytes_per_frame"] == pytest.approx(size)
    assert figures["ratio_to_raw_images"] == pytest.approx(4 * 480 * 360 * 5 / size)
    points = np.mean([len(sequence.cloud(k)) for k in (0, LOOKED_AT_EVERY)])
    assert figures["ratio_to_points"] == pytest.approx(POINT_BYTES * points / size)


@pytest.mark.parametrize(("name", "cameras", "frames"), [("uva_turning_person", 4, 20), ("ddrnet_person", 1, 20)])
def test_recordings_are_people_in_the_world(name: str, cameras: int, frames: int) -> None:
    if not (DATA / "rgbd" / name).is_dir():
        pytest.skip(f"{DATA / 'rgbd' / name}: not here")
    sequence = recorded_sequence(name, DATA)
    assert (len(sequence.cameras), sequence.length) == (cameras, frames)
    points = sequence.cloud(0).positions
    assert 0.5 < np.ptp(points[:, 1]) < 1.5  # half a person, upright
    for link in (3, 4):  # neck and head are among the points
        joint = sequence.frame(0).T_world_link[link, :3, 3]
        assert np.linalg.norm(points - joint, axis=1).min() < 0.25


def test_figures_show_every_method_of_the_case_and_every_level() -> None:
    rows: list[Row] = [
        Row(case=f"a/b/4/{method}/{n}", metric=metric, value=value * n, unit="", reference=None, source="")
        for method in ("residual", "yang")
        for n in (1, 2)
        for metric, value in (("bytes_per_frame", 900), ("psnr_db", 20.0))
    ]
    svg = rate_chart(
        "a/b/4", [*rows, Row(case="a/b/8/draco/1", metric="psnr_db", value=1, unit="", reference=None, source="")]
    )
    assert svg.count("<circle") == 4
    assert "yang" in svg
    assert "draco" not in svg
    sequence = short_sequence()
    shown = {level: residual_clouds(sequence, level)[0] for level in (0.0, 100.0)}
    assert frames_chart("capsules", sequence, shown).count("<polyline") >= 2
