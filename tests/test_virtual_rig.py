"""The rig's process and its reader: pixels, times, slow readers, restarts, and how either end dies."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import msgpack
import numpy as np
import pytest

from common.geometry.camera_model import project
from sender.capture.frame_ring import FrameRing, RingLayout
from sender.capture.frame_set import CaptureError, DepthFrame
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import SLOTS, Rig, RigRenderer, _reduced, listen, main
from sender.capture.virtual_rig import VirtualRig

SMALL = RigSettings(cameras=2, width=64, height=48, fps=60)
CUBE = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (0.8, 1.2) for z in (-0.2, 0.2)], np.float32)
CUBE_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]], np.int32,
)  # fmt: skip


class MovingCube:
    """Rises by 0.1 m a second: the height seen tells the time."""

    name, duration_s = "cube", 10.0
    mesh = SimpleNamespace(
        faces=CUBE_FACES, vertex_colours=np.full((8, 3), (250, 0, 0), np.uint8), uv=None, texture=None
    )

    def surface(self, time_s: float) -> np.ndarray:
        return CUBE + np.array([0, 0.1 * time_s, 0], np.float32)

    def named_joints(self, time_s: float) -> np.ndarray:
        return np.zeros((16, 3), np.float32)


class SlowCube(MovingCube):
    def surface(self, time_s: float) -> np.ndarray:
        time.sleep(0.05)
        return super().surface(time_s)


@dataclass
class RunningRig:
    path: Path
    rig: Rig
    stop: Callable[[], None]


@contextmanager
def running(folder: Path, settings: RigSettings = SMALL, performer: MovingCube | None = None) -> Iterator[RunningRig]:
    """The rig in a thread of this process, with a pipe for its parent."""
    path = folder / "rig.sock"
    rig = Rig(RigRenderer(performer or MovingCube(), settings), settings)  # type: ignore[arg-type]
    parent, stop = os.pipe()
    listener = listen(path)
    thread = threading.Thread(target=rig.run, args=(listener, parent))
    thread.start()

    def end() -> None:
        if thread.is_alive():
            os.close(stop)
            thread.join(5)
            rig.close()
            listener.close()
            os.close(parent)

    try:
        yield RunningRig(path, rig, end)
    finally:
        end()


def read_frames(source: VirtualRig, count: int) -> list[DepthFrame]:
    frames = []
    for _ in range(count):
        frame = source.read(2.0)
        assert frame is not None
        frames.append(frame)
    return frames


def test_frames_come_from_all_cameras_in_order_and_not_before_their_time(tmp_path: Path) -> None:
    with running(tmp_path) as rig, closing(VirtualRig.attach(rig.path)) as source:
        assert [camera.name for camera in source.cameras] == ["cam1", "cam2"]
        assert source.frame_rate_hz == 60
        frames = []
        for _ in range(12):
            frame = source.read(2.0)
            assert frame is not None
            assert time.monotonic_ns() >= frame.capture_ns
            frames.append(frame)
    assert {frame.camera_index for frame in frames} == {0, 1}
    times = [frame.capture_ns for frame in frames]
    assert times == sorted(times)
    for frame in frames:  # times are exact multiples of the period after the epoch
        assert frame.capture_ns - source.epoch_ns == (frame.sequence - 1) * round(1e9 / 60)
    assert source.lost == 0


def test_a_frame_shows_the_performer_at_its_capture_time(tmp_path: Path) -> None:
    settings = RigSettings(cameras=2, width=160, height=120, fps=30, noise=False)
    with running(tmp_path, settings) as rig, closing(VirtualRig.attach(rig.path)) as source:
        frames = read_frames(source, 20)
        rooms = source.empty_room
    for frame in frames[::5]:
        room = rooms[frame.camera_index]
        assert room is not None
        assert frame.colour is not None
        person = frame.depth_mm < room - 100.0
        v, u = np.nonzero(person)
        truth = MovingCube().surface((frame.capture_ns - source.epoch_ns) / 1e9)
        corners, depths = project(source.cameras[frame.camera_index], truth)
        assert v.min() == pytest.approx(corners[:, 1].min(), abs=1.01)
        assert v.max() == pytest.approx(corners[:, 1].max(), abs=1.01)
        assert u.min() == pytest.approx(corners[:, 0].min(), abs=1.01)
        assert frame.depth_mm[person].min() == pytest.approx(1000 * depths.min(), abs=12)
        assert (frame.colour[person] == (250, 0, 0)).all()
        assert (frame.colour[~person] != (250, 0, 0)).any(axis=-1).all()


def test_frames_are_the_readers_own(tmp_path: Path) -> None:
    with running(tmp_path) as rig, closing(VirtualRig.attach(rig.path)) as source:
        frame = read_frames(source, 1)[0]
        before = frame.depth_mm.copy()
        read_frames(source, 2 * SLOTS * 2)  # the slot has been written again since
        np.testing.assert_array_equal(frame.depth_mm, before)


def test_a_slow_reader_loses_frames_and_knows_how_many(tmp_path: Path) -> None:
    with running(tmp_path) as rig, closing(VirtualRig.attach(rig.path)) as source:
        first = read_frames(source, 1)[0]
        time.sleep(2 * SLOTS / 60)
        following = read_frames(source, 1)[0]
        rest = read_frames(source, 20)
        seen = {(f.camera_index, f.sequence) for f in (first, following, *rest)}
        newest = rest[-1].sequence
        assert source.lost > 0
        assert len(seen) + source.lost >= 2 * (newest - first.sequence)
        assert following.sequence > first.sequence + SLOTS


def test_the_performance_goes_on_while_no_one_reads(tmp_path: Path) -> None:
    with running(tmp_path) as rig:
        with closing(VirtualRig.attach(rig.path)) as source:
            before = read_frames(source, 2)[-1]
        time.sleep(0.3)
        with closing(VirtualRig.attach(rig.path)) as source:
            after = read_frames(source, 2)[0]
            assert source.epoch_ns == (before.capture_ns - (before.sequence - 1) * round(1e9 / 60))
    assert after.capture_ns - before.capture_ns > 0.25e9


def test_a_new_reader_replaces_the_old_one(tmp_path: Path) -> None:
    with running(tmp_path) as rig, closing(VirtualRig.attach(rig.path)) as old:
        read_frames(old, 1)
        with closing(VirtualRig.attach(rig.path)) as new:
            read_frames(new, 4)
            with pytest.raises(CaptureError, match="ended"):
                read_frames(old, 100)


def test_texture_finer_than_the_pictures_is_averaged_and_a_coarse_one_kept() -> None:
    checker = np.indices((2048, 1024)).sum(axis=0) % 2 * 200
    fine = np.repeat(checker[..., None], 3, axis=2).astype(np.uint8)
    reduced = _reduced(fine, 1024)
    assert reduced.shape == (1024, 512, 3)
    assert (reduced == 100).all()
    np.testing.assert_array_equal(_reduced(fine[:600, :500], 1024), fine[:600, :500])


def test_skew_and_dropout_are_those_asked_for(tmp_path: Path) -> None:
    settings = RigSettings(cameras=3, width=64, height=48, fps=60, skew_ms=4, dropout=0.3)
    with running(tmp_path, settings) as rig, closing(VirtualRig.attach(rig.path)) as source:
        frames = read_frames(source, 90)
    for frame in frames:
        offset = frame.capture_ns - source.epoch_ns - (frame.sequence - 1) * round(1e9 / 60)
        assert offset == (0, 2_000_000, 4_000_000)[frame.camera_index]
    expected = 3 * (max(f.sequence for f in frames) - min(f.sequence for f in frames))
    assert 0.5 < len(frames) / expected < 0.9
    assert source.lost == 0


def test_a_rig_that_is_too_slow_says_so_and_leaves_out_whole_instants(tmp_path: Path) -> None:
    with running(tmp_path, performer=SlowCube()) as rig, closing(VirtualRig.attach(rig.path)) as source:
        frames = read_frames(source, 24)
        assert rig.rig.counters.late + rig.rig.counters.skipped > 0
    whole = {frame.sequence for frame in frames if frame.camera_index == 0}
    assert len(whole) >= 11
    assert max(whole) - min(whole) > 2 * len(whole)


def test_status_reports_cpu_and_frames(tmp_path: Path) -> None:
    with running(tmp_path) as rig, closing(VirtualRig.attach(rig.path)) as source:
        read_frames(source, 130)
        assert source.status["frames"] >= 100
        assert source.status["cpu_s"] > 0
        assert set(source.status) == {"cpu_s", "frames", "late", "skipped", "unannounced"}


def test_reading_times_out_without_a_frame(tmp_path: Path) -> None:
    with running(tmp_path) as rig, closing(VirtualRig.attach(rig.path)) as source:
        assert source.read(0.0) is None  # the first frame is due 0.3 s after the first reader came


def test_end_of_the_rig_is_an_error_for_its_reader(tmp_path: Path) -> None:
    with running(tmp_path) as rig, closing(VirtualRig.attach(rig.path)) as source:
        read_frames(source, 1)
        rig.stop()
        with pytest.raises(CaptureError, match="the rig ended"):
            read_frames(source, 100)


def test_nobody_at_the_socket_is_an_error_with_its_path(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"no\.sock"):
        VirtualRig.attach(tmp_path / "no.sock")


@pytest.mark.parametrize(
    "greeting",
    [
        b"",
        b"\xc1",
        msgpack.packb(["hello", {"protocol": 99}]),
        msgpack.packb(["hello", {"protocol": 1}]),
        msgpack.packb(["hello", {"protocol": 1, "cameras": [{"name": "x"}], "frame_rate_hz": 30, "epoch_ns": 0}]),
        msgpack.packb(7),
    ],
)
def test_a_stranger_at_the_socket_is_an_error(tmp_path: Path, greeting: bytes) -> None:
    with ExitStack() as stack:
        listener = stack.enter_context(closing(listen(tmp_path / "s.sock")))
        file = stack.enter_context((tmp_path / "memory").open("w+b"))

        def greet() -> None:
            with closing(listener.accept()[0]) as reader:
                if greeting:
                    socket.send_fds(reader, [greeting], [file.fileno()])

        thread = threading.Thread(target=greet)
        thread.start()
        with pytest.raises(CaptureError):
            VirtualRig.attach(tmp_path / "s.sock")
        thread.join()


def test_torn_and_overwritten_frames_are_not_read() -> None:
    layout = RingLayout(cameras=1, slots=2, width=8, height=4)
    ring, descriptor = FrameRing.create(layout)
    reader = FrameRing.attach(descriptor, layout)
    os.close(descriptor)
    with ring.writing(0, 1) as (depth, colour):
        depth[:], colour[:] = 7, 9
        assert reader.copy(0, 1) is None
    pixels = reader.copy(0, 1)
    assert pixels is not None
    assert (pixels[0] == 7).all()
    assert (pixels[1] == 9).all()
    with ring.writing(0, 3) as (depth, _):  # the same slot
        depth[:2] = 8
        assert reader.copy(0, 1) is None
        assert reader.copy(0, 3) is None
    assert reader.copy(0, 1) is None
    assert reader.copy(0, 3) is not None


def test_memory_smaller_than_announced_is_refused() -> None:
    ring, descriptor = FrameRing.create(RingLayout(1, 2, 8, 4))
    with pytest.raises(ValueError, match="expected"):
        FrameRing.attach(descriptor, RingLayout(1, 200, 8, 4))
    os.close(descriptor)
    assert ring.layout.total_bytes < RingLayout(1, 200, 8, 4).total_bytes


def test_stale_socket_of_a_killed_rig_is_taken_over_and_a_live_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "rig.sock"
    listen(path).close()  # leaves the file behind
    assert path.exists()
    with closing(listen(path)), pytest.raises(CaptureError, match="another rig"):
        listen(path)


def test_settings_that_make_no_rig_are_refused() -> None:
    for wrong in ({"cameras": 0}, {"fps": 0}, {"dropout": 1.0}, {"width": 4}, {"skew_ms": -1}):
        with pytest.raises(ValueError, match="virtual rig"):
            RigSettings(**wrong)  # type: ignore[arg-type]


def test_command_line_names_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stops = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        assert main(["--socket", str(tmp_path / "s"), "--performer", "nobody"]) == 2
        assert "nobody" in capsys.readouterr().err
    finally:
        for number, handler in stops.items():
            signal.signal(number, handler)


def test_started_rig_has_its_settings_and_its_end_is_noticed() -> None:
    settings = RigSettings(cameras=2, width=80, height=60, fps=20, noise=False, skew_ms=3)
    with closing(VirtualRig.start(settings)) as source:
        assert len(source.cameras) == 2
        assert (source.cameras[0].width, source.cameras[0].height, source.frame_rate_hz) == (80, 60, 20)
        frames = read_frames(source, 2)
        assert frames[1].capture_ns - frames[0].capture_ns == 3_000_000
        assert source._process is not None
        os.kill(source._process.pid, signal.SIGKILL)
        with pytest.raises(CaptureError, match="the rig ended: exit code -9"):
            read_frames(source, 100)


def test_a_rig_that_cannot_start_says_why() -> None:
    with pytest.raises(CaptureError, match="nobody"):
        VirtualRig.start(RigSettings(performer="nobody"))


@pytest.mark.parametrize("way", ["sigterm", "parent"])
def test_process_ends_cleanly_and_removes_its_socket(tmp_path: Path, way: str) -> None:
    path = tmp_path / "rig.sock"
    command = [sys.executable, "-m", "sender.capture.rig_process", "--socket", str(path), "--cameras", "1"]
    root = Path(__file__).parents[1]
    options = ["--width", "64", "--height", "48", "--exit-with-parent"]
    child = subprocess.Popen([*command, *options], stdin=subprocess.PIPE, cwd=root)
    try:
        deadline = time.monotonic() + 30
        while not path.exists():
            assert time.monotonic() < deadline
            assert child.poll() is None
            time.sleep(0.05)
        time.sleep(0.1)
        if way == "parent":
            assert child.stdin is not None
            child.stdin.close()
        else:
            child.send_signal(signal.SIGTERM)
        assert child.wait(10) == 0
        assert not path.exists()
    finally:
        child.kill()
        child.wait()
