"""The virtual rig as a ``FrameSource``: starts the rig's process, or attaches to a running one."""

from __future__ import annotations

import heapq
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import fields
from pathlib import Path
from typing import IO, Any

import msgpack
import numpy as np
from numpy.typing import NDArray

import sender
from common.geometry.camera_model import Camera
from sender.capture.camera_record import camera_from_record
from sender.capture.frame_ring import MAX_MESSAGE_BYTES, PROTOCOL, FrameRing, RingLayout
from sender.capture.frame_set import CaptureError, ColourFrame, DepthFrame, Frame
from sender.capture.rig_layout import RigSettings

START_TIMEOUT_S = 60.0  # a first start compiles kernels
SILENCE_S = 5.0  # a rig reports every second


class VirtualRig:
    """Frames of a rig process, each no earlier than its capture time; the arrays are copies of the caller's own.

    ``epoch_ns``: when the performance started; a frame shows ``time_s = (capture_ns - epoch_ns) / 1e9``.
    ``lost``: frames that were overwritten before they were read. ``status``: the rig's own last report
    (cpu_s, frames, late, skipped, unannounced). Not thread-safe: close it when no thread is reading any more.
    """

    def __init__(self, connection: socket.socket, process: RigProcess | None = None, depth: bool = True) -> None:
        """Use ``start`` or ``attach``."""
        self._has_depth = depth
        self._connection = connection
        self._process = process
        self._announced: list[tuple[int, int, int]] = []  # heap of (capture_ns, camera, number)
        self._heard_s = time.monotonic()
        self.lost = 0
        self.status: dict[str, float] = {}
        try:
            self._read_hello()
        except (ValueError, KeyError, TypeError, msgpack.UnpackException) as error:
            raise CaptureError(f"rig's greeting: {error}") from error

    @classmethod
    def start(cls, settings: RigSettings, depth: bool = True) -> VirtualRig:
        """Start a rig that ends with this process. ``depth`` False: as if its cameras saw colour only.

        Raises:
            CaptureError: the rig did not start; the message has its last words.
        """
        process = RigProcess(settings)
        try:
            return cls(process.connect(START_TIMEOUT_S), process, depth)
        except BaseException:
            process.close()
            raise

    @classmethod
    def attach(cls, socket_path: Path, depth: bool = True) -> VirtualRig:
        """Use the rig listening at ``socket_path``; ``depth`` as for ``start``.

        Raises:
            CaptureError: nobody answers there.
        """
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connection.settimeout(SILENCE_S)
            connection.connect(str(socket_path))
            return cls(connection, depth=depth)
        except OSError as error:
            connection.close()
            raise CaptureError(f"no rig at {socket_path}: {error}") from error
        except CaptureError:
            connection.close()
            raise

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self._cameras

    @property
    def has_depth(self) -> bool:
        return self._has_depth

    @property
    def empty_room(self) -> tuple[NDArray[Any] | None, ...]:
        return self._rooms

    @property
    def room_colour(self) -> tuple[NDArray[np.uint8] | None, ...]:
        return self._room_colours

    @property
    def frame_rate_hz(self) -> float:
        return self._frame_rate_hz

    @property
    def start_joints(self) -> None:
        """A rig knows the truth, and does not tell."""

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame of any camera in order of capture, or None when none is due in time.

        Raises:
            CaptureError: the rig ended or has been silent for too long.
        """
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            now_ns = time.monotonic_ns()
            while self._announced and self._announced[0][0] <= now_ns:
                frame = self._taken(*heapq.heappop(self._announced))
                if frame is not None:
                    return frame
            next_ns = min(deadline_ns, self._announced[0][0]) if self._announced else deadline_ns
            if not self._hear(max(next_ns - now_ns, 0) / 1e9) and now_ns >= deadline_ns:
                return None

    def close(self) -> None:
        """Detach, and end the rig if it was started here."""
        self._connection.close()
        if self._process is not None:
            self._process.close()

    def _taken(self, capture_ns: int, camera: int, number: int) -> Frame | None:
        pixels = self._ring.copy(camera, number)
        if pixels is None:
            self.lost += 1
            return None
        depth_mm, colour = pixels
        if not self._has_depth:
            return ColourFrame(camera, number, capture_ns, colour)
        return DepthFrame(camera, number, capture_ns, depth_mm, colour)

    def _hear(self, wait_s: float) -> bool:
        """Take in the messages that are there or come within ``wait_s``; whether there were any."""
        heard = False
        while select.select([self._connection], [], [], 0 if heard else wait_s)[0]:
            heard = True
            self._heard_s = time.monotonic()
            self._take_in(self._receive())
        if time.monotonic() - self._heard_s > SILENCE_S:
            raise CaptureError(f"the rig has been silent for {SILENCE_S:.0f} s")
        return heard

    def _receive(self) -> bytes:
        try:
            message = self._connection.recv(MAX_MESSAGE_BYTES)
        except OSError:
            message = b""
        if not message:
            last_words = self._process.last_words() if self._process is not None else ""
            raise CaptureError(f"the rig ended{': ' if last_words else ''}{last_words}")
        return message

    def _take_in(self, message: bytes) -> None:
        kind, *content = msgpack.unpackb(message)
        if kind == "frame":
            camera, number, capture_ns = content
            heapq.heappush(self._announced, (capture_ns, camera, number))
        elif kind == "status":
            self.status = content[0]

    def _read_hello(self) -> None:
        """Learn cameras and memory from the rig's first message.

        Raises:
            CaptureError: no answer. ValueError, KeyError, TypeError: not a greeting of this protocol.
        """
        try:
            message, descriptors, _, _ = socket.recv_fds(self._connection, MAX_MESSAGE_BYTES, 1)
        except OSError as error:
            raise CaptureError(f"the rig does not answer: {error}") from error
        try:
            if not message or not descriptors:
                raise CaptureError("the rig closed the connection instead of greeting")
            kind, hello = msgpack.unpackb(message)
            if kind != "hello" or hello["protocol"] != PROTOCOL:
                raise ValueError(f"{kind} of protocol {hello.get('protocol')}, expected {PROTOCOL}")
            self._set_up(hello, descriptors[0])
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def _set_up(self, hello: dict[str, Any], descriptor: int) -> None:
        self._cameras = tuple(camera_from_record(record) for record in hello["cameras"])
        self._frame_rate_hz = float(hello["frame_rate_hz"])
        self.epoch_ns = int(hello["epoch_ns"])
        width, height = self._cameras[0].width, self._cameras[0].height
        self._ring = FrameRing.attach(descriptor, RingLayout(len(self._cameras), hello["slots"], width, height))
        rooms = [self._ring.room(index) for index in range(len(self._cameras))]
        self._rooms = tuple(depth.copy() if self._has_depth else colour[None].copy() for depth, colour in rooms)
        self._room_colours = tuple(colour.copy() if self._has_depth else None for _, colour in rooms)


class RigProcess:
    """A child process running ``rig_process``, which ends when this one does."""

    def __init__(self, settings: RigSettings) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="telepose-rig-")
        self._socket_path = Path(self._folder.name) / "rig.sock"
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the process)
        root = str(Path(sender.__file__).parents[1])
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
            "OPENBLAS_NUM_THREADS": "1",
        }
        command = [sys.executable, "-m", "sender.capture.rig_process", "--exit-with-parent"]
        self._child = subprocess.Popen(
            [*command, "--socket", str(self._socket_path), *_arguments(settings)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            env=environment,
            start_new_session=True,  # Ctrl-C is for the sender, which then ends the rig
        )

    @property
    def pid(self) -> int:
        return self._child.pid

    def connect(self, timeout_s: float) -> socket.socket:
        """A connection, as soon as the rig listens.

        Raises:
            CaptureError: it ended first, or did not listen in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            if self._child.poll() is not None:
                raise CaptureError(f"the rig did not start: {self.last_words()}")
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            connection.settimeout(SILENCE_S)
            if connection.connect_ex(str(self._socket_path)) == 0:
                return connection
            connection.close()
            time.sleep(0.02)
        raise CaptureError(f"the rig did not listen within {timeout_s:.0f} s")

    def last_words(self) -> str:
        """The last line it wrote to standard error, or its exit code."""
        try:
            code = self._child.wait(1.0)
        except subprocess.TimeoutExpired:
            return "still running"
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"exit code {code}"

    def close(self) -> None:
        """End it at once: it has nothing to save, and its socket lies in the folder removed here."""
        self._child.kill()
        self._child.wait()
        assert self._child.stdin is not None
        self._child.stdin.close()
        self._errors.close()
        self._folder.cleanup()


def _arguments(settings: RigSettings) -> list[str]:
    """The command line that gives ``rig_process`` these settings."""
    arguments = []
    for field in fields(settings):
        value = getattr(settings, field.name)
        name = "--" + field.name.replace("_", "-")
        if isinstance(value, bool):
            arguments.append(name if value else f"--no-{field.name}")
        elif value is not None:
            arguments += [name, str(value)]
    return arguments
