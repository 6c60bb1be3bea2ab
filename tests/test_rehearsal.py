"""The mannequin looks like a person to both daemons, so a rehearsal goes all the way."""

from __future__ import annotations

import numpy as np
import pytest

from common.body.mannequin import mannequin, mannequin_camera, mannequin_depth
from common.body.skeleton_pose import joint_positions
from common.geometry.camera_model import project
from receiver import rehearsal as receiving
from sender import rehearsal as sending
from sender.fitting.gauss_newton_tracker import GaussNewtonTracker
from sender.fitting.limb_search import score_poses
from sender.fitting.link_cells import sheet
from sender.pipeline import CandidatePath
from sender.residual_path import ResidualPath


def test_the_mannequin_stands_in_the_picture_around_its_joints():
    camera = mannequin_camera()
    depth = mannequin_depth(camera)
    assert 0.05 < (depth > 0).mean() < 0.3
    pixels, z = project(camera, joint_positions(*mannequin()))
    for (u, v), behind in zip(np.rint(pixels).astype(int), z, strict=True):
        assert depth[v, u] > 0
        assert 0 <= behind * 1000 - depth[v, u] < 250  # the surface is before the joint


def test_fitting_is_rehearsed_to_the_end(monkeypatch):
    statuses = []
    track = GaussNewtonTracker.track

    def watched(self, cloud, capture_ns):
        fit = track(self, cloud, capture_ns)
        statuses.append((self.status, fit is not None))
        return fit

    monkeypatch.setattr(GaussNewtonTracker, "track", watched)
    sending.rehearse_fitting()
    assert statuses[-1] == ("tracking", True)
    statuses.clear()
    sending.rehearse_restart()
    assert statuses[-1][1]


def test_candidates_are_rehearsed_with_a_mesh_in_the_set(monkeypatch):
    found = []
    process = CandidatePath.process

    def watched(self, tracked):
        found.append(process(self, tracked))
        return found[-1]

    monkeypatch.setattr(CandidatePath, "process", watched)
    sending.rehearse_candidates()
    assert [len(f.encoded) > 1000 for f in found] == [True, True]


def test_residual_maps_are_rehearsed_as_key_and_difference(monkeypatch):
    found = []
    process = ResidualPath.process

    def watched(self, tracked):
        found.append(process(self, tracked))
        return found[-1]

    monkeypatch.setattr(ResidualPath, "process", watched)
    sending.rehearse_residuals()
    assert [(residual.sequence, residual.key) for residual in found] == [(0, 0), (1, 0)]


@pytest.mark.parametrize(("rehearse", "pose_ids"), [("rehearse", [1, 1]), ("rehearse_picture", [1])])
def test_the_receivers_rehearsals_show_a_mesh(monkeypatch, rehearse, pose_ids):
    shown = []
    show = receiving.AnimationPath.show

    def watched(self, newest):
        shown.append(show(self, newest))
        return shown[-1]

    monkeypatch.setattr(receiving.AnimationPath, "show", watched)
    getattr(receiving, rehearse)()
    assert [result.frame.pose_id for result in shown] == pose_ids


def test_what_a_session_meets_late_is_rehearsed_too():
    """Kernels that only a lost limb or a noisy surface needs are compiled before the first frame."""
    sending.rehearse_recovery()
    assert score_poses.signatures
    assert sheet.signatures
