"""A session as one MCAP file: the messages of the channels, as they travel, each under its key at its capture time.

So whatever becomes a channel is stored without a word about it here. MCAP (mcap.dev) is the container of ROS 2 and
Foxglove: their tools list, cut and recover such files. Messages are gathered into chunks of at most ``CHUNK_BYTES``
with a checksum each; a file that is cut short or damaged is read up to the chunk it happened in.

Nothing in a file is trusted: it is mapped, not read, and no length in it leads to an allocation beyond the bounds.
The ``mcap`` package is imported when a file is opened, and comes with the ``recording`` extra.
"""

from __future__ import annotations

import contextlib
import importlib
import mmap
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from mcap.records import Chunk
    from mcap.writer import Writer

PROFILE = "telepose"  # of the MCAP header, and the name of the metadata record behind it
ENCODING = "telepose"  # of the messages: the wire formats of common/wire
CHUNK_BYTES = 32 << 10  # an eighth of a second at 2 Mbit/s is what a damaged byte costs
RECORD_MAX_BYTES = 5 << 20
KEYS_MAX = 1024
_SCHEMA = "schema"


class RecordingError(Exception):
    """A session file cannot be written or read; the text says why and, where there is a remedy, which."""


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """``payload`` as it was published under ``key`` at ``time_ns`` (the sender's capture clock)."""

    key: str
    time_ns: int
    payload: bytes


class SessionWriter:
    """Writes ``file`` under a temporary name that it loses when it is whole. Messages come in order of time.

    ``schema``: of the channel table ("v1"). ``about``: words on the session, for whoever plays it.

    Raises:
        RecordingError: the package is missing, or the place cannot be written.
    """

    def __init__(self, file: Path, schema: str, about: Mapping[str, str]) -> None:
        writer = _mcap("mcap.writer")
        self._file = file
        self._unfinished = file.with_name(file.name + ".part")
        try:
            self._out = self._unfinished.open("wb")
        except OSError as error:
            raise RecordingError(f"cannot write {file}: {error.strerror}") from error
        # No compression: payloads are compressed already. No index of messages: players read on from the start.
        self._writer: Writer = writer.Writer(
            self._out,
            chunk_size=CHUNK_BYTES,
            compression=writer.CompressionType.NONE,
            index_types=writer.IndexType.CHUNK | writer.IndexType.METADATA,
        )
        self._channels: dict[str, int] = {}
        self._writer.start(profile=PROFILE, library="telepose")
        self._writer.add_metadata(PROFILE, {_SCHEMA: schema, **about})

    def add(self, key: str, time_ns: int, payload: bytes) -> None:
        """Append a message.

        Raises:
            RecordingError: it cannot be written.
        """
        channel = self._channels.get(key)
        try:
            if channel is None:
                channel = self._channels[key] = self._writer.register_channel(key, ENCODING, schema_id=0)
            self._writer.add_message(channel, time_ns, payload, time_ns)
        except OSError as error:
            raise RecordingError(f"cannot write {self._file}: {error.strerror}") from error

    def finish(self) -> int:
        """The file is whole; its size [bytes].

        Raises:
            RecordingError: it cannot be written.
        """
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._out.close()
            os.replace(self._unfinished, self._file)
            return self._file.stat().st_size
        except OSError as error:
            raise RecordingError(f"cannot write {self._file}: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """What is not finished by now is not kept."""
        with contextlib.suppress(OSError):
            self._out.close()
        with contextlib.suppress(OSError):
            self._unfinished.unlink(missing_ok=True)


class SessionReader:
    """A session file. ``about``: what its writer said of it. ``share_read``: 0..1. ``damage``: why reading stopped
    before the end, None while it has not.

    Raises:
        RecordingError: the package is missing; the file cannot be read, is no MCAP, not ours or of another schema.
    """

    def __init__(self, path: Path, schema: str) -> None:
        self._path = path
        self._mcap = _mcap("mcap.stream_reader"), _mcap("mcap.records")
        self._errors = _mcap("mcap.exceptions")
        self._data = _mapped(path)
        self.damage: str | None = None
        self._records = self._read()
        header, about = next(self._records, None), next(self._records, None)
        records = self._mcap[1]
        if header is None:
            raise RecordingError(f"{path}: not a session: {self.damage}")
        if not isinstance(header, records.Header) or header.profile != PROFILE:
            of = getattr(header, "profile", "") or "none"
            raise RecordingError(f"{path}: an MCAP file, but not a telepose session (its profile: {of})")
        if not isinstance(about, records.Metadata) or about.name != PROFILE:
            raise RecordingError(f"{path}: the beginning is damaged: {self.damage or 'no description of the session'}")
        self.about: dict[str, str] = about.metadata
        if self.about.get(_SCHEMA) != schema:
            its = self.about.get(_SCHEMA, "none")
            raise RecordingError(f"{path}: its messages are of schema {its}, this telepose reads {schema}")

    @property
    def share_read(self) -> float:
        return self._data.tell() / max(len(self._data), 1)

    def messages(self) -> Iterator[StoredMessage]:
        """All messages in the order they were stored, once. Ends at the first damage, which ``damage`` then tells."""
        _, records = self._mcap
        keys: dict[int, str] = {}
        for record in self._records:
            if isinstance(record, records.Channel) and len(keys) < KEYS_MAX:
                keys[record.id] = record.topic
            elif isinstance(record, records.Message):
                if record.channel_id not in keys:
                    self.damage = f"a message of a channel {record.channel_id} that is not declared"
                    return
                yield StoredMessage(keys[record.channel_id], record.log_time, record.data)

    def _read(self) -> Iterator[Any]:
        """All records, chunks opened, up to the end of the messages or to the damage."""
        reader, records = self._mcap
        stream = reader.StreamReader(self._data, emit_chunks=True, record_size_limit=RECORD_MAX_BYTES)
        why = "it ends before its end"
        try:
            for record in stream.records:
                if isinstance(record, records.DataEnd):
                    return
                if isinstance(record, records.Chunk):
                    yield from self._opened(record)
                else:
                    yield record
        except (struct.error, self._errors.EndOfFile):
            why = "it ends in the middle of a record"
        except self._errors.InvalidMagic:
            why = "it is no MCAP file"
        except (ValueError, OverflowError, self._errors.McapError) as error:
            why = str(error)
        self.damage = f"{why} (at byte {self._data.tell()} of {len(self._data)})"

    def _opened(self, chunk: Chunk) -> list[Any]:
        """The records of a chunk that is whole.

        Raises:
            ValueError: it is not.
        """
        if chunk.compression:
            raise ValueError(f"a chunk compressed by {chunk.compression}: recompress the file with none")
        if len(chunk.data) != chunk.uncompressed_size:
            raise ValueError("it is cut off in the middle of a chunk")
        if chunk.uncompressed_crc not in (0, zlib.crc32(chunk.data)):  # 0: its writer did not say
            raise ValueError("a chunk does not match its checksum")
        opened: list[Any] = self._mcap[0].breakup_chunk(chunk)
        return opened


def _mapped(path: Path) -> mmap.mmap:
    """The file's bytes. Reading from a map gives what is there, however much is asked for."""
    try:
        with path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except ValueError as error:  # empty files have no map
        raise RecordingError(f"{path}: it is empty") from error
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}") from error


def _mcap(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        remedy = "python -m pip install 'telepose[recording]', or, in this folder, '.[recording]'"
        raise RecordingError(f"sessions are stored as MCAP, which needs the recording extra: {remedy}") from error
