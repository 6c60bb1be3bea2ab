"""Several sensors' skeletons merged: better than each, with bones that keep their lengths, and not late."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scripts import bench_outside
from sender.capture.outside_skeleton import Instant, Sensor
from sender.fitting.skeleton_merging import SkeletonMerger
from tests.outside_people import FRAME_NS, SENSORS, person_at, row_of, seen, wobble

FRAMES = 120
PAIR = Path(__file__).parents[1] / ".." / "shared" / "data"
NOISE_M = 0.008


def merged(instants: list[Instant], sensors: tuple[Sensor, ...] = SENSORS) -> np.ndarray:
    """Joints (F, J, 3)."""
    merger = SkeletonMerger("kinect-v2", sensors)
    return np.array([merger.merge(instant).joints for instant in instants])


def truth(frames: int = FRAMES) -> np.ndarray:
    return np.array([person_at(frame) for frame in range(frames)])


def noisy(seed: int, frames: int = FRAMES, scale: float = 1.0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return truth(frames) + random.normal(0, scale * NOISE_M, (frames, 25, 3))


def instants_of(*sensors: np.ndarray) -> list[Instant]:
    count = len(sensors[0])
    return [tuple(seen(f, s, joints[f]) for s, joints in enumerate(sensors)) for f in range(count)]


def rms_m(joints: np.ndarray, first: int = 30) -> float:
    return float(np.sqrt(((joints - truth(len(joints)))[first:] ** 2).sum(axis=2).mean()))


def bone_lengths(joints: np.ndarray) -> np.ndarray:
    bones = SkeletonMerger("kinect-v2", SENSORS).bones
    return np.linalg.norm(joints[:, bones[:, 0]] - joints[:, bones[:, 1]], axis=2)


def test_two_noisy_sensors_together_beat_each_and_bones_keep_their_lengths():
    left, right = noisy(0), noisy(1)
    both = merged(instants_of(left, right))
    assert rms_m(both) < 0.8 * min(rms_m(left), rms_m(right))
    assert bone_lengths(both)[64:].std(axis=0).max() < 0.002  # the lengths are final by then
    assert bone_lengths(left)[64:].std(axis=0).min() > 0.005


def test_the_noisier_sensor_counts_less():
    left, right = noisy(0), noisy(1, scale=2)
    both = merged(instants_of(left, right))
    assert rms_m(both) < rms_m(left)
    assert rms_m((left + right) / 2) > 1.1 * rms_m(left)


def test_a_moving_joint_is_not_late():
    both = merged(instants_of(noisy(0), noisy(1)))
    wrist = row_of("left_wrist")
    errors = [
        np.abs(both[30:-2, wrist] - truth()[30 - late : FRAMES - 2 - late, wrist]).mean() for late in (-1, 0, 1, 2)
    ]
    assert np.argmin(errors) == 1


def test_what_one_sensor_does_not_track_comes_from_the_other():
    instants, knee = [], row_of("left_knee")
    for frame in range(FRAMES):
        good, bad = person_at(frame), person_at(frame)
        confidence = np.ones(25)
        if frame >= 60:
            bad[knee] += 0.5
            confidence[knee] = 0.0
        instants.append((seen(frame, 0, bad, confidence), seen(frame, 1, good)))
    off = np.linalg.norm(merged(instants) - truth(), axis=2)[1:]
    assert off[:, knee].max() < 0.003
    whole = np.linalg.norm(merged(instants_of(truth(), truth())) - truth(), axis=2)[1:]
    assert off.max() < whole.max() + 0.001  # nor does it disturb the others


def test_places_that_a_sensor_guesses_say_nothing_of_its_noise():
    def after_guesses(jitter_m: float) -> np.ndarray:
        random, merger, knee = np.random.default_rng(0), SkeletonMerger("kinect-v2", SENSORS), row_of("left_knee")
        for frame in range(FRAMES):
            guess, confidence = person_at(frame), np.ones(25)
            if 40 <= frame < 80:
                guess[knee] += random.normal(0, jitter_m, 3)
                confidence[knee] = 0.0
            result = merger.merge((seen(frame, 0, guess, confidence), seen(frame, 1, person_at(frame))))
        return result.joints

    np.testing.assert_allclose(after_guesses(0.3), after_guesses(0.0), atol=1e-9)


def test_a_joint_that_jumps_at_one_sensor_stays():
    left, right = truth(), truth()
    wrist = row_of("right_wrist")
    left[60:64, wrist] += (0.0, 0.4, 0.2)
    both = merged(instants_of(left, right))
    assert np.linalg.norm(both - truth(), axis=2)[58:70, wrist].max() < 0.06  # of 0.45


def test_a_constant_difference_makes_no_jump_when_a_sensor_leaves():
    moved = truth() + np.array([0.10, 0.0, 0.0])
    instants = instants_of(truth(), moved)
    instants[60:] = [(right,) for _, right in instants[60:]]
    both = merged(instants)
    steps = np.linalg.norm(np.diff(both - truth(), axis=0), axis=2)
    assert steps[1:].max() < 0.008
    assert np.abs(both[59] - truth()[59] - (0.05, 0, 0)).max() < 0.01  # the middle of the two
    assert np.abs(both[-1] - moved[-1]).max() < 0.02  # and slowly to who is left


def test_a_sensor_that_sees_the_person_from_behind_counts_less():
    front, behind = Sensor("front", (0.0, 1.0, 2.5)), Sensor("behind", (0.0, 1.0, -2.5))
    wandering = np.array([person_at(frame) + wobble(frame, 0.1) for frame in range(FRAMES)])
    trusted = merged(instants_of(truth(), wandering), (front, behind))
    misled = merged(instants_of(truth(), wandering), (behind, front))
    assert rms_m(trusted) < 0.5 * rms_m(misled)


def test_an_old_skeleton_is_brought_forward():
    instants = []
    for frame in range(FRAMES):
        old = frame - frame % 2  # the left sensor delivers every other frame
        instants.append((seen(old, 0, person_at(old)), seen(frame, 1, person_at(frame))))
    held = np.array([person_at(frame - frame % 2) for frame in range(FRAMES)])
    assert rms_m(merged(instants)) < 0.5 * rms_m((held + truth()) / 2)


def test_a_joint_that_nobody_sees_goes_with_the_body_and_is_not_believed():
    instants, hand = [], row_of("left_wrist")
    for frame in range(FRAMES):
        confidence = np.ones(25)
        confidence[[hand, row_of("left_hand"), row_of("left_hand_tip"), row_of("left_thumb")]] = float(frame < 60)
        instants.append((seen(frame, 0, person_at(frame), confidence),))
    merger = SkeletonMerger("kinect-v2", SENSORS[:1])
    results = [merger.merge(instant) for instant in instants]
    forearm = results[-1].joints[hand] - results[-1].joints[row_of("left_elbow")]
    assert np.linalg.norm(forearm) == pytest.approx(0.146 * 1.75, abs=0.005)
    assert results[-1].confidence[hand] == 0


def test_a_joint_that_was_never_seen_is_not_a_number():
    confidence = np.ones(25)
    confidence[row_of("left_foot")] = 0.0
    result = SkeletonMerger("kinect-v2", SENSORS).merge((seen(0, 0, person_at(0), confidence),))
    assert np.isnan(result.joints[row_of("left_foot")]).all()
    assert np.isfinite(np.delete(result.joints, row_of("left_foot"), axis=0)).all()


def test_a_joint_that_is_not_seen_after_a_pause_spoils_no_other_and_comes_back():
    merger = SkeletonMerger("kinect-v2", SENSORS)
    for instant in instants_of(truth(60), truth(60)):
        merger.merge(instant)
    foot = row_of("left_foot")
    hidden = np.ones(25)
    hidden[foot] = 0.0
    for frame in range(80, 90):  # the pause is over 0.3 s
        joints = merger.merge(
            (seen(frame, 0, person_at(frame), hidden), seen(frame, 1, person_at(frame), hidden))
        ).joints
        assert np.isfinite(np.delete(joints, foot, axis=0)).all()
    for frame in range(90, 100):  # one of them sees it again
        joints = merger.merge((seen(frame, 0, person_at(frame)), seen(frame, 1, person_at(frame), hidden))).joints
    assert np.isfinite(joints).all()
    assert np.linalg.norm(joints[foot] - person_at(99)[foot]) < 0.03


def test_after_an_absence_somebody_else_has_other_bones_but_the_same_person_keeps_theirs():
    def lengths_after(scale: float) -> tuple[np.ndarray, np.ndarray]:
        merger = SkeletonMerger("kinect-v2", SENSORS)
        for instant in instants_of(noisy(0, scale=0.25), noisy(1, scale=0.25)):
            merger.merge(instant)
        before = merger.lengths.copy()
        for frame in range(200, 500):
            merger.merge((seen(frame, 0, scale * person_at(frame)),))
        return before, merger.lengths

    before, after = lengths_after(1.0)
    np.testing.assert_allclose(after, before, atol=0.006)  # learned on
    before, after = lengths_after(1.2)
    np.testing.assert_allclose(after / before, 1.2, atol=0.06)


def test_strangers_are_refused():
    merger = SkeletonMerger("kinect-v2", SENSORS)
    with pytest.raises(ValueError, match="kinect-v1 skeleton"):
        merger.merge((seen(0, 0, person_at(0, "kinect-v1")),))
    with pytest.raises(ValueError, match="sensor 2"):
        merger.merge((replace(seen(0, 0, person_at(0)), sensor=2),))


def test_a_clock_that_jumps_back_begins_anew():
    merger = SkeletonMerger("kinect-v2", SENSORS)
    for frame in (100, 101, 102, 3, 4):
        result = merger.merge((seen(frame, 0, person_at(frame)),))
        assert result.capture_ns == frame * FRAME_NS
    assert np.linalg.norm(result.joints - person_at(4), axis=1).max() < 0.01


@pytest.mark.skipif(not (PAIR / "rgbd" / "kinect2_pair_skeletons").exists(), reason="shared data is not there")
def test_two_real_sensors_at_90_degrees_merge_into_a_steadier_skeleton_that_is_not_late():
    rows = bench_outside.run(PAIR, seconds=8.0, clips=("90",))
    value = {(row["case"].split("/")[-1], row["metric"]): row["value"] for row in rows}
    for metric in ("jitter_mm", "jitter_p99_mm", "bone_length_sd_mm"):
        better = min(value["sensor-0", metric], value["sensor-1", metric])
        assert value["merged", metric] < better
        assert value["published", metric] < better
    assert abs(value["merged", "lag_frames"]) < 1
