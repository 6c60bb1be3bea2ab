"""Real daemons, real Zenoh, real signals: a person gets through, and comes back after either end was killed."""

from __future__ import annotations

import copy
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from receiver.config import ReceiverSettings
from receiver.decode import DecodeOptions, decode
from receiver.show_log import read_show_log
from scripts.daemon_processes import Running, Site, free_port, site

SHOWN, PUBLISHED = "telepose_frames_shown_total", "telepose_skeletons_published_total"
POSES = "telepose_repository_poses"
MAPS, LIVE = "telepose_maps_decoded_total", "telepose_live_surface"
SMALL_RIG = ("--width", "320", "--height", "240", "--fps", "15")  # leaves the test machine time for the rest


@pytest.fixture
def here(tmp_path: Path) -> Iterator[Site]:
    with site(tmp_path) as made:
        yield made


def test_a_person_gets_through_and_both_ends_leave_cleanly(here):
    log = here.folder / "shown.log"
    session = here.folder / "session.mcap"
    receiver = here.receiver("--log-shown", str(log), "--record", str(session))  # first: it waits for its sender
    here.rig(*SMALL_RIG)
    sender = here.sender()
    receiver.wait_for(POSES, 1)
    receiver.wait_for(SHOWN, receiver.metric(SHOWN) + 30)  # two seconds with it: a tick of the decoding below, and more
    assert 'telepose_region_sigma{region="head"} ' in receiver.get("/metrics")[1]
    assert receiver.get("/healthz") == (200, "ok\n")
    assert receiver.get("/readyz") == (200, "ok\n")
    for daemon in (sender, receiver):
        code, seconds = daemon.end()
        assert code == 0, daemon.log
        assert seconds < 2.5
    assert here.figures("sender")["skeleton_bytes_max"] <= 250
    assert 0 < here.figures("receiver")["time_to_first_body_s"] < 30
    assert 'site = "studio"' in here.figures("receiver")["settings"]
    kinds = {kind for kind, _, _ in read_show_log(log)}
    assert kinds == {"skeleton", "body", "pose", "frame", "tick"}
    said: list[str] = []
    assert decode(ReceiverSettings(), DecodeOptions(session, here.folder / "png", rate_hz=1.0), said.append) == 0
    last = cv2.imread(str(sorted((here.folder / "png").iterdir())[-1]))
    assert (last < 200).any(axis=2).sum() > 8000  # a body, not bones


def test_maps_get_through_to_whoever_shows_them_and_come_back(here):
    here.rig(*SMALL_RIG)
    sender = here.sender()
    sender.wait_for(PUBLISHED, 10)
    assert sender.metric("telepose_residual_packets_sent_total") == 0
    of_points = here.receiver("--points", name="points")
    of_points.wait_for(MAPS, 10)
    sender.wait_for("telepose_residual_level", 100)  # loopback has room for all
    of_points.end(signal.SIGKILL)
    live = here.receiver("--live", name="again")
    live.wait_for(MAPS, 5)
    live.wait_for(LIVE, 1)  # and the mesh on screen follows them


def test_a_killed_receiver_comes_back_to_the_picture(here):
    here.rig(*SMALL_RIG)
    here.sender()
    first = here.receiver()
    first.wait_for(POSES, 1)
    first.end(signal.SIGKILL)
    second = here.receiver(name="again")
    second.wait_for(POSES, 1)  # handed what the sender has, body included
    second.wait_for(SHOWN, 10)
    assert second.get("/readyz") == (200, "ok\n")


def test_a_killed_sender_goes_on_in_mid_motion(here):
    here.rig(*SMALL_RIG)
    receiver = here.receiver()
    sender = here.sender()
    receiver.wait_for(POSES, 1)
    body = here.folder / "studio-0.body"
    sender.wait_for(PUBLISHED, 60)
    assert body.exists()
    sender.end(signal.SIGKILL)
    shown = receiver.metric(SHOWN)
    here.sender()
    receiver.wait_for(SHOWN, shown + 20)  # the A-pose is over, so this takes the body that was kept
    receiver.wait_for(POSES, 1)


def test_ctrl_c_ends_a_receiver_that_never_found_its_sender(here):
    receiver = here.receiver()
    receiver.wait_for("telepose_frames_shown_total", 0)
    while receiver.get("/healthz")[0] != 200:
        assert receiver.process.poll() is None
    assert receiver.get("/readyz")[0] == 503
    code, seconds = receiver.end(signal.SIGINT)
    assert (code, seconds < 2.5) == (0, True)


def test_a_recording_that_is_not_there_is_an_error_in_one_line(here):
    sender = here.sender("--recording", str(here.folder / "nowhere"))
    assert sender.process.wait(30) == 1
    assert "nowhere" in sender.log.strip().splitlines()[-1]
    assert "Traceback" not in sender.log


def test_the_self_view_shows_the_person_comes_back_and_leaves_with_its_sender(here):
    here.rig(*SMALL_RIG)
    sender, page = with_self_view(here)
    page.wait_for(SHOWN, 10)
    assert "<title>telepose</title>" in page.get("/")[1]
    first = own_receiver(sender)
    os.kill(first, signal.SIGKILL)
    while page.get("/healthz")[0] == 200:
        time.sleep(0.02)
    page.wait_for(POSES, 1)
    second = own_receiver(sender)
    assert second != first
    sender.end(signal.SIGKILL)
    deadline = time.monotonic() + 5
    while os.path.exists(f"/proc/{second}"):
        assert time.monotonic() < deadline, "the self view outlived its sender"
        time.sleep(0.02)


def test_a_stopped_sender_ends_its_self_view_in_time(here):
    here.rig(*SMALL_RIG)
    sender, _ = with_self_view(here)
    receiver = own_receiver(sender)
    code, seconds = sender.end()
    assert (code, seconds < 2.5) == (0, True), sender.log
    assert not os.path.exists(f"/proc/{receiver}")


def with_self_view(here: Site) -> tuple[Running, Running]:
    """A sender, and the same as seen through the page of its self view, which shows a person."""
    port = free_port()
    sender = here.sender("--self-view", "--self-view-port", str(port))
    page = copy.copy(sender)
    page.http_port = port
    page.wait_for(POSES, 1)
    return sender, page


def own_receiver(sender: Running) -> int:
    """The process of the receiver that the sender has started."""
    children = Path(f"/proc/{sender.process.pid}/task").glob("*/children")
    started = [int(child) for file in children for child in file.read_text().split()]
    (receiver,) = [child for child in started if b"telepose-receive" in Path(f"/proc/{child}/cmdline").read_bytes()]
    return receiver
