"""Draw the received skeletons over the recording they were found in: ``overlay.py RECORDING OUT.png [FRAMES OPTIONS]``

Runs both daemons on the recording (once, as fast as frames are fitted) and makes a contact sheet of frames spread over
it, by each camera in turn: depth in grey, silhouettes, or colour where there is some; joints that were not seen are
left out. The sender gets the OPTIONS, such as ``--tracker particles``.
"""

from __future__ import annotations

import bisect
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_PARENTS, Skeleton
from common.body.skeleton_pose import SkeletonPose, bone_segments, forward_kinematics
from common.geometry.camera_model import Camera, project
from common.wire.skeleton_packet import SkeletonPacket
from scripts.daemon_processes import site
from scripts.demo_report import read_session
from sender.capture.recorded_rig import Recording, open_recording

SEEN = 0.2  # least confidence of a link that is drawn
LEFT, RIGHT, MIDDLE = (80, 200, 255), (255, 150, 60), (120, 255, 120)
TILE_HEIGHT, COLUMNS = 360, 4


def main() -> None:
    """The command line."""
    recording_path, out = Path(sys.argv[1]), Path(sys.argv[2])
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 8
    recording = open_recording(recording_path)
    with tempfile.TemporaryDirectory(prefix="telepose-overlay-") as folder, site(Path(folder)) as here:
        log = here.folder / "shown.log"
        receiver = here.receiver("--log-shown", str(log))
        sender = here.sender("--recording", str(recording_path), "--as-fast-as-possible", *sys.argv[4:])
        assert sender.process.wait(300) == 0, sender.log
        assert receiver.end()[0] == 0, receiver.log
        session, epoch_ns = read_session(log), int(here.figures("sender")["source_epoch_ns"])
        print(here.figures("sender")["dropped"], here.figures("receiver")["dropped"])
    packets = sorted(session.skeletons.values(), key=lambda packet: packet.capture_ns)
    times_ns = [packet.capture_ns - epoch_ns for packet in packets]
    print(f"{len(packets)} skeletons for {len(recording.frames)} frames")
    tiles = []
    for turn, share in enumerate(np.linspace(0, 1, count)):  # by all cameras in turn
        shown = [frame for frame in recording.frames if frame[1] == turn % len(recording.cameras)]
        time_ns, camera, number = shown[int(share * (len(shown) - 1))]
        at = bisect.bisect_right(times_ns, time_ns + 1_000_000) - 1
        packet = packets[at] if at >= 0 else None
        tiles.append(tile(recording, camera, number, packet, session.bodies))
    blank = np.zeros_like(tiles[0])
    tiles += [blank] * (-len(tiles) % COLUMNS)
    rows = [np.concatenate(tiles[i : i + COLUMNS], axis=1) for i in range(0, len(tiles), COLUMNS)]
    cv2.imwrite(str(out), np.concatenate(rows)[..., ::-1])


def tile(
    recording: Recording, camera: int, number: int, packet: SkeletonPacket | None, bodies: dict[int, Skeleton]
) -> NDArray[np.uint8]:
    """One frame with its skeleton."""
    picture, scale = picture_of(*recording.load(camera, number))
    if packet is not None and packet.body_revision in bodies:
        draw(picture, recording.cameras[camera], bodies[packet.body_revision], packet.pose, scale)
        label = f"{number}: fit {packet.fit_confidence:.2f}"
    else:
        label = f"{number}: no skeleton"
    cv2.putText(picture, label, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def picture_of(first: NDArray[Any] | None, colour: NDArray[np.uint8] | None) -> tuple[NDArray[np.uint8], float]:
    """A frame as a picture of ``TILE_HEIGHT`` rows, and how much larger that is than the frame. ``first``: its depth
    [mm] uint16 or its silhouette uint8; one of both may be None."""
    assert first is not None or colour is not None
    if first is None:
        assert colour is not None
        picture = colour
    else:
        grey = shaded(first) if first.dtype == np.uint16 else first // 2
        picture = np.repeat(grey[..., None], 3, axis=2)
        if colour is not None:
            picture = (colour // 2 + picture // 2).astype(np.uint8)
    scale = TILE_HEIGHT / picture.shape[0]
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale), np.uint8), scale


def shaded(depth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Near is light; no reading is black."""
    near, far = np.percentile(depth[depth > 0], [1, 99]) if np.any(depth > 0) else (0, 1)
    grey = np.clip(230 - 180 * (depth.astype(float) - near) / max(far - near, 1), 30, 255)
    return np.where(depth > 0, grey, 0).astype(np.uint8)


def draw(picture: NDArray[np.uint8], camera: Camera, skeleton: Skeleton, pose: SkeletonPose, scale: float) -> None:
    """Bones of the links that were seen, in the picture's pixels."""
    starts, ends = bone_segments(skeleton, forward_kinematics(skeleton, pose))
    first, _ = project(camera, starts)
    last, _ = project(camera, ends)
    for link in range(len(LINK_PARENTS)):
        if pose.confidence[link] < SEEN:
            continue
        colour = MIDDLE if link < 5 else LEFT if link < 14 else RIGHT
        a, b = (tuple(int(v) for v in end[link] * scale) for end in (first, last))
        cv2.line(picture, a, b, colour, 2, cv2.LINE_AA)
        cv2.circle(picture, a, 3, colour, -1, cv2.LINE_AA)


def dots(picture: NDArray[np.uint8], camera: Camera, points: NDArray[np.floating], scale: float) -> None:
    """White dots at ``points`` (N, 3) [m, world], in the picture's pixels."""
    pixels, _ = project(camera, points)
    for u, v in pixels * scale:
        cv2.circle(picture, (int(u), int(v)), 3, (255, 255, 255), 1, cv2.LINE_AA)


if __name__ == "__main__":
    main()
