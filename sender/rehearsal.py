"""The sender's whole path once over a mannequin, so that every kernel is there before the first real frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from common.body.mannequin import mannequin, mannequin_camera, mannequin_depth
from common.body.skeleton_pose import forward_kinematics, joint_positions, named_joint_positions
from common.body.view import View
from common.geometry import quaternion
from common.geometry.camera_model import Camera
from common.geometry.point_cloud import PointCloud
from common.runtime.clock import MonotonicClock
from common.runtime.stage_timer import StageTimer
from common.wire.body_message import quantized_skeleton
from sender.capture.frame_set import ColourFrame, DepthFrame, FrameSet
from sender.capture.outside_skeleton import OutsideSkeleton, Sensor
from sender.capture.rig_layout import cameras_around
from sender.config import CandidateSettings, ResidualStreamSettings
from sender.fitting.articulated_gauss_newton import PoseState
from sender.fitting.body_fitter import BodyFitter
from sender.fitting.body_model import BodyModel
from sender.fitting.gauss_newton_tracker import GaussNewtonSettings, GaussNewtonTracker
from sender.fitting.initial_pose_search import InitialPoseSearch
from sender.fitting.joint_limits import joint_table
from sender.fitting.limb_search import limbs, search_limb
from sender.fitting.outside_joints import sensor_joints
from sender.fitting.outside_tracker import OutsideTracker
from sender.fitting.particle_recovery import BodyRecovery, LimbRecovery
from sender.fitting.particle_tracker import ParticleSettings, ParticleTracker
from sender.fitting.tracker import FitResult
from sender.pipeline import CandidatePath, SkeletonPath, StreamIdentity, TrackedFrame
from sender.reconstruction.foreground_points import PointSampler
from sender.reconstruction.person_points import DepthReconstruction, HullReconstruction
from sender.residual_path import ResidualPath

FRAME_NS = 33_333_333
_IDENTITY = StreamIdentity(0, 0)


def rehearse_fitting() -> None:
    """Look for a mannequin, which has neither front nor back, and follow it from its own joints for a few frames."""
    camera = mannequin_camera()
    depth = mannequin_depth(camera)
    colour = np.full((*depth.shape, 3), 128, np.uint8)
    room = np.where(depth > 0, 0, 4000).astype(np.uint16)
    clock = MonotonicClock()
    tracker = GaussNewtonTracker(GaussNewtonSettings(building_s=2 * FRAME_NS / 1e9))
    reconstruction = DepthReconstruction([camera], [room])
    InitialPoseSearch().step(PointSampler([camera]).points([_view(camera)]), 0)
    joints = named_joint_positions(*mannequin())
    path = SkeletonPath(_IDENTITY, reconstruction, tracker, 30.0, StageTimer(clock), clock, joints)
    for index in range(1, 5):
        frame = DepthFrame(0, index, index * FRAME_NS, depth, colour)
        path.process(FrameSet(frame.capture_ns, (frame,)))


def rehearse_hull() -> None:
    """Carve a mannequin out of its silhouettes."""
    cameras = cameras_around(3, 320, 240)
    masks = [np.where(mannequin_depth(camera) > 0, 255, 0).astype(np.uint8) for camera in cameras]
    frames = FrameSet(0, tuple(ColourFrame(index, 1, 0, None, mask) for index, mask in enumerate(masks)))
    joints = joint_positions(*mannequin())
    for inside in (False, True):
        HullReconstruction(cameras, [None] * 3, inside=inside).person(frames, joints, StageTimer(MonotonicClock()))


def rehearse_restart() -> None:
    """Find a person who is known already, in the middle of a motion."""
    skeleton, pose = mannequin()
    camera = mannequin_camera()
    cloud = PointSampler([camera]).points([_view(camera)])
    body = BodyModel(skeleton)
    body.add(cloud, forward_kinematics(skeleton, pose))
    tracker = GaussNewtonTracker(GaussNewtonSettings(), BodyModel.from_bytes(body.to_bytes()))
    for index in range(2):
        tracker.track(cloud, index * FRAME_NS)


def rehearse_recovery() -> None:
    """Look for a limb and for a whole body that got lost, on noisy points: in a session it comes when it comes, and a
    kernel compiled then would hold up the picture for seconds."""
    skeleton, pose = mannequin()
    cloud = PointSampler([mannequin_camera()]).points([_view(mannequin_camera())])
    T_world_link, random = forward_kinematics(skeleton, pose), np.random.default_rng(0)
    body = BodyModel(skeleton)
    for _ in range(4):  # a thick shell, which the model thins
        noise = random.normal(0, 0.03, cloud.positions.shape).astype(np.float32)
        body.add(PointCloud(cloud.positions + noise, cloud.normals, cloud.colours), T_world_link)
    fitter = BodyFitter(body, joint_table())
    local = quaternion.to_matrix(pose.rotations.astype(np.float64))
    state = PoseState(pose.root_position.astype(np.float64), local)
    fit = fitter.judge(cloud, state)._replace(owner=np.full(len(cloud), -1))  # nobody explains a point
    for limb in limbs(fitter.table):
        search_limb(limb, fit, cloud, fitter, (state,))
        LimbRecovery(limb, state, 0).step(fit, cloud, fitter)
    BodyRecovery(state, 0).step(state, cloud, fitter)


def rehearse_particles() -> None:
    """Follow a mannequin for a few frames with ellipsoids and particles."""
    skeleton, pose = mannequin()
    cloud = PointSampler([mannequin_camera()]).points([_view(mannequin_camera())])
    tracker = ParticleTracker(ParticleSettings())
    tracker.start_from(skeleton, pose, cloud, 0)
    for index in range(1, 3):
        tracker.track(cloud, index * FRAME_NS)


def rehearse_candidates() -> None:
    """Make candidate poses of a mannequin."""
    skeleton, pose = mannequin()
    fit = FitResult(skeleton, pose, converged=True, iterations=1, inliers=1.0, rms_m=0.0, confidence=1.0)
    T_world_link = forward_kinematics(skeleton, pose)
    views = (_view(mannequin_camera()),) * 2
    tracked = TrackedFrame(0, views, fit, skeleton=skeleton, pose=pose, T_world_link=T_world_link)
    settings = CandidateSettings(segmentation="region-growing", views="zippered", score_form="all-edges")
    candidates = CandidatePath(_IDENTITY, settings, StageTimer(MonotonicClock()))
    for index in range(2):  # the second meets the first in the usable pose set, and its depth is fused with the first's
        later = replace(tracked, capture_ns=index * FRAME_NS)
        candidates.remember(later)
        candidates.process(later)


def rehearse_residuals() -> None:
    """Make residual packets of a mannequin: a key, and a difference from it."""
    body, pose = mannequin()
    camera, skeleton = mannequin_camera(), quantized_skeleton(body)
    path = ResidualPath(_IDENTITY, [camera], 30.0, ResidualStreamSettings(), StageTimer(MonotonicClock()))
    path.note_budget(1e6)
    for index in range(2):
        T_world_link = forward_kinematics(skeleton, pose)
        views = (_view(camera),)
        path.process(
            TrackedFrame(index * FRAME_NS, views, None, skeleton=skeleton, pose=pose, T_world_link=T_world_link)
        )


def rehearse_skeletons() -> None:
    """Turn a skeleton of a sensor's own into ours."""
    skeleton, pose = mannequin()
    joints = sensor_joints(skeleton, pose, "kinect-v2").astype(np.float32)
    tracker = OutsideTracker("kinect-v2", [Sensor("sensor", (0.0, 1.0, 2.0))])
    for index in range(2):
        tracker.track((OutsideSkeleton(index * FRAME_NS, 0, joints, np.ones(len(joints), np.float32)),))


def rehearse_start() -> None:
    """What a sender does from the first frame on, until it has found a person, and when it has lost them."""
    rehearse_fitting()
    rehearse_recovery()
    rehearse_skeletons()
    rehearse_hull()


def rehearse_all() -> None:
    """What any sender may do."""
    rehearse_start()
    rehearse_restart()
    rehearse_particles()
    rehearse_candidates()
    rehearse_residuals()


def _view(camera: Camera) -> View:
    depth = mannequin_depth(camera)
    return View(camera, 0, 0, depth, np.full((*depth.shape, 3), 128, np.uint8))
