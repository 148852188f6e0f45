"""Opening, reading and writing MCAP logs. All that can be wrong with a file becomes one LogReadError."""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import IO, TypeVar

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk, get_chunk_data_stream
from mcap.summary import Summary

from prim.errors import LogReadError
from prim.log.source import Message, Topic

MAGIC = b"\x89MCAP0\r\n"

FOOTER_BYTES = 1 + 8 + 8 + 8 + 4 + len(MAGIC)
RECORD_LIMIT = 1 << 30
"""No record of a readable log is larger (bytes); a length beyond it is damage."""

_OTHER_FORMATS = (
    (b"#ROSBAG", "a ROS 1 bag", "convert it with: rosbags-convert --dst-storage mcap"),
    (b"SQLite format 3", "a ROS 2 bag in SQLite", "convert it with: rosbags-convert --dst-storage mcap"),
    (b"\x89PNG", "a PNG image", "give an .mcap log"),
    (b"RRF2", "a rerun recording", "open it with: rerun FILE"),
)
_RECORD = struct.Struct("<BQ")
"""What every record begins with: opcode and length."""
_MESSAGE = struct.Struct("<HIQQ")
"""What a message record begins with: channel, sequence, log time, publish time."""

_SALVAGE = "read what is left of it with --recover"

Decoded = TypeVar("Decoded")


@dataclass
class _Contents:
    """What a log holds besides its messages, as its summary or a pass over it tells."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    metadata: dict[str, Mapping[str, str]] = field(default_factory=dict)


class LogReader:
    """A log that is open for reading, message by message, in bounded memory.

    An intact log is read by its index, in the order of log times. With ``recover`` a damaged one is read chunk by
    chunk, by its index where that is whole and else in file order, and what could not be read is told by
    :attr:`lost`. Raises LogReadError.
    """

    def __init__(self, path: Path, recover: bool = False) -> None:
        self.path = resolve_log(path)
        self.recover = recover
        self.lost: list[str] = []
        self._undecodable: set[tuple[str, int]] = set()
        self._file: IO[bytes] = _open(self.path)
        self._index = SeekingReader(self._file, validate_crcs=True, record_size_limit=RECORD_LIMIT)
        try:
            self._summary = self._read_summary_or_none()
            self._contents = self._read_contents()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> LogReader:
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    @property
    def topics(self) -> dict[str, Topic]:
        """The log's topics by name."""
        topics: dict[str, Topic] = {}
        for channel in self._contents.channels.values():
            schema = self._contents.schemas.get(channel.schema_id)
            count = self._contents.counts[channel.id]
            if channel.topic in topics:
                count += topics[channel.topic].messages
            name = schema.name if schema else ""
            topics[channel.topic] = Topic(channel.topic, _ros2_name(name), channel.message_encoding, count)
        return topics

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The log's metadata records by name."""
        return self._contents.metadata

    def attachment(self, name: str) -> bytes | None:
        """An attachment's bytes, None where the log has none of that name. Raises LogReadError."""
        with _explained(self.path):
            found = self._find_attachment(name)
            if found is None or _crc_fits(found, self._file):
                return found.data if found else None
        what = f"the CRC of its attachment {name} does not fit"
        if not self.recover:
            raise LogReadError(self.path, f"damaged: {what}", _SALVAGE)
        self.lost.append(what)
        return None

    def _find_attachment(self, name: str) -> Attachment | None:
        """The attachment, with the file standing where its record ends."""
        if self._summary is None:
            found = (r for r in self._linear_records([]) if isinstance(r, Attachment) and r.name == name)
            return next(found, None)
        for place in self._summary.attachment_indexes:
            if place.name == name:
                return _record_at(self._file, place.offset, Attachment)
        return None

    @property
    def messages_lost(self) -> int | None:
        """How many messages of a damaged log could not be read; None where nothing says how many there were."""
        if not self.lost:
            return 0
        if self._summary is None or self._summary.statistics is None:
            return None
        unread = self._summary.statistics.message_count - self._contents.counts.total()
        return unread + len(self._undecodable)

    def of_type(self, *types: str) -> list[Topic]:
        """The topics that carry messages of any of these types and are not empty, by name."""
        fitting = (topic for topic in self.topics.values() if topic.type in types and topic.messages)
        return sorted(fitting, key=lambda topic: topic.name)

    def messages(self, *topics: str) -> Iterator[Message]:
        """The messages of these topics. Raises LogReadError where the log is damaged or short of messages."""
        if self.recover or self._summary is None or not self._summary.chunk_indexes:
            yield from self._linear_messages(topics)
            return
        delivered: Counter[str] = Counter()
        with _explained(self.path):
            for message in self._indexed_messages(self._summary, topics):
                delivered[message.topic] += 1
                yield message
        for name in topics:
            if name in self.topics and delivered[name] != self.topics[name].messages:
                what = f"{name} has {delivered[name]} messages where the summary counts {self.topics[name].messages}"
                raise LogReadError(self.path, f"damaged: {what}", _SALVAGE)

    def _indexed_messages(self, summary: Summary, topics: tuple[str, ...]) -> Iterator[Message]:
        """Messages in the order of log times, by the index of chunks."""
        chunks = sorted(summary.chunk_indexes, key=lambda index: index.message_start_time)
        if any(a.message_end_time > b.message_start_time for a, b in pairwise(chunks)):
            for _, channel, message in self._index.iter_messages(topics):  # chunks that overlap must be merged
                yield Message(channel.topic, message.log_time, message.data)
            return
        wanted = {number: channel.topic for number, channel in summary.channels.items() if channel.topic in topics}
        for index in chunks:
            if index.message_index_offsets and wanted.keys().isdisjoint(index.message_index_offsets):
                continue
            self._file.seek(index.chunk_start_offset + 1 + 8)
            chunk = Chunk.read(ReadDataStream(self._file))
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
            yield from sorted(_chunk_messages(stream.read(length), wanted), key=lambda message: message.log_time)

    def decoded(self, topic: Topic, decode: Callable[[bytes], Decoded]) -> Iterator[tuple[int, Decoded]]:
        """Log time (ns) and decoded message of one topic. Raises LogReadError on messages that do not decode."""
        for _, log_time, decoded in self.numbered(topic, decode):
            yield log_time, decoded

    def numbered(
        self, topic: Topic, decode: Callable[[bytes], Decoded], wanted: Container[int] | None = None
    ) -> Iterator[tuple[int, int, Decoded]]:
        """As :meth:`decoded`, with the number of each message on its topic; of those, only the ``wanted`` ones.

        All of the topic is read even so: only its end shows whether messages are missing.
        """
        if topic.encoding != "cdr":
            raise LogReadError(
                self.path,
                f"{topic.name} is encoded as {topic.encoding!r}, and only 'cdr' (ROS 2) can be read",
                "convert the log with: rosbags-convert --dst-storage mcap",
            )
        for index, message in enumerate(self.messages(topic.name)):
            if wanted is not None and index not in wanted:
                continue
            try:
                decoded = decode(message.data)
            except ValueError as error:
                self._reject(topic, index, error)
                continue
            yield index, message.log_time, decoded

    def _reject(self, topic: Topic, index: int, error: ValueError) -> None:
        """Tells of a message that cannot be decoded: with ``recover`` a loss, else a LogReadError."""
        if not self.recover:
            what = f"message {index} of {topic.name} cannot be decoded: {error}"
            raise LogReadError(self.path, what, "pass over such messages with --recover")
        if not any(name == topic.name for name, _ in self._undecodable):
            self.lost.append(f"messages of {topic.name} that cannot be decoded, the first one {index}: {error}")
        self._undecodable.add((topic.name, index))

    def _read_summary(self) -> Summary | None:
        """The log's summary, its CRC checked; None where a complete log has none. Raises LogReadError."""
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(max(size - FOOTER_BYTES, 0))
        end = self._file.read()
        if len(end) < FOOTER_BYTES or not end.endswith(MAGIC) or end[0] != Opcode.FOOTER:
            raise LogReadError(self.path, f"truncated: its end is missing ({size} bytes)", _SALVAGE)
        start, _, crc = struct.unpack_from("<QQI", end, 9)
        if start == 0:
            return None
        if start > size - FOOTER_BYTES:
            raise LogReadError(self.path, "damaged: its summary lies beyond its end", _SALVAGE)
        self._file.seek(start)
        summary = self._file.read(size - FOOTER_BYTES - start) + end[:25]
        if crc and zlib.crc32(summary) != crc:
            raise LogReadError(self.path, "damaged: the CRC of its summary does not fit", _SALVAGE)
        with _explained(self.path):
            return self._index.get_summary()

    def _read_summary_or_none(self) -> Summary | None:
        """A summary that says where everything is; None where there is none, or none that is whole to recover by."""
        try:
            summary = self._read_summary()
        except LogReadError:
            if not self.recover:
                raise
            return None
        complete = summary is not None and summary.statistics is not None and summary.channels
        return summary if complete else None

    def _read_contents(self) -> _Contents:
        if self.recover or self._summary is None:
            return self._scan_contents()
        with _explained(self.path):
            contents = _Contents(self._summary.channels, self._summary.schemas)
            if self._summary.statistics is not None:
                contents.counts.update(self._summary.statistics.channel_message_counts)
            contents.metadata.update(self._indexed_metadata(self._summary))
        return contents

    def _indexed_metadata(self, summary: Summary) -> dict[str, Mapping[str, str]]:
        records = (_record_at(self._file, index.offset, Metadata) for index in summary.metadata_indexes)
        return {record.name: record.metadata for record in records}

    def _scan_contents(self) -> _Contents:
        contents = _Contents()
        if self._summary is not None:
            contents.channels.update(self._summary.channels)
            contents.schemas.update(self._summary.schemas)
            with suppress(LogReadError), _explained(self.path):
                contents.metadata.update(self._indexed_metadata(self._summary))
        for record in self._records(self.lost):
            if isinstance(record, Channel):  # the first one counts: it lies in a chunk, whose CRC was checked
                contents.channels.setdefault(record.id, record)
            elif isinstance(record, Schema):
                contents.schemas.setdefault(record.id, record)
            elif isinstance(record, McapMessage):
                contents.counts[record.channel_id] += 1
            elif isinstance(record, Metadata):
                contents.metadata[record.name] = record.metadata
        expected = self._summary.statistics if self._summary else None
        if expected and not self.lost and contents.counts.total() < expected.message_count:
            self.lost.append(f"{expected.message_count - contents.counts.total()} messages that the summary counts")
        return contents

    def _linear_messages(self, topics: tuple[str, ...]) -> Iterator[Message]:
        names = {number: channel.topic for number, channel in self._contents.channels.items()}
        for record in self._records([]):
            if isinstance(record, McapMessage) and names.get(record.channel_id) in topics:
                yield Message(names[record.channel_id], record.log_time, record.data)

    def _records(self, lost: list[str]) -> Iterator[McapRecord]:
        """All records, by the index of chunks where there is one, else in file order."""
        if self._summary is None or not self._summary.chunk_indexes:
            yield from self._linear_records(lost)
            return
        for index in sorted(self._summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
            try:
                with _explained(self.path):
                    self._file.seek(index.chunk_start_offset + 1 + 8)
                    chunk = Chunk.read(ReadDataStream(self._file))
            except LogReadError as error:
                lost.append(f"a chunk at byte {index.chunk_start_offset}: {error.what}")
                continue
            yield from self._chunk_records(chunk, lost)

    def _linear_records(self, lost: list[str]) -> Iterator[McapRecord]:
        """All records in file order; with ``recover`` damaged chunks are passed over and noted in ``lost``."""
        self._file.seek(0)
        stream = StreamReader(self._file, emit_chunks=True, record_size_limit=RECORD_LIMIT).records
        while True:
            try:
                with _explained(self.path):
                    record = next(stream, None)
            except LogReadError as error:
                if not self.recover:
                    raise
                lost.append(f"all beyond byte {self._file.tell()}: {error.what}")
                return
            if record is None:
                return
            if isinstance(record, Chunk):
                yield from self._chunk_records(record, lost)
            else:
                yield record

    def _chunk_records(self, chunk: Chunk, lost: list[str]) -> list[McapRecord]:
        try:
            with _explained(self.path):
                return breakup_chunk(chunk, validate_crc=True)
        except LogReadError as error:
            if not self.recover:
                raise
            seconds = (chunk.message_end_time - chunk.message_start_time) / 1e9
            lost.append(f"a chunk of {seconds:.2f} s that ends at byte {self._file.tell()}: {error.what}")
            return []


def resolve_log(path: Path) -> Path:
    """The log's file: ``path`` itself, or the one .mcap file in it if it is a folder (a ROS 2 bag).

    Raises LogReadError.
    """
    if not path.is_dir():
        return path
    logs = sorted(path.glob("*.mcap"))
    if len(logs) == 1:
        return logs[0]
    if logs:
        names = ", ".join(log.name for log in logs)
        raise LogReadError(path, f"a folder with {len(logs)} logs ({names})", "give one of them")
    raise LogReadError(path, "a folder without an .mcap log in it", "give an .mcap file or a ROS 2 bag's folder")


def _ros2_name(name: str) -> str:
    """ROS 1 and ROS 2 names of a type made one: package/Type becomes package/msg/Type."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


def _open(path: Path) -> IO[bytes]:
    """Opens a file that begins like an MCAP log. Raises LogReadError."""
    try:
        stream = path.open("rb")
    except OSError as error:
        raise LogReadError(path, f"cannot open: {error.strerror}") from error
    start = stream.read(16)
    if start.startswith(MAGIC):
        stream.seek(0)
        return stream
    stream.close()
    if not start:
        raise LogReadError(path, "an empty file (0 bytes)", "give an .mcap log")
    for magic, what, hint in _OTHER_FORMATS:
        if start.startswith(magic):
            raise LogReadError(path, f"{what}, not an MCAP log", hint)
    raise LogReadError(path, "not an MCAP log: it begins with other bytes", "give an .mcap log")


Record = TypeVar("Record", Metadata, Attachment)


def _record_at(stream: IO[bytes], offset: int, kind: type[Record]) -> Record:
    stream.seek(offset)
    records = StreamReader(stream, skip_magic=True, record_size_limit=RECORD_LIMIT).records
    record = next(iter(records))
    if not isinstance(record, kind):
        raise McapError(f"no {kind.__name__} at byte {offset}")
    return record


def _chunk_messages(data: bytes, wanted: Mapping[int, str]) -> Iterator[Message]:
    """The messages of the wanted channels (by number) among a chunk's records."""
    at, end = 0, len(data)
    while at < end:
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if at + length > end:
            raise EndOfFile
        if opcode == Opcode.MESSAGE:
            channel, _, log_time, _ = _MESSAGE.unpack_from(data, at)
            if channel in wanted:
                yield Message(wanted[channel], log_time, data[at + _MESSAGE.size : at + length])
        at += length


def _crc_fits(attachment: Attachment, stream: IO[bytes]) -> bool:
    """Whether an attachment is as it was written; ``stream`` stands behind its record, which ends in its CRC."""
    stream.seek(-4, os.SEEK_CUR)
    stored = stream.read(4)
    builder = RecordBuilder()
    attachment.write(builder)
    return stored in (b"\0\0\0\0", builder.end()[-4:])  # type: ignore[no-untyped-call]


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turns everything that mcap and its codecs raise on damaged files into a LogReadError."""
    try:
        yield
    except (LogReadError, AttributeError, NameError):  # the latter two would be our own mistakes
        raise
    except CRCValidationError as error:
        raise LogReadError(
            path, f"damaged: the CRC of a {type(error.record).__name__} does not fit", _SALVAGE
        ) from error
    except (EndOfFile, RecordLengthLimitExceeded) as error:
        raise LogReadError(path, "truncated or damaged: a record runs past the end", _SALVAGE) from error
    except InvalidMagic as error:
        raise LogReadError(path, "damaged: it does not end as an MCAP log does", _SALVAGE) from error
    except McapError as error:
        raise LogReadError(path, f"cannot be read: {error}") from error
    except OSError as error:
        raise LogReadError(path, f"cannot be read: {error.strerror or error}", _SALVAGE) from error
    except Exception as error:  # struct.error, KeyError, ZstdError, UnicodeDecodeError, ...: the file is damaged
        what = f"damaged: its records do not fit together ({type(error).__name__}: {error})"
        raise LogReadError(path, what, _SALVAGE) from error
