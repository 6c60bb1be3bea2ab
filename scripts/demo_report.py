"""The figures of one demo run: what the daemons counted, and what was shown against the rig's ground truth.

The truth never reaches the tracker: it is made anew here, after the run, from the performer and the rig's start time.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.body.rigged_mesh import RiggedMesh, build_rigged_mesh
from common.body.skeleton import NAMED_JOINT_LINKS, Skeleton
from common.body.skeleton_pose import forward_kinematics
from common.body.skinning import animate, link_motion
from common.geometry.rasterizer import render
from common.wire.body_message import decode_body
from common.wire.candidate_pose import decode_candidate_pose
from common.wire.skeleton_packet import SkeletonPacket, decode_skeleton
from receiver.show_log import read_show_log
from scripts.fidelity import (
    Fidelity,
    bounding_ball_radius,
    compare,
    constant_offsets,
    joint_errors_m,
    measuring_cameras,
)
from sender.capture.performer import Performer, open_performer

INSTANTS = 120


@dataclass
class Session:
    """A show log read back. ``frames``: (sequence, pose id, σ, latency [ns]); ``ticks``: (sequence, age [ns])."""

    skeletons: dict[int, SkeletonPacket] = field(default_factory=dict)
    bodies: dict[int, Skeleton] = field(default_factory=dict)
    poses: dict[int, bytes] = field(default_factory=dict)
    frames: list[tuple[int, int | None, float | None, int]] = field(default_factory=list)
    ticks: list[tuple[int | None, int | None]] = field(default_factory=list)


def read_session(path: Path) -> Session:
    """Read a log into what the measures need; bodies and poses by their revision and id."""
    session = Session()
    for kind, _, payload in read_show_log(path):
        if kind == "skeleton":
            packet = decode_skeleton(payload)
            session.skeletons[packet.sequence] = packet
        elif kind == "body":
            message = decode_body(payload)
            session.bodies[message.revision] = message.skeleton
        elif kind == "pose":
            session.poses[decode_candidate_pose(payload).pose_id] = payload
        elif kind == "frame":
            _, sequence, pose_id, sigma, latency_ns = payload
            session.frames.append((sequence, pose_id, sigma, latency_ns))
        elif kind == "tick":
            session.ticks.append((payload[0], payload[1]))
    return session


def demo_report(run: Path, body: str, motion: str | None, data: Path | None) -> dict[str, Any]:
    """Every figure of a finished run whose daemons left their files in ``run``."""
    sent = json.loads((run / "sender.json").read_text())
    received = json.loads((run / "receiver.json").read_text())
    session = read_session(run / "shown.log")
    performer = open_performer(body, motion, data)
    epoch_ns = int(sent["source_epoch_ns"])
    ages = [age_ns / 1e6 for _, age_ns in session.ticks if age_ns is not None]
    report = {
        "performer": performer.name,
        "frames_captured": sent["frames_captured"],
        "skeletons_published": sent["skeletons_published"],
        "skeleton_bytes_max": sent["skeleton_bytes_max"],
        "skeletons_received": received["skeletons_received"],
        "frames_rendered": received["frames_rendered"],
        "time_to_first_body_s": received["time_to_first_body_s"],
        "pose_age_ms": percentiles(ages, 50, 95, 99),
        "compute_latency_ms": percentiles([f[3] / 1e6 for f in session.frames if f[1] is not None], 50, 99),
        "candidate_poses_sent": sent["candidate_poses_sent"],
        "candidate_pose_bytes_mean": sent["candidate_pose_bytes_mean"],
        "repository_poses": received["repository_poses"],
        "sigma": percentiles([f[2] for f in session.frames if f[2] is not None], 50, 95),
    }
    report |= joint_figures(session, performer, epoch_ns, sent["frames_captured"])
    report |= picture_figures(session, performer, epoch_ns)
    report["stage_ms"] = {"sender": sent["stage_ms"], "receiver": received["stage_ms"]}
    report["dropped"] = {"sender": sent["dropped"], "receiver": received["dropped"]}
    report |= {"sender_rss_mb": sent["rss_mb"], "receiver_rss_mb": received["rss_mb"]}
    report["cpu_share"] = {"sender": sent["cpu_share"], "receiver": received["cpu_share"], "rig": sent["rig_cpu_share"]}
    return report


def joint_figures(session: Session, performer: Performer, epoch_ns: int, captured: int) -> dict[str, Any]:
    """Joint distances of every received skeleton to the truth of its own capture time, and e_t (Lien 2009 §6)."""
    packets = [p for p in session.skeletons.values() if p.body_revision in session.bodies]
    if not packets:
        return {"joint_error_m": None, "e_t": None}
    T = np.array([forward_kinematics(session.bodies[p.body_revision], p.pose)[NAMED_JOINT_LINKS] for p in packets])
    times = [(p.capture_ns - epoch_ns) / 1e9 for p in packets]
    truth = np.array([performer.named_joints(t) for t in times])
    radii = [bounding_ball_radius(performer.surface(t)) for t in times[:: max(1, len(times) // 60)]]
    radius = float(np.mean(radii))
    raw = joint_errors_m(T[:, :, :3, 3], truth)
    aligned = joint_errors_m(constant_offsets(T[:, :, :3, 3], T[:, :, :3, :3], truth), truth)
    return {
        "joint_error_m": spread(raw),
        "joint_error_aligned_m": spread(aligned),
        "e_t": {"radius_m": radius, "raw": raw.mean() / radius, "aligned": aligned.mean() / radius},
        "e_t_max": {"raw": raw.max() / radius, "aligned": aligned.max() / radius},
        "lost_share": 1 - len(packets) / max(captured, 1),
    }


def picture_figures(session: Session, performer: Performer, epoch_ns: int) -> dict[str, Any]:
    """Compare the person as shown with the true one at instants spread over the run."""
    shown = {sequence: pose_id for sequence, pose_id, _, _ in session.frames if pose_id is not None}
    on_screen = sorted({s for s, _ in session.ticks if s in shown and s in session.skeletons})
    chosen = [on_screen[i] for i in np.linspace(0, len(on_screen) - 1, min(INSTANTS, len(on_screen))).astype(int)]
    meshes: dict[int, RiggedMesh] = {}
    results: list[Fidelity] = []
    for done, sequence in enumerate(chosen):
        packet, pose_id = session.skeletons[sequence], shown[sequence]
        if packet.body_revision not in session.bodies:
            continue
        if pose_id not in meshes:
            meshes[pose_id] = rebuild(session.poses[pose_id])
        T = forward_kinematics(session.bodies[packet.body_revision], packet.pose)
        results.append(picture_fidelity(performer, (packet.capture_ns - epoch_ns) / 1e9, meshes[pose_id], T))
        if done % 10 == 9:
            print(f"\rcomparing pictures {done + 1}/{len(chosen)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    if not results:
        return {"psnr_db": None, "psnr_inside_db": None, "iou": None, "instants": 0}
    return {
        "psnr_db": low_end([r.psnr_db for r in results]),
        "psnr_inside_db": low_end([r.psnr_inside_db for r in results]),
        "iou": low_end([r.iou for r in results]),
        "instants": len(results),
    }


def rebuild(message: bytes) -> RiggedMesh:
    """The rigged mesh of a candidate pose message, as the receiver built it."""
    pose = decode_candidate_pose(message)
    return build_rigged_mesh(pose.pose_id, pose.capture_ns, pose.skeleton, pose.pose, pose.views)


def picture_fidelity(
    performer: Performer, time_s: float, mesh: RiggedMesh, T_world_link: NDArray[np.float32]
) -> Fidelity:
    """Six views of the true and of the shown person at one instant."""
    surface = performer.surface(time_s)
    cameras = measuring_cameras(surface)
    look = performer.mesh
    true_colours = look.vertex_colours if look.uv is None or look.texture is None else (look.uv, look.texture)
    vertices = animate(mesh, link_motion(mesh, T_world_link))
    truth = [render(surface, look.faces, true_colours, camera) for camera in cameras]
    return compare(truth, [render(vertices, mesh.faces_drawn, mesh.mesh.surface, camera) for camera in cameras])


def percentiles(values: list[float], *wanted: int) -> dict[str, float] | None:
    """{"p50": …} of a list, None when it is empty."""
    return {f"p{p}": float(np.percentile(values, p)) for p in wanted} if values else None


def spread(values: NDArray[np.floating]) -> dict[str, float]:
    """Mean, 95th percentile and maximum."""
    return {"mean": float(values.mean()), "p95": float(np.percentile(values, 95)), "max": float(values.max())}


def low_end(values: list[float]) -> dict[str, float]:
    """Mean and 5th percentile: how good, and how good at its worst."""
    return {"mean": float(np.mean(values)), "p5": float(np.percentile(values, 5))}
