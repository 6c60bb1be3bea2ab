"""The virtual rig as a process of its own, as real cameras are.

It renders each camera's next frames a little ahead of time into shared memory and announces them with the time at
which they are released (``frame_ring`` describes the protocol; ``virtual_rig`` holds a frame back until then). The
performance starts when the first reader comes and goes on without one: a sender that was killed and comes back finds
it further on. One reader at a time; a new one replaces the old.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import socket
import sys
import time
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import cv2
import msgpack
import numpy as np

from common.geometry.rasterizer import Surface, render_crop
from sender.capture.camera_record import camera_to_record
from sender.capture.frame_ring import PROTOCOL, FrameRing, RingLayout
from sender.capture.frame_set import CaptureError
from sender.capture.performer import Performer, open_performer
from sender.capture.rig_layout import RigSettings, cameras_around, room_view
from sender.capture.sensor_model import DepthSensor, SensorSettings, averaged

SLOTS = 8  # frames per camera in shared memory, ...
AHEAD = 3  # ... so many of them rendered ahead; a reader may be SLOTS − AHEAD frames behind
_ROOM_FRAMES = 20  # averaged for the empty room, as an operator would
_TEXELS = 2  # of a texture's longer side for each pixel of the picture's height
_START_NS = 300_000_000  # from the first reader to the first frame
_STATUS_NS = 1_000_000_000


@dataclass(slots=True)
class RigCounters:
    """``late``: finished after their release time; ``skipped``: never rendered, the rig was too slow;
    ``unannounced``: the reader's socket was full. ``cpu_s`` of the whole process."""

    cpu_s: float = 0.0
    frames: int = 0
    late: int = 0
    skipped: int = 0
    unannounced: int = 0


class RigRenderer:
    """Pictures of a performer in the room, by the rig's cameras."""

    def __init__(self, performer: Performer, settings: RigSettings) -> None:
        self.cameras = cameras_around(settings.cameras, settings.width, settings.height)
        self._performer = performer
        mesh = performer.mesh
        self._faces = np.ascontiguousarray(mesh.faces, np.int32)
        self._surface: Surface = mesh.vertex_colours
        if mesh.uv is not None and mesh.texture is not None:
            self._surface = np.ascontiguousarray(mesh.uv, np.float32), _reduced(mesh.texture, _TEXELS * settings.height)
        rooms = [room_view(camera) for camera in self.cameras]
        self._room_colours = [colour for colour, _ in rooms]
        sensor = SensorSettings() if settings.noise else None
        self._sensors = [
            DepthSensor(depth, camera.fx, sensor, settings.seed * 1000 + index)
            for index, (camera, (_, depth)) in enumerate(zip(self.cameras, rooms, strict=True))
        ]
        self._posed: tuple[float, np.ndarray] = (-1.0, np.zeros((0, 3), np.float32))

    def empty_room(self, camera: int) -> np.ndarray:
        """Averaged readings (H, W) uint16 [mm] of the room without the performer."""
        return averaged([self._sensors[camera].background_reading() for _ in range(_ROOM_FRAMES)])

    def empty_room_colour(self, camera: int) -> np.ndarray:
        """The picture (H, W, 3) uint8 of the room without the performer."""
        return self._room_colours[camera]

    def view(self, camera: int, time_s: float, depth: np.ndarray, colour: np.ndarray) -> None:
        """Fill ``depth`` (H, W) uint16 [mm] and ``colour`` (H, W, 3) uint8 with camera ``camera`` at ``time_s``."""
        if self._posed[0] != time_s:
            self._posed = time_s, self._performer.surface(time_s)
        colour[:] = self._room_colours[camera]
        mesh = self._posed[1], self._faces, self._surface
        crop = render_crop(*mesh, self.cameras[camera], cull_back=True, onto=colour)
        self._sensors[camera].measure(crop, depth)


def _reduced(texture: np.ndarray, size: int) -> np.ndarray:
    """The texture (h, w, 3) uint8 at most ``size`` wide and high: a finer one only flickers and misses the cache."""
    scale = min(size / max(texture.shape[:2]), 1.0)
    return np.ascontiguousarray(cv2.resize(texture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


class Rig:
    """The schedule: which frame of which camera is next, and whom to tell."""

    def __init__(self, renderer: RigRenderer, settings: RigSettings) -> None:
        self._renderer = renderer
        self._settings = settings
        self._period_ns = round(1e9 / settings.fps)
        count = len(renderer.cameras)
        self._skews_ns = [round(settings.skew_ms * 1e6 * i / max(count - 1, 1)) for i in range(count)]
        self._dropout = np.random.default_rng(settings.seed)
        self._ring, self._descriptor = FrameRing.create(RingLayout(count, SLOTS, settings.width, settings.height))
        for index in range(count):
            depth, colour = self._ring.room(index)
            depth[:], colour[:] = renderer.empty_room(index), renderer.empty_room_colour(index)
        renderer.view(0, 0.0, *(image.copy() for image in self._ring.room(0)))
        self.counters = RigCounters()
        self._epoch_ns = 0
        self._next = (1, 0)  # frame number, camera
        self._status_ns = 0
        self._begun_ns = self._instant_ns = 0  # start of an instant's rendering, and how long the last one took
        self._reader: socket.socket | None = None

    def close(self) -> None:
        """Let go of the reader and the memory."""
        self._drop_reader()
        os.close(self._descriptor)

    def run(self, listener: socket.socket, parent: int | None) -> None:
        """Serve readers until ``parent`` (a descriptor) reaches its end."""
        while True:
            wait_s = self._step()
            watched: list[socket.socket | int] = [listener]
            watched += [end for end in (self._reader, parent) if end is not None]
            for ready in select.select(watched, [], [], wait_s)[0]:
                if ready is listener:
                    self._greet(listener.accept()[0])
                elif ready is self._reader:
                    self._drop_reader()  # readers have nothing to say but that they are gone
                elif parent is not None and not os.read(parent, 4096):
                    return

    def _step(self) -> float | None:
        """Render and announce the next frame when it is time to; how long to wait [s], None for a reader to come."""
        if self._reader is None:
            return None
        now_ns = time.monotonic_ns()
        number, camera = self._next
        wait_ns = self._capture_ns(number, camera) - AHEAD * self._period_ns - now_ns
        if wait_ns > 0:
            return wait_ns / 1e9
        if camera == 0:
            self._next = number, camera = self._in_time(number, now_ns), 0
            self._begun_ns = now_ns
        self._render(number, camera, self._capture_ns(number, camera))
        self._next = (number, camera + 1)
        if camera + 1 == len(self._skews_ns):
            self._next = (number + 1, 0)
            self._instant_ns = min(time.monotonic_ns() - self._begun_ns, AHEAD * self._period_ns)
        self._report(now_ns)
        return 0.0

    def _in_time(self, number: int, now_ns: int) -> int:
        """The first frame from ``number`` on that can be ready when due: as cameras do, rather skip than be late."""
        behind = -(-(now_ns + self._instant_ns - self._capture_ns(number, 0)) // self._period_ns)
        skipped = max(behind, 0)
        self.counters.skipped += skipped * len(self._skews_ns)
        return number + skipped

    def _render(self, number: int, camera: int, due_ns: int) -> None:
        with self._ring.writing(camera, number) as (depth, colour):
            self._renderer.view(camera, (due_ns - self._epoch_ns) / 1e9, depth, colour)
        self.counters.frames += 1
        self.counters.late += time.monotonic_ns() > due_ns
        if self._dropout.random() >= self._settings.dropout and not self._send(["frame", camera, number, due_ns]):
            self.counters.unannounced += 1

    def _capture_ns(self, number: int, camera: int) -> int:
        return self._epoch_ns + (number - 1) * self._period_ns + self._skews_ns[camera]

    def _report(self, now_ns: int) -> None:
        if now_ns - self._status_ns >= _STATUS_NS:
            self._status_ns = now_ns
            self.counters.cpu_s = time.process_time()
            self._send(["status", asdict(self.counters)])

    def _greet(self, reader: socket.socket) -> None:
        """Welcome a reader in place of the last one; the first one starts the performance."""
        self._drop_reader()
        now_ns = time.monotonic_ns()
        self._epoch_ns = self._epoch_ns or now_ns + _START_NS
        self._next = max(self._next, ((now_ns - self._epoch_ns) // self._period_ns + 2, 0))
        reader.setblocking(False)
        hello = {
            "protocol": PROTOCOL,
            "cameras": [camera_to_record(camera) for camera in self._renderer.cameras],
            "frame_rate_hz": self._settings.fps,
            "epoch_ns": self._epoch_ns,
            "slots": SLOTS,
        }
        self._reader = reader
        try:
            socket.send_fds(reader, [msgpack.packb(["hello", hello])], [self._descriptor])
        except OSError:
            self._drop_reader()

    def _send(self, message: list[object]) -> bool:
        """Whether the message went out; a reader that is gone is dropped."""
        if self._reader is None:
            return False
        try:
            self._reader.send(msgpack.packb(message))
        except BlockingIOError:
            return False
        except OSError:
            self._drop_reader()
            return False
        return True

    def _drop_reader(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def listen(path: Path) -> socket.socket:
    """A Unix socket at ``path``; a socket left there by a killed rig is removed.

    Raises:
        CaptureError: a rig is answering there already, or the path cannot be used.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        if path.is_socket():
            with closing(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)) as probe:
                probe.settimeout(1.0)
                if probe.connect_ex(str(path)) == 0:
                    raise CaptureError(f"another rig is answering at {path}")
            path.unlink()
        listener.bind(str(path))
        listener.listen(2)
    except OSError as error:
        listener.close()
        raise CaptureError(f"socket {path}: {error}") from error
    except CaptureError:
        listener.close()
        raise
    return listener


def main(arguments: list[str] | None = None) -> int:
    """Run the rig until SIGTERM, SIGINT or the parent's end; 0 on a clean end, 2 when it cannot start."""
    options = _parser().parse_args(arguments)
    for stop in (signal.SIGTERM, signal.SIGINT):
        signal.signal(stop, lambda *_: sys.exit(0))
    cv2.setNumThreads(1)
    try:
        settings = RigSettings(**{field.name: getattr(options, field.name) for field in fields(RigSettings)})
        data = Path(settings.data) if settings.data else None
        rig = Rig(RigRenderer(open_performer(settings.performer, settings.motion, data), settings), settings)
        listener = listen(options.socket)
    except (CaptureError, ValueError) as error:
        sys.stderr.write(f"rig: {error}\n")
        return 2
    try:
        with closing(rig), listener:
            rig.run(listener, sys.stdin.fileno() if options.exit_with_parent else None)
    finally:
        with suppress(OSError):
            options.socket.unlink()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="rig_process", description="Virtual depth cameras around a performer.")
    defaults = RigSettings()
    add = parser.add_argument
    add("--socket", type=Path, required=True, help="Unix socket to announce frames on")
    add("--performer", default=defaults.performer, help="'builtin' or a body of DATA/bodies")
    add("--motion", help="a clip of DATA/mocap; without it the built-in routine")
    add("--data", help="folder with bodies/ and mocap/")
    add("--cameras", type=int, default=defaults.cameras)
    add("--width", type=int, default=defaults.width)
    add("--height", type=int, default=defaults.height)
    add("--fps", type=float, default=defaults.fps)
    add("--seed", type=int, default=defaults.seed)
    add("--skew-ms", type=float, default=defaults.skew_ms, help="how much later the last camera's shutter opens")
    add("--dropout", type=float, default=defaults.dropout, help="probability that a frame is lost")
    add("--noise", action=argparse.BooleanOptionalAction, default=defaults.noise, help="the sensor model")
    add("--exit-with-parent", action="store_true", help="end when standard input does")
    return parser


if __name__ == "__main__":
    sys.exit(main())
