"""The figures on UTD-MHAD: offsets come from other sequences, and the reference is what moves."""

from __future__ import annotations

import numpy as np
import pytest

from scripts.bench_utd_mhad import Track, moving, offsets_for


def track(name: str, offset_m: float, frames: int = 10, wave_m: float = 0.0) -> Track:
    """Links that stand still, turned by 90° about y; the joints lie ``offset_m`` along their x, one waves."""
    links = np.tile(np.eye(4), (frames, 20, 1, 1))
    links[..., :3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    joints = np.tile((0.0, 0.0, -offset_m), (frames, 20, 1))
    joints[:, 6, 1] += wave_m * np.arange(frames) / (frames - 1)
    return Track(name, joints, links, [None] * frames, [1.0] * frames)


def test_offsets_are_those_of_the_subjects_other_sequences():
    judged = track("a1_s1", 0.30)
    tracks = [judged, track("a2_s1", 0.10), track("a3_s1", 0.12), track("a4_s1", 0.50), track("a1_s2", 0.90)]
    offsets = offsets_for(tracks, judged)
    np.testing.assert_allclose(offsets, np.tile((0.12, 0, 0), (20, 1)), atol=1e-9)  # the median along the link's x
    np.testing.assert_allclose(judged.distances(offsets), 0.18, atol=1e-9)


def test_frames_without_a_skeleton_do_not_spoil_the_offsets():
    other = track("a2_s1", 0.10)
    other.links[3:] = np.nan
    judged = track("a1_s1", 0.10)
    np.testing.assert_allclose(judged.distances(offsets_for([judged, other], judged)), 0, atol=1e-9)


def test_only_joints_that_move_count_against_the_frozen_skeleton():
    waving = track("a1_s1", 0.0, frames=11, wave_m=0.4)
    ours, frozen = moving(waving, waving.distances(np.zeros((20, 3))))
    assert len(ours) == 11
    assert frozen.mean() == pytest.approx(0.2)
    still, _ = moving(track("a1_s1", 0.0), np.zeros((10, 20)))
    assert len(still) == 0
