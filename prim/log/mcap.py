"""Reading MCAP logs (https://mcap.dev/spec): by their index where they are intact, else record by record."""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from typing import IO, TypeVar

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary

from prim.arrays import Stamps
from prim.errors import LogReadError
from prim.log.decoding.codecs import SCAN_CONTENTS, content_of
from prim.log.log_file import LogFile
from prim.log.reader import LogReader, ros2_name
from prim.log.recovery import RECORD_LIMIT, RECOVER_HINT, RecordReader, read_chunk, translated_errors
from prim.log.source import Message, Topic
from prim.log.time_resets import as_stamps, find_shifts, moved_behind_resets, reset_notes

MAGIC = b"\x89MCAP0\r\n"

FOOTER_BYTES = 1 + 8 + 8 + 8 + 4 + len(MAGIC)
"""A file's end: the footer record (opcode, length, summary start, summary offset start, CRC) and the magic."""

_RECORD = struct.Struct("<BQ")
"""The prefix of every record: opcode and length."""
_MESSAGE = struct.Struct("<HIQQ")
"""The prefix of a message record: channel, sequence, log time, publish time."""
_MESSAGE_INDEX = struct.Struct("<BQHI")
"""The start of an index of messages: opcode, length, channel, and the length of its entries (log time, offset)."""


@dataclass
class _Contents:
    """What a log holds besides its messages, from its summary or from a pass over all records."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    metadata: dict[str, Mapping[str, str]] = field(default_factory=dict)


class McapReader(LogReader):
    """An MCAP log that is open for reading: a :class:`prim.log.source.LogSource`.

    An intact log is read by its index, in the order of log times. With ``recover``, every log is read chunk by chunk,
    by the index of chunks where that is intact and else in file order.

    Args:
        file: The file; it begins with MAGIC, as :func:`prim.log.open_log` checks.
        recover: Pass over damage, and collect it in :attr:`lost`.

    Raises:
        LogReadError: The file cannot be read or is damaged (unless ``recover``).
    """

    _FORMAT = "MCAP"

    def __init__(self, file: LogFile, recover: bool = False) -> None:
        super().__init__(file.path, recover, file)
        self._file: IO[bytes] = file.data.open("rb")
        self._records = RecordReader(self._file, self.path, recover)
        self._index = SeekingReader(self._file, validate_crcs=True, record_size_limit=RECORD_LIMIT)
        try:
            self._summary = self._read_summary_or_none()
            self._contents = self._read_contents()
        except BaseException:
            self._file.close()
            raise
        self.metadata, self.topics = self._contents.metadata, self._read_topics()
        self._shifts = self._find_shifts()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read_topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for channel in self._contents.channels.values():
            schema = self._contents.schemas.get(channel.schema_id)
            count = self._contents.counts[channel.id]
            if channel.topic in topics:
                count += topics[channel.topic].messages
            name = ros2_name(schema.name if schema else "")
            topics[channel.topic] = Topic(channel.topic, name, channel.message_encoding, count, content_of(name))
        return topics

    def attachment(self, name: str) -> bytes | None:
        """See :meth:`prim.log.source.LogSource.attachment`."""
        with translated_errors(self.path):
            found = self._find_attachment(name)
            if found is None or _crc_fits(found, self._file):
                return found.data if found else None
        what = f"the CRC of its attachment {name} does not fit"
        if not self._recover:
            raise LogReadError(self.path, f"damaged: {what}", RECOVER_HINT)
        self.lost.append(what)
        return None

    def _find_attachment(self, name: str) -> Attachment | None:
        """Return the attachment; the file's position is then the end of its record."""
        if self._summary is None:
            found = (r for r in self._records.linear([]) if isinstance(r, Attachment) and r.name == name)
            return next(found, None)
        for index in self._summary.attachment_indexes:
            if index.name == name:
                return _record_at(self._file, index.offset, Attachment)
        return None

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        if not self.lost:
            return 0
        if self._summary is None or self._summary.statistics is None:
            return None
        unread = self._summary.statistics.message_count - self._contents.counts.total()
        return unread + len(self._undecodable)

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`; a log that is recovered is read in file order."""
        if len(self._shifts) > 1:
            yield from moved_behind_resets(self._unindexed_messages(topics), self._shifts)
            return
        if self._recover:
            yield from self._unindexed_messages(topics)
            return
        if self._summary is None or not self._summary.chunk_indexes:
            yield from self._sorted_messages(topics)
            return
        delivered: Counter[str] = Counter()
        with translated_errors(self.path):
            for message in self._indexed_messages(self._summary, topics):
                delivered[message.topic] += 1
                yield message
        for name in topics:
            if name in self.topics and delivered[name] != self.topics[name].messages:
                what = f"{name} has {delivered[name]} messages where the summary counts {self.topics[name].messages}"
                raise LogReadError(self.path, f"damaged: {what}", RECOVER_HINT)

    def log_times(self, topic: str) -> Stamps:
        """See :meth:`prim.log.reader.LogReader.log_times`: by the index where there is one."""
        if self._recover or self._summary is None or not self._summary.chunk_indexes or len(self._shifts) > 1:
            return super().log_times(topic)
        numbers = [number for number, channel in self._contents.channels.items() if channel.topic == topic]
        with translated_errors(self.path):
            times = [part for number in numbers for part in self._written_times(self._summary, number)]
        return np.sort(np.concatenate(times)) if times else np.zeros(0, dtype=np.int64)

    def _indexed_messages(self, summary: Summary, topics: tuple[str, ...]) -> Iterator[Message]:
        """Yield messages in the order of log times, by the index of chunks.

        mcap's own iter_messages makes an object of every record and sorts them in a heap. Without it scans of 500
        beams are decoded twice as fast (python -m bench.speed, the row «reading»), which saves a replay of 10,000
        of them by det a seventh of its CPU time.
        """
        chunks = sorted(summary.chunk_indexes, key=lambda index: index.message_start_time)
        if any(a.message_end_time > b.message_start_time for a, b in pairwise(chunks)):
            for _, channel, message in self._index.iter_messages(topics):  # chunks that overlap must be merged
                yield Message(channel.topic, message.log_time, message.data)
            return
        wanted = {number: channel.topic for number, channel in summary.channels.items() if channel.topic in topics}
        for index in chunks:
            if index.message_index_offsets and wanted.keys().isdisjoint(index.message_index_offsets):
                continue
            stream, length = get_chunk_data_stream(read_chunk(self._file, index), validate_crc=True)
            yield from sorted(_chunk_messages(stream.read(length), wanted), key=lambda message: message.log_time)

    def _find_shifts(self) -> tuple[int, ...]:
        """Find out whether the log's times were set back, and note that."""
        scans = {k for k, c in self._contents.channels.items() if self.topics[c.topic].content in SCAN_CONTENTS}
        if not scans:
            return (0,)
        if self._recover or self._summary is None or not self._summary.chunk_indexes:
            name = self._contents.channels[min(scans)].topic
            times = [message.log_time for message in self._unindexed_messages((name,))]
            shifts = find_shifts(as_stamps(times))
        else:
            with translated_errors(self.path):
                parts = list(self._written_times(self._summary, min(scans)))
                shifts = find_shifts(np.concatenate(parts)) if parts else (0,)
        self.notes = reset_notes(shifts)
        return shifts

    def _written_times(self, summary: Summary, channel: int) -> Iterator[Stamps]:
        """Yield for each chunk when messages of a channel were logged (ns), in the order of writing."""
        for chunk in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
            at = chunk.message_index_offsets.get(channel)
            if at is not None:
                self._file.seek(at)
                opcode, _, _, size = _MESSAGE_INDEX.unpack(self._file.read(_MESSAGE_INDEX.size))
                entries = np.frombuffer(self._file.read(size), "<u8").reshape(-1, 2)
                if opcode != Opcode.MESSAGE_INDEX:
                    raise McapError(f"no index of messages at byte {at}")
                yield entries[np.argsort(entries[:, 1], kind="stable"), 0].astype(np.int64)

    def _sorted_messages(self, topics: tuple[str, ...]) -> Iterator[Message]:
        """Yield messages without an index by log time: those of a log in another order are all read at first."""
        times = (message.log_time for message in self._unindexed_messages(topics))
        if all(earlier <= later for earlier, later in pairwise(times)):
            return self._unindexed_messages(topics)
        return iter(sorted(self._unindexed_messages(topics), key=lambda message: message.log_time))

    def _unindexed_messages(self, topics: tuple[str, ...]) -> Iterator[Message]:
        names = {number: channel.topic for number, channel in self._contents.channels.items()}
        for record in self._all_records([]):
            if isinstance(record, McapMessage) and names.get(record.channel_id) in topics:
                yield Message(names[record.channel_id], record.log_time, record.data)

    def _read_summary(self) -> Summary | None:
        """Read the log's summary and check its CRC; None where a complete log has none. Raises LogReadError."""
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(max(size - FOOTER_BYTES, 0))
        end = self._file.read()
        if len(end) < FOOTER_BYTES or not end.endswith(MAGIC) or end[0] != Opcode.FOOTER:
            raise LogReadError(self.path, f"truncated: its end is missing ({size} bytes)", RECOVER_HINT)
        start, _, crc = struct.unpack_from("<QQI", end, _RECORD.size)
        if start == 0:
            return None
        if start > size - FOOTER_BYTES:
            raise LogReadError(self.path, "damaged: its summary lies beyond its end", RECOVER_HINT)
        self._file.seek(start)
        covered = FOOTER_BYTES - len(MAGIC) - 4  # the CRC covers the footer up to itself
        summary = self._file.read(size - FOOTER_BYTES - start) + end[:covered]
        if crc and zlib.crc32(summary) != crc:
            raise LogReadError(self.path, "damaged: the CRC of its summary does not fit", RECOVER_HINT)
        with translated_errors(self.path):
            return self._index.get_summary()

    def _read_summary_or_none(self) -> Summary | None:
        """Return a summary that indexes the whole log; None where there is none, or only a damaged one to recover."""
        try:
            summary = self._read_summary()
        except LogReadError:
            if not self._recover:
                raise
            return None
        complete = summary is not None and summary.statistics is not None and summary.channels
        return summary if complete else None

    def _read_contents(self) -> _Contents:
        if self._recover or self._summary is None:
            return self._scan_contents()
        with translated_errors(self.path):
            contents = _Contents(self._summary.channels, self._summary.schemas)
            if self._summary.statistics is not None:
                contents.counts.update(self._summary.statistics.channel_message_counts)
            contents.metadata.update(self._indexed_metadata(self._summary))
        return contents

    def _indexed_metadata(self, summary: Summary) -> dict[str, Mapping[str, str]]:
        records = (_record_at(self._file, index.offset, Metadata) for index in summary.metadata_indexes)
        return {record.name: record.metadata for record in records}

    def _scan_contents(self) -> _Contents:
        """Collect the contents from all records, and note in :attr:`lost` what cannot be read."""
        contents = _Contents()
        if self._summary is not None:
            contents.channels.update(self._summary.channels)
            contents.schemas.update(self._summary.schemas)
            with suppress(LogReadError), translated_errors(self.path):
                contents.metadata.update(self._indexed_metadata(self._summary))
        for record in self._all_records(self.lost):
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

    def _all_records(self, lost: list[str]) -> Iterator[McapRecord]:
        """Return all records, by the index of chunks where there is one, else in file order."""
        if self._summary is None or not self._summary.chunk_indexes:
            return self._records.linear(lost)
        return self._records.indexed(self._summary.chunk_indexes, lost)


Record = TypeVar("Record", Metadata, Attachment)


def _record_at(stream: IO[bytes], offset: int, kind: type[Record]) -> Record:
    stream.seek(offset)
    records = StreamReader(stream, skip_magic=True, record_size_limit=RECORD_LIMIT).records
    record = next(iter(records))
    if not isinstance(record, kind):
        raise McapError(f"no {kind.__name__} at byte {offset}")
    return record


def _chunk_messages(data: bytes, wanted: Mapping[int, str]) -> Iterator[Message]:
    """Yield the messages of the wanted channels (by number) among a chunk's uncompressed records."""
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
    """Whether an attachment's CRC holds; ``stream`` is positioned behind its record, which ends in the CRC."""
    stream.seek(-4, os.SEEK_CUR)
    stored = stream.read(4)
    builder = RecordBuilder()
    attachment.write(builder)
    return stored in (b"\0\0\0\0", builder.end()[-4:])  # type: ignore[no-untyped-call]
