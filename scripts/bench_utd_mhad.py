"""UTD-MHAD: 108 sequences of one real Kinect v1 without colour; automatic start; the SDK's joints as the reference.

Each of the SDK's 20 joints is compared with a point fixed to one of our links; which point, is learned from the other
sequences of the same subject (median of the SDK's joint in the link's frame), since the SDK's joints are not ours. The
SDK's own error is centimetres. ``lost_share``: of the frames from the first skeleton on, those with a median distance
over 20 cm or without a skeleton; ``before_start_share``: of all frames, those before it. ``frozen_ratio``: of the
joints that come more than 20 cm from where they began, the mean error over that of the SDK's own first skeleton, kept
still.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX
from common.body.skeleton_pose import forward_kinematics
from scripts.overlay import dots, draw, picture_of
from scripts.run_bench import Row
from sender.capture.frame_set import DepthFrame
from sender.capture.utd_mhad import UtdMhadSequence
from sender.fitting.open_tracker import open_tracker
from sender.fitting.tracker import FitResult
from sender.reconstruction.background import BackgroundModel
from sender.reconstruction.foreground_points import PointSampler

Floats = NDArray[np.float64]

TRACKER = "gauss-newton"
POINTS = 2500
LOST_M = 0.20
MOVES_M = 0.20
SHEET = 20  # overlays on the contact sheet
SHEET_COLUMNS = 10
TILE_WIDTH = 240
_LIMB = ("upper_arm", "forearm", "hand", "fingers")
_LEG = ("thigh", "shin", "foot", "toes")
# The link that carries each of the SDK's 20 joints, in the order of Skeleton_joint_order.txt.
_LINKS = ("head", "upper_spine", "lower_spine", "pelvis", *(f"left_{part}" for part in _LIMB),
          *(f"right_{part}" for part in _LIMB), *(f"left_{part}" for part in _LEG),
          *(f"right_{part}" for part in _LEG))  # fmt: skip
_MISSING = np.full((20, 4, 4), np.nan)
JOINT_LINKS = np.array([LINK_INDEX[link] for link in _LINKS])


@dataclass
class Track:
    """One tracked sequence of F frames. ``joints`` (F, 20, 3): the SDK's [m, world]; ``links`` (F, 20, 4, 4):
    ``T_world_link`` of the links that carry them, NaN without a skeleton; ``fits``: what the tracker said."""

    name: str
    joints: Floats
    links: Floats
    fits: list[FitResult | None]
    cpu_ms: list[float]

    @property
    def subject(self) -> str:
        return self.name.split("_")[1]

    def local(self) -> Floats:
        """The SDK's joints in the frames of their links (F, 20, 3)."""
        return np.einsum("fjba,fjb->fja", self.links[..., :3, :3], self.joints - self.links[..., :3, 3])

    def distances(self, offsets: Floats) -> Floats:
        """Distance [m] of every joint (F, 20) with our joints at ``offsets`` (20, 3) in their links' frames."""
        ours = self.links[..., :3, 3] + np.einsum("fjab,jb->fja", self.links[..., :3, :3], offsets)
        return np.asarray(np.linalg.norm(ours - self.joints, axis=2))


def run(
    data: Path | None, seconds: float | None = None, clips: tuple[str, ...] = (), pictures: Path | None = None
) -> list[Row]:
    """Rows for every sequence and for all together. ``clips``: only these (``a1_s1``), and their subjects' offsets
    come from these alone. ``pictures``: a folder for the contact sheet of overlays."""
    if data is None:
        raise SystemExit("this bench needs --data, a folder with rgbd/utd_mhad")
    tracks = []
    for file in _files(data / "rgbd" / "utd_mhad", clips):
        tracks.append(_tracked(UtdMhadSequence(file), seconds))
        print(f"{tracks[-1].name}: {np.median(tracks[-1].cpu_ms):.1f} ms a frame", file=sys.stderr, flush=True)
    errors = [track.distances(offsets_for(tracks, track)) for track in tracks]
    if pictures is not None:
        _contact_sheet(data / "rgbd" / "utd_mhad", tracks, errors, pictures / "utd_mhad.png")
    rows = []
    for track, error in zip(tracks, errors, strict=True):
        rows += _rows(f"utd-mhad/{track.name}", [track], [error])
    return rows + _rows("utd-mhad/all", tracks, errors)


def _files(folder: Path, clips: tuple[str, ...]) -> list[Path]:
    files = sorted((folder / "Depth").glob("*_depth.mat"), key=lambda file: _key(file.stem))
    chosen = [file for file in files if not clips or _key(file.stem) in {_key(clip) for clip in clips}]
    if not chosen:
        raise SystemExit(f"no such sequences in {folder / 'Depth'}")
    return chosen


def _key(name: str) -> tuple[int, int]:
    """Subject and action of ``a12_s3…``."""
    action, subject = name.split("_")[:2]
    return int(subject[1:]), int(action[1:])


def _tracked(sequence: UtdMhadSequence, seconds: float | None) -> Track:
    """The sequence as the sender would see it, without the SDK's joints."""
    camera = sequence.cameras[0]
    background, sampler, tracker = BackgroundModel(camera, None), PointSampler([camera], POINTS), open_tracker(TRACKER)
    count = len(sequence.frames) if seconds is None else max(int(seconds * sequence.frame_rate_hz), 1)
    track = Track(sequence.path.name.removesuffix("_t1_depth.mat"), np.empty(0), np.empty(0), [], [])
    joints, links = [], []
    for time_ns, _, number in sequence.frames[:count]:
        view = background.foreground(DepthFrame(0, number, time_ns, *sequence.load(0, number)))
        cloud = sampler.points([] if view is None else [view])
        begun = time.thread_time()
        fit = tracker.track(cloud, time_ns)
        track.cpu_ms.append((time.thread_time() - begun) * 1e3)
        track.fits.append(fit)
        joints.append(sequence.joints(number))
        links.append(_MISSING if fit is None else forward_kinematics(fit.skeleton, fit.pose)[JOINT_LINKS])
    track.joints, track.links = np.array(joints, np.float64), np.array(links, np.float64)
    return track


def offsets_for(tracks: list[Track], judged: Track) -> Floats:
    """Where the SDK's joints lie in the frames of our links (20, 3) [m]: the median over the subject's other sequences.
    A subject with one sequence only is judged by its own."""
    others = [track for track in tracks if track.subject == judged.subject and track is not judged]
    local = np.concatenate([track.local() for track in others or [judged]])
    seen = np.isfinite(local[:, 0, 0])
    return np.median(local[seen], axis=0) if seen.any() else np.zeros((20, 3))


def _rows(case: str, tracks: list[Track], errors: list[Floats]) -> list[Row]:
    distances = np.concatenate(errors)
    there = np.isfinite(distances[:, 0])
    begun = np.concatenate([np.maximum.accumulate(np.isfinite(error[:, 0])) for error in errors])
    of_frame = np.where(there, np.median(distances, axis=1), np.inf)
    ours, frozen = (np.concatenate(part) for part in zip(*map(moving, tracks, errors), strict=True))
    cpu_ms = np.concatenate([track.cpu_ms for track in tracks])
    figures: list[tuple[str, float | None, str]] = [
        ("joint_distance_median", float(np.median(distances[there])) if there.any() else None, "m"),
        ("joint_distance_p90", float(np.percentile(distances[there], 90)) if there.any() else None, "m"),
        ("frozen_ratio", float(ours.mean() / frozen.mean()) if len(ours) else None, "1"),
        ("lost_share", float((of_frame > LOST_M)[begun].mean()) if begun.any() else 1.0, "1"),
        ("before_start_share", float((~begun).mean()), "1"),
        ("ms_per_frame_p50", float(np.percentile(cpu_ms, 50)), "ms (CPU of the thread)"),
        ("ms_per_frame_p99", float(np.percentile(cpu_ms, 99)), "ms (CPU of the thread)"),
    ]
    return [Row(case=case, metric=m, value=v, unit=u, reference=None, source="") for m, v, u in figures]


def moving(track: Track, distances: Floats) -> tuple[Floats, Floats]:
    """Of the joints that move, in frames with a skeleton: our error [m], and that of the first skeleton kept still."""
    frozen = np.linalg.norm(track.joints - track.joints[0], axis=2)
    moves = frozen.max(axis=0) > MOVES_M
    there = np.isfinite(distances[:, 0])
    return distances[there][:, moves].ravel(), frozen[there][:, moves].ravel()


def _contact_sheet(folder: Path, tracks: list[Track], errors: list[Floats], file: Path) -> None:
    """Frames spread over the sequences and their time, our bones over the depth, the SDK's joints as white dots."""
    tiles: list[NDArray[np.uint8]] = []
    for place in np.linspace(0, len(tracks) - 1, min(SHEET, len(tracks))).astype(int):
        track, error = tracks[place], errors[place]
        number = int((0.3 + 0.4 * (len(tiles) % 2)) * len(track.fits))  # arms are up around the middle
        tiles.append(tile(folder, track, error, number))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % SHEET_COLUMNS)
    lines = [np.concatenate(tiles[i : i + SHEET_COLUMNS], axis=1) for i in range(0, len(tiles), SHEET_COLUMNS)]
    cv2.imwrite(str(file), np.concatenate(lines)[..., ::-1])


def tile(folder: Path, track: Track, distances: Floats, number: int) -> NDArray[np.uint8]:
    """Frame ``number`` of a sequence with both skeletons."""
    sequence = UtdMhadSequence(folder / "Depth" / f"{track.name}_t1_depth.mat")
    picture, scale = picture_of(*sequence.load(0, number))
    fit = track.fits[number]
    if fit is not None:
        draw(picture, sequence.cameras[0], fit.skeleton, fit.pose, scale)
    dots(picture, sequence.cameras[0], track.joints[number], scale)
    u = np.nonzero(picture.any(axis=(0, 2)))[0]  # the person fills a third of the width
    left = int(np.clip((u.min() + u.max() - TILE_WIDTH) // 2, 0, picture.shape[1] - TILE_WIDTH))
    picture = np.ascontiguousarray(picture[:, left : left + TILE_WIDTH])
    label = f"{track.name} {number}: {np.median(distances[number]) * 100:.0f} cm"
    cv2.putText(picture, label, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return picture
