"""Session files: what goes in comes out, and whatever else is in a file is a clear error."""

from __future__ import annotations

import contextlib
import random
import sys
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from common.runtime.session_recording import (
    CHUNK_BYTES,
    RecordingError,
    SessionReader,
    SessionWriter,
    StoredMessage,
)

ABOUT = {"site": "studio", "person": "0"}


def messages(count: int = 300, size: int = 1000) -> list[StoredMessage]:
    made = random.Random(1)
    return [StoredMessage(f"v1/studio/0/{'ab'[i % 2]}", i * 1_000_000, made.randbytes(size)) for i in range(count)]


def write(file: Path, stored: list[StoredMessage]) -> bytes:
    with SessionWriter(file, "v1", ABOUT) as writer:
        for message in stored:
            writer.add(message.key, message.time_ns, message.payload)
        assert writer.finish() == file.stat().st_size
    return file.read_bytes()


def read(file: Path) -> tuple[list[StoredMessage], str | None]:
    reader = SessionReader(file, "v1")
    return list(reader.messages()), reader.damage


def test_messages_come_back_as_they_were_with_their_keys_and_times(tmp_path):
    write(tmp_path / "s.mcap", messages())
    reader = SessionReader(tmp_path / "s.mcap", "v1")
    assert reader.about == {"schema": "v1", **ABOUT}
    assert list(reader.messages()) == messages()
    assert reader.damage is None
    assert reader.share_read > 0.9
    assert [path.name for path in tmp_path.iterdir()] == ["s.mcap"]


def test_a_session_without_messages_is_one(tmp_path):
    write(tmp_path / "s.mcap", [])
    assert read(tmp_path / "s.mcap") == ([], None)


def test_a_file_cut_anywhere_plays_up_to_the_cut(tmp_path):
    whole, stored = write(tmp_path / "s.mcap", messages()), messages()
    cut = tmp_path / "cut.mcap"
    lengths = []
    for size in [*range(0, 300, 7), *range(300, len(whole), len(whole) // 40), len(whole) - 1]:
        cut.write_bytes(whole[:size])
        try:
            found, damage = read(cut)
        except RecordingError:
            assert size < 300
            continue
        assert found == stored[: len(found)]
        assert damage is not None or found == stored
        assert (len(stored) - len(found)) * 1000 <= max(len(whole) - size, 0) + CHUNK_BYTES + 2000
        lengths.append(len(found))
    assert lengths == sorted(lengths)
    assert lengths[-1] == len(stored)


def test_a_changed_byte_is_noticed_and_what_comes_before_its_chunk_is_played(tmp_path):
    whole, stored = write(tmp_path / "s.mcap", messages()), messages()
    bad = tmp_path / "bad.mcap"
    at = whole.index(stored[200].payload) + 500
    bad.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    found, damage = read(bad)
    assert damage is not None
    assert "checksum" in damage
    assert found == stored[: len(found)]
    assert 60 <= len(found) <= 200


def test_no_bytes_do_more_than_end_the_reading(tmp_path):
    whole = bytearray(write(tmp_path / "s.mcap", messages(40, 50)))
    chance = random.Random(2)
    bad = tmp_path / "bad.mcap"
    for _ in range(400):
        data = bytearray(whole)
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        bad.write_bytes(data)
        with contextlib.suppress(RecordingError):
            assert len(read(bad)[0]) <= 40


@pytest.mark.parametrize(("data", "complaint"), [(b"", "empty"), (b"PK\3\4" * 20, "no MCAP"), (b"\x89M", "middle of")])
def test_what_is_no_mcap_file_is_refused(tmp_path, data, complaint):
    (tmp_path / "x.mcap").write_bytes(data)
    with pytest.raises(RecordingError, match=complaint):
        SessionReader(tmp_path / "x.mcap", "v1")


def test_others_mcap_files_are_refused(tmp_path):
    with (tmp_path / "x.mcap").open("wb") as out:
        writer = Writer(out)
        writer.start(profile="ros2")
        writer.finish()
    with pytest.raises(RecordingError, match=r"not a telepose session.*ros2"):
        SessionReader(tmp_path / "x.mcap", "v1")


def test_another_schema_is_refused_by_name(tmp_path):
    write(tmp_path / "s.mcap", messages(3))
    with pytest.raises(RecordingError, match="of schema v1, this telepose reads v2"):
        SessionReader(tmp_path / "s.mcap", "v2")


def test_a_chunk_that_could_unpack_to_anything_is_not_unpacked(tmp_path):
    with (tmp_path / "x.mcap").open("wb") as out:
        writer = Writer(out, chunk_size=1000, compression=CompressionType.ZSTD)
        writer.start(profile="telepose")
        writer.add_metadata("telepose", {"schema": "v1"})
        channel = writer.register_channel("k", "telepose", 0)
        writer.add_message(channel, 0, bytes(50 << 20), 0)
        writer.finish()
    found, damage = read(tmp_path / "x.mcap")
    assert found == []
    assert damage is not None
    assert "compressed by zstd" in damage


def test_places_that_cannot_be_used_are_named(tmp_path):
    with pytest.raises(RecordingError, match=r"cannot read .*nowhere"):
        SessionReader(tmp_path / "nowhere.mcap", "v1")
    with pytest.raises(RecordingError, match=r"cannot write .*nowhere"):
        SessionWriter(tmp_path / "nowhere" / "s.mcap", "v1", ABOUT)


def test_an_unfinished_session_leaves_nothing_behind(tmp_path):
    (tmp_path / "s.mcap").write_bytes(b"older")
    with SessionWriter(tmp_path / "s.mcap", "v1", ABOUT) as writer:
        writer.add("k", 0, b"x")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("s.mcap", b"older")]


def test_without_the_package_it_says_which_extra_is_missing(tmp_path, monkeypatch):
    write(tmp_path / "s.mcap", messages(1))
    for module in ("mcap.writer", "mcap.stream_reader"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(RecordingError, match=r"recording extra: .*telepose\[recording\]"):
        SessionWriter(tmp_path / "t.mcap", "v1", ABOUT)
    with pytest.raises(RecordingError, match=r"recording extra: .*telepose\[recording\]"):
        SessionReader(tmp_path / "s.mcap", "v1")
