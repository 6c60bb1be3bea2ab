"""``telepose-send encode`` and ``telepose-receive decode``: a person gets through without a network."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import aclosing
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pytest

from common.body.link_points import LinkPoints
from common.geometry.rasterizer import render
from common.runtime.daemon import Daemon
from common.runtime.http_settings import HttpSettings
from common.runtime.session_recording import SessionReader, SessionWriter, StoredMessage
from common.transport.channels import CHANNELS
from common.transport.chunks import ChunkAssembler, decode_chunk
from common.transport.temporal_layers import LAYERS, layer_of
from common.wire.residual_packet import decode_residual_header, is_residual
from common.wire.residual_video import frame_count
from common.wire.skeleton_packet import decode_skeleton, encode_skeleton
from receiver.cli import run_decode
from receiver.config import ReceiverSettings, ViewSettings
from receiver.decode import DAMAGED, DecodeError, DecodeOptions, captured_rate_hz, decode
from receiver.decoded_files import camera_before
from receiver.session_log import SessionLog
from receiver.session_page import SessionPage
from receiver.session_player import SessionPlayer, display_ticks
from receiver.viewer.page_client import follow
from scripts.daemon_processes import free_port
from scripts.fidelity import compare
from sender.cli import run_encode
from sender.config import CandidateSettings, ResidualStreamSettings, SenderSettings
from sender.encode import EncodeError, EncodeOptions, encode
from sender.session_encoder import frame_sets
from tests.rig_scene import RATE_HZ, performer
from tests.stored_session import FRAMES, encoded, write_frames

T = TypeVar("T")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_frames(tmp_path_factory.mktemp("recording") / "performer")


@pytest.fixture(scope="module")
def session(recording: Path) -> Path:
    file = recording.parent / "session.mcap"
    encoded(recording, file)
    return file


@pytest.fixture(scope="module")
def video_session(recording: Path) -> Path:
    pytest.importorskip("av")
    file = recording.parent / "video.mcap"
    encoded(recording, file, settings=SenderSettings(residuals=ResidualStreamSettings(video_frames=8)))
    return file


def decoded(session: Path, out: Path, **how: object) -> tuple[int, list[str]]:
    said: list[str] = []
    settings = ReceiverSettings(view=ViewSettings(headless=True))
    return decode(settings, DecodeOptions(session, out, **how), said.append), said  # type: ignore[arg-type]


def test_a_session_is_the_messages_of_the_channels_in_order(session):
    stored = list(SessionReader(session, "v1").messages())
    by_channel = {channel.name: channel for channel in CHANNELS if channel.recorded}
    for message in stored:
        channel = by_channel[message.key.split("/")[3]]
        assert channel.min_bytes <= len(message.payload) <= channel.max_bytes
    layers = {is_residual(message) for message in whole_messages(stored)}
    assert layers == {True, False}
    assert {message.key for message in stored} == {
        f"v1/studio/0/{name}" for name in (*(f"skeleton/{layer}" for layer in range(LAYERS)), "body", "bulk/session")
    }
    assert [message.time_ns for message in stored] == sorted(message.time_ns for message in stored)
    skeletons = [message for message in stored if "/skeleton/" in message.key]
    assert len(skeletons) >= FRAMES - 5
    for message in skeletons:
        packet = decode_skeleton(message.payload)
        assert packet.capture_ns == message.time_ns
        assert message.key.endswith(f"/{layer_of(packet.sequence)}")


def whole_messages(stored: list[StoredMessage]) -> list[bytes]:
    """What the bulk chunks hold."""
    assembler = ChunkAssembler()
    chunks = [decode_chunk(message.payload) for message in stored if "/bulk/" in message.key]
    return [whole for chunk in chunks if (whole := assembler.push(chunk)) is not None]


def test_the_same_recording_gives_the_same_file(recording, session, tmp_path):
    encoded(recording, tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == session.read_bytes()


def test_residual_maps_as_video_are_in_step_with_their_skeletons_and_show_the_person(video_session, tmp_path):
    stored = list(SessionReader(video_session, "v1").messages())
    assert [message.time_ns for message in stored] == sorted(message.time_ns for message in stored)
    groups = [whole for whole in whole_messages(stored) if is_residual(whole)]
    assert [(decode_residual_header(group).kind, frame_count(group)) for group in groups] == [("video", 8)] * 3
    player, apart_ns = SessionPlayer(ReceiverSettings().repository, 0, ("live", "points")), []
    for message in stored:
        for shown in player.take(message):
            maps = player._animation.live._maps
            if isinstance(shown, LinkPoints) and maps is not None:
                apart_ns.append(player._shown_ns - maps.header.capture_ns)
    assert len(apart_ns) == 3 * 8
    assert set(apart_ns) == {0}
    points, said = ReceiverSettings(view=ViewSettings(headless=True, mode="points")), []
    assert decode(points, DecodeOptions(video_session, tmp_path / "png"), said.append) == 0
    picture = cv2.imread(str(sorted((tmp_path / "png").iterdir())[-1]))[..., ::-1]
    assert psnr_db(np.ascontiguousarray(picture), FRAMES) > 22


def test_maps_as_video_without_pyav_are_a_clear_error_at_both_ends(recording, video_session, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(SystemExit, match=r"pip install '\.\[video\]'"):
        run_encode([str(recording), str(tmp_path / "none.mcap"), "--residual-video", "8"])
    assert not (tmp_path / "none.mcap").exists()
    points, said = ReceiverSettings(view=ViewSettings(headless=True, mode="points")), []
    assert decode(points, DecodeOptions(video_session, tmp_path / "png"), said.append) == 0
    assert "messages could not be read, the last one: residual maps as video need the video extra" in said[-1]


def test_bandwidth_bounds_the_file_and_the_summary_counts_it(recording, tmp_path):
    said = encoded(recording, tmp_path / "thin.mcap", mbit=0.4)
    size = (tmp_path / "thin.mcap").stat().st_size
    seconds = (FRAMES - 1) / RATE_HZ
    assert size < 1.25 * 0.4e6 / 8 * seconds  # and MCAP's own 40 bytes a message
    figures = {line[:18].strip(): line[18:].split() for line in said[2:]}
    raw_bytes = FRAMES * 4 * 320 * 240 * 5
    assert figures["raw images"] == [f"{raw_bytes / seconds:,.0f}", "1"]
    assert figures["the file"] == [f"{size / seconds:,.0f}", f"{raw_bytes / size:,.0f}"]
    skeletons, poses = (int(figures[name][0].replace(",", "")) for name in ("skeletons", "candidate poses"))
    assert 7000 < skeletons < 8500
    assert 0 < poses < 0.4e6 / 8


def test_a_decoded_video_shows_the_person(session, tmp_path):
    code, said = decoded(session, tmp_path / "out.mp4")
    assert code == 0
    video = cv2.VideoCapture(str(tmp_path / "out.mp4"))
    pictures = []
    while (read := video.read())[0]:
        pictures.append(read[1][..., ::-1])
    assert len(pictures) == FRAMES
    assert f"{FRAMES} pictures" in said[0]
    assert video.get(cv2.CAP_PROP_FPS) == RATE_HZ
    assert psnr_db(np.ascontiguousarray(pictures[-1]), FRAMES) > 24  # the video's own losses included


def test_a_live_recording_is_decoded_at_the_rate_it_was_captured_at(session, tmp_path):
    log = SessionLog(tmp_path / "live.mcap", "studio", 0)  # which the receiver does not know when it begins
    for message in SessionReader(session, "v1").messages():
        payload = message.payload
        if "/skeleton/" in message.key:  # half as fast
            packet = decode_skeleton(payload)
            payload = encode_skeleton(replace(packet, capture_ns=2 * packet.capture_ns))
        log.add(message.key, 2 * message.time_ns, payload)
    log.close()
    assert captured_rate_hz(tmp_path / "live.mcap", 0) == pytest.approx(RATE_HZ / 2, rel=0.01)
    assert decoded(tmp_path / "live.mcap", tmp_path / "out.mp4")[0] == 0
    video = cv2.VideoCapture(str(tmp_path / "out.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(RATE_HZ / 2, rel=0.01)
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == pytest.approx(FRAMES, abs=2)


def interrupted(work: Callable[..., Iterator[T]], after: int) -> Callable[..., Iterator[T]]:
    """``work`` in the midst of which somebody presses Ctrl-C."""

    def stopped(*arguments: object) -> Iterator[T]:
        for number, made in enumerate(work(*arguments)):
            if number == after:
                signal.raise_signal(signal.SIGINT)
            yield made

    return stopped


def test_ctrl_c_keeps_what_was_encoded_and_decoded_by_then(recording, session, tmp_path, monkeypatch, request):
    monkeypatch.setattr("sender.encode.frame_sets", interrupted(frame_sets, 12))
    monkeypatch.setattr("receiver.decode.display_ticks", interrupted(display_ticks, 7))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    said: list[str] = []
    assert encode(SenderSettings(), EncodeOptions(recording, tmp_path / "s.mcap", 4.0), said.append) == 130
    assert said[0] == "stopped; what was encoded by then is kept"
    assert len([m for m in SessionReader(tmp_path / "s.mcap", "v1").messages() if "/skeleton/" in m.key]) >= 5
    code, said = decoded(session, tmp_path / "out.mp4")
    assert code == 130
    assert said[0] == "stopped; what was decoded by then is kept"
    assert cv2.VideoCapture(str(tmp_path / "out.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 7
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out.mp4", "s.mcap"]


def test_decoded_pictures_show_the_person_in_the_posture_of_their_frame(session, tmp_path):
    assert decoded(session, tmp_path / "out")[0] == 0
    files = sorted((tmp_path / "out").iterdir())
    assert [file.name for file in files] == [f"{tick:06d}.png" for tick in range(FRAMES)]
    picture = cv2.imread(str(files[-1]))[..., ::-1]
    assert psnr_db(np.ascontiguousarray(picture), FRAMES) > 25


def test_skeletons_without_meshes_are_drawn_as_bones(recording, tmp_path):
    settings = SenderSettings(poses=CandidateSettings(enabled=False), residuals=ResidualStreamSettings("off"))
    encoded(recording, tmp_path / "bones.mcap", settings=settings)
    code, said = decoded(tmp_path / "bones.mcap", tmp_path / "out", rate_hz=2.0)
    assert code == 0
    assert "3 pictures, 3 of them of bones alone" in said[0]
    drawn = (cv2.imread(str(tmp_path / "out" / "000002.png")) < 200).any(axis=2)
    rows, columns = np.nonzero(drawn)
    assert 300 < drawn.sum() < 5000
    assert 250 < np.ptp(rows) < 400  # a standing person, 60 % of the picture's height
    assert 200 < columns.min() < columns.max() < 440


def psnr_db(picture: np.ndarray, frame: int) -> float:
    """Against the true performer, who is the same size and place to a pixel or so."""
    time_s = frame / RATE_HZ
    pelvis = performer().named_joints(1 / RATE_HZ)[0]
    camera = camera_before(pelvis, 640, 480, 0.0)
    mesh = performer().mesh
    surface = mesh.vertex_colours if mesh.uv is None or mesh.texture is None else (mesh.uv, mesh.texture)
    truth = render(performer().surface(time_s), mesh.faces, surface, camera)
    depth = np.where((picture < 250).any(axis=2), np.float32(1), np.float32(0))
    return compare([truth], [(picture, depth)]).psnr_db


def test_points_are_decoded_as_pictures_and_clouds(session, tmp_path):
    points = ReceiverSettings(view=ViewSettings(headless=True, mode="points"))
    said: list[str] = []
    assert decode(points, DecodeOptions(session, tmp_path / "png"), said.append) == 0
    picture = cv2.imread(str(sorted((tmp_path / "png").iterdir())[-1]))[..., ::-1]
    assert psnr_db(np.ascontiguousarray(picture), FRAMES) > 22  # splats stand out by 12 mm
    assert decode(points, DecodeOptions(session, tmp_path / "ply", kind="ply", rate_hz=5.0), said.append) == 0
    cloud = sorted((tmp_path / "ply").iterdir())[-1].read_bytes()
    head, _, body = cloud.partition(b"end_header\n")
    rows = np.frombuffer(body, np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    assert f"element vertex {len(rows)}\n".encode() in head
    assert len(rows) > 3000
    surface = performer().surface(FRAMES / RATE_HZ)
    distances = np.linalg.norm(rows["xyz"][::41, None] - surface[None], axis=2).min(axis=1)
    assert np.median(distances) < 0.015
    with pytest.raises(DecodeError, match="written as ply"):
        decode(points, DecodeOptions(session, tmp_path / "glb", kind="glb"), said.append)


@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_decoded_persons_are_files_that_export_would_write(session, tmp_path, kind):
    code, _ = decoded(session, tmp_path / "out", kind=kind, rate_hz=5.0)
    assert code == 0
    files = sorted((tmp_path / "out").iterdir())
    assert 4 <= len(files) <= 6
    assert all(file.suffix == f".{kind}" for file in files)
    begin = {"ply": b"ply\nformat binary_little_endian 1.0", "glb": b"glTF\x02\0\0\0"}[kind]
    assert all(file.read_bytes().startswith(begin) for file in files)


def test_a_damaged_tail_still_plays_up_to_the_damage(session, tmp_path, capsys):
    whole = session.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    assert run_decode([str(tmp_path / "cut.mcap"), str(tmp_path / "out")]) == DAMAGED
    assert 5 < len(list((tmp_path / "out").iterdir())) < FRAMES
    assert "the session is damaged, and was played up to there: it ends" in capsys.readouterr().out


def test_what_cannot_be_played_is_said_and_leaves_no_file(session, tmp_path):
    first = next(SessionReader(session, "v1").messages())
    with SessionWriter(tmp_path / "junk.mcap", "v1", {"person": "0"}) as writer:
        writer.add("v1/studio/0/skeleton", 0, b"\x12" + bytes(249))
        writer.add(first.key, 1, first.payload)
        writer.add("v1/studio/0/bulk/session", 2, b"junk" * 20)
        writer.add("v1/studio/0/of-the-future", 3, b"?")
        writer.finish()
    with pytest.raises(DecodeError, match="its messages cannot be read: chunk: version byte"):
        decoded(tmp_path / "junk.mcap", tmp_path / "out.mp4")
    with SessionWriter(tmp_path / "nobody.mcap", "v1", {}) as writer:
        writer.finish()
    with pytest.raises(DecodeError, match="does not say which person"):
        decoded(tmp_path / "nobody.mcap", tmp_path / "out.mp4")
    assert {path.suffix for path in tmp_path.iterdir()} == {".mcap"}


def test_a_recording_without_a_person_is_an_error(recording, tmp_path):
    empty = write_frames(tmp_path / "empty", 2)
    for file in empty.glob("*/depth/*.png"):
        cv2.imwrite(str(file), np.zeros((240, 320), np.uint16))
    with pytest.raises(EncodeError, match="nobody was found"):
        encoded(empty, tmp_path / "out.mcap")
    assert not list(tmp_path.glob("out*"))


def test_the_command_lines_say_what_is_wrong(recording, session, tmp_path, capsys):
    for run, arguments, code, complaint in (
        (run_encode, ["nowhere", str(tmp_path / "a.mcap")], None, "nowhere: no recording here"),
        (run_encode, [str(recording), str(tmp_path / "a.zip")], 2, "does not end in .mcap"),
        (run_encode, [str(recording), str(tmp_path / "a.mcap"), "--mbit", "0"], 2, "'0' is not a bandwidth"),
        (run_encode, [str(recording), str(tmp_path / "b" / "a.mcap")], None, "cannot write"),
        (run_decode, [str(session)], 2, "name a file or folder to write, or --page"),
        (run_decode, [str(session), str(tmp_path), "--size", "101x100"], 2, "even"),
        (run_decode, [str(session), str(recording)], None, "not empty"),
        (run_decode, [str(recording / "recording.json"), "out.mp4"], None, "no MCAP file"),
    ):
        with pytest.raises(SystemExit) as ended:
            run(arguments)
        said = capsys.readouterr().err if code else str(ended.value.code)
        assert complaint in said
        assert code is None or ended.value.code == code


async def test_a_session_plays_in_the_page(session):
    port = free_port()
    settings = ReceiverSettings(http=HttpSettings(port=port), view=ViewSettings(mode="points"))
    page = SessionPage(settings, session, once=True)
    playing = asyncio.create_task(page.run(Daemon("test", None)))
    sequences = []
    async with asyncio.timeout(30):
        while not sequences:
            await asyncio.sleep(0.05)
            if playing.done():
                await playing
            async with aclosing(follow(f"http://127.0.0.1:{port}/")) as views:
                async for view in views:
                    if view.person is not None:
                        sequences.append(view.person.frame.sequence)
                    if sequences and sequences[-1] >= FRAMES - 10:
                        assert page._viewer.page_count == 1
                        assert not page._viewer.wants_points  # who follows shows meshes, and says so
                        break
        assert sequences == sorted(sequences)
        await playing
