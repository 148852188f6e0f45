"""Reading MCAP logs (https://mcap.dev/spec): chunk by chunk, each checked against the index and the summary."""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Container, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import IO

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, Channel, Metadata, Schema

from prim.arrays import Stamps
from prim.errors import LogReadError
from prim.log.decoding.codecs import SCAN_CONTENTS, content_of
from prim.log.limits import megabytes, memory_limit, records_limit, unpacked_limit
from prim.log.log_file import LogFile
from prim.log.mcap.records import (
    INDEX_ENTRY_BYTES,
    MESSAGE_BYTES,
    PREFIX_BYTES,
    Contents,
    CutError,
    DamageError,
    Record,
    parse,
    read_body,
    split,
    unpack_chunk,
)
from prim.log.mcap.survey import Block, IndexRecord, Survey, Surveyor
from prim.log.reader import MAX_LOST, RECOVER_HINT, LogReader, ros2_name
from prim.log.source import Message, Topic
from prim.log.time_resets import LATEST, as_stamps, find_shifts, moved_behind_resets, reset_notes

ALL_CHANNELS = range(1 << 16)

NO_CRC = bytes(4)
"""What stands in the place of an attachment's CRC where it has none."""


class McapReader(LogReader):
    """An MCAP log that is open for reading: a :class:`prim.log.source.LogSource`.

    The file's records are surveyed when it is opened, and chunks are read as the survey found them, each once. What a
    chunk holds is checked against its index and the summary, whose definitions of channels and counts of messages are
    held against those in the chunks. With ``recover`` all chunks are read when it is opened, and those that can be
    unpacked are believed before any index.

    Args:
        file: The file; it begins with the magic of MCAP, as :func:`prim.log.open_log` checks.
        recover: Pass over damage, and collect it in :attr:`lost`.

    Raises:
        LogReadError: The file cannot be read or is damaged (unless ``recover``).
    """

    _FORMAT = "MCAP"

    def __init__(self, file: LogFile, recover: bool = False) -> None:
        super().__init__(file.path, recover, file)
        self._hint = "" if recover else RECOVER_HINT
        self._limit = memory_limit(file.file_bytes)
        self._most_records = records_limit(file.file_bytes)
        self._file: IO[bytes] = file.data.open("rb")
        self._definitions = _Definitions()
        self._times: dict[int, Stamps] = {}
        try:
            with damage_refused(self.path, self._hint):
                self._survey = Surveyor(self._file, recover, self.lost).survey()
                self._check_size(unpacked_limit(file.file_bytes))
                self._counts = self._count_all() if recover else self._check_summary()
                if self._counts.total() > self._most_records:
                    raise DamageError(f"it has {self._counts.total():,} messages, more than so few bytes can hold")
                self.metadata = {record.name: record.metadata for record in self._parsed_metadata()}
        except BaseException:
            self._file.close()
            raise
        self.topics = self._read_topics()
        self._channels: dict[str, list[int]] = {}
        for channel in self._definitions.channels.values():
            self._channels.setdefault(channel.topic, []).append(channel.id)
        with damage_refused(self.path, self._hint):
            self._shifts = self._find_shifts()
        self.notes = reset_notes(self._shifts)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        if not self.lost:
            return 0
        expected = _message_count(self._survey)
        if expected is None:
            return None
        return max(expected - self._counts.total(), 0) + len(self._undecodable)

    def attachment(self, name: str) -> bytes | None:
        """See :meth:`prim.log.source.LogSource.attachment`."""
        for record in self._survey.attachments:
            try:
                found, crc_fits = self._read_attachment(record)
            except (DamageError, OSError) as error:
                self._damage(f"its attachment at byte {record.at}: {error}")
                continue
            if not crc_fits:  # its name, too, may be what is damaged
                self._damage(f"the CRC of its attachment {found.name} does not fit")
            elif found.name == name:
                return found.data
        return None

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`."""
        names = {channel: topic for topic in topics for channel in self._channels.get(topic, ())}
        if len(self._shifts) > 1:
            yield from moved_behind_resets(self._written(names), self._shifts)
        else:
            yield from self._by_time(names)

    def log_times(self, topic: str) -> Stamps:
        """See :meth:`prim.log.reader.LogReader.log_times`: by the index where there is one."""
        if len(self._shifts) > 1:
            return super().log_times(topic)
        with damage_refused(self.path, self._hint):
            channels = self._channels.get(topic, ())
            times = np.concatenate([np.zeros(0, np.int64), *map(self._written_times, channels)])
        return np.sort(times)

    def _damage(self, what: str) -> None:
        """Note a loss; unless recovering, raise LogReadError."""
        if not self._recover:
            raise LogReadError(self.path, f"damaged: {what}", RECOVER_HINT)
        self._lose(what)

    def _check_size(self, limit: int) -> None:
        """Check how much all chunks claim to unpack to. Raises DamageError."""
        size = sum(block.head.size for block in self._survey.blocks if block.head and block.head.compression)
        if size > limit:
            claim = f"unpacked, its chunks would be of {megabytes(size)}"
            raise DamageError(f"{claim}, more than {megabytes(limit)}, which is the most for a file of this size")

    def _check_summary(self) -> Counter[int]:
        """Check the summary against the file, and return the number of messages by channel. Raises DamageError."""
        survey = self._survey
        for contradiction in survey.contradictions():
            raise DamageError(contradiction)
        counts = survey.counts()
        if counts is None:
            counts = self._count_all()
        else:
            self._read_definitions(counts)
        self._complete_definitions(counts)
        for contradiction in _miscounted(survey, counts):
            raise DamageError(contradiction)
        return counts

    def _read_definitions(self, counts: Counter[int]) -> None:
        """Read the definitions of channels where they should be: with the first messages, or outside chunks.

        What is still missing then is searched for in all chunks. Raises DamageError.
        """
        firsts: dict[int, Block] = {}
        for block in self._survey.blocks:
            for channel in block.known_counts or ():
                firsts.setdefault(channel, block)
        likely = {block.at for block in firsts.values()}
        for block in self._survey.blocks:
            if block.head is None or block.at in likely:
                self._define(block, self._split(block, ()))
        for block in self._survey.blocks:
            if counts.keys() <= self._definitions.channels.keys():
                return
            self._define(block, self._split(block, ()))

    def _count_all(self) -> Counter[int]:
        """Read all blocks: count their messages by channel, and note definitions, times, and what is damaged."""
        counts: Counter[int] = Counter()
        times: dict[int, list[int]] = {}
        readable: list[Block] = []
        for block in self._survey.blocks:
            contents = self._contents(block, ALL_CHANNELS)
            if contents is None:
                continue
            readable.append(block)
            counts.update(contents[1].counts)
            if contents[1].first_time is not None:
                block.start_time, block.end_time = contents[1].first_time, contents[1].last_time
            for time, _, _, channel in contents[1].rows:
                times.setdefault(channel, []).append(time)
        self._times = {channel: as_stamps(of_channel) for channel, of_channel in times.items()}
        if self._recover:
            self._complete_definitions(counts)
            of_summary = 0 if self._survey.summary.crc_fits else 1
            if len(self.lost) <= of_summary:  # else it is clear that messages are missing
                self.lost += [*self._survey.contradictions(), *_miscounted(self._survey, counts)]
            if len(self.lost) > MAX_LOST:
                self.lost[MAX_LOST:] = ["and more"]
        self._survey.blocks = readable
        return counts

    def _complete_definitions(self, counts: Counter[int]) -> None:
        """Take what no chunk defines from the summary, and compare the rest with it."""
        summary = self._survey.summary
        for schema in summary.schemas:
            self._check_definition(self._definitions.add_schema(schema), "its summary")
        for channel in summary.channels:
            self._check_definition(self._definitions.add_channel(channel), "its summary")
        unknown = counts.keys() - self._definitions.channels.keys()
        if unknown:
            messages = sum(counts[channel] for channel in unknown)
            self._damage(f"{messages} messages of {len(unknown)} channels that it does not describe")

    def _check_definition(self, contradiction: str | None, where: str) -> None:
        if contradiction:
            self._damage(f"{where} contradicts what came before: {contradiction}")

    def _define(self, block: Block, contents: Contents) -> None:
        """Note what a block defines. Raises DamageError."""
        for contradiction in self._definitions.add(contents):
            self._check_definition(contradiction, block.what)

    def _read_topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for channel in sorted(self._definitions.channels.values(), key=attrgetter("id")):
            schema = self._definitions.schemas.get(channel.schema_id)
            count = self._counts[channel.id]
            if channel.topic in topics:
                count += topics[channel.topic].messages
            name = ros2_name(schema.name if schema else "")
            topics[channel.topic] = Topic(channel.topic, name, channel.message_encoding, count, content_of(name))
        return topics

    def _data(self, block: Block) -> bytes:
        """Read and unpack the records of a block. Raises DamageError."""
        if block.head is not None:
            return unpack_chunk(self._file, block.head, self._limit)
        self._file.seek(block.at)
        return self._file.read(block.end - block.at)

    def _split(self, block: Block, wanted: Container[int]) -> Contents:
        """Read and split a block. Raises DamageError."""
        return split(self._data(block), wanted, self._most_records)

    def _contents(self, block: Block, wanted: Mapping[int, str] | range) -> tuple[bytes, Contents] | None:
        """Read, split and check a block; None, and a loss, where it is damaged. Raises LogReadError."""
        try:
            data = self._data(block)
            contents = split(data, wanted, self._most_records)
            self._check(block, contents)
        except (DamageError, OSError) as error:
            self._damage(_damaged_block(block, error))
            return None
        self._define(block, contents)
        block.counts = contents.counts
        return data, contents

    def _check(self, block: Block, contents: Contents) -> None:
        """Compare what a chunk holds with what it and its index say. Raises DamageError."""
        if block.head is None or self._recover:
            return
        first = contents.first_time
        if first is not None and not (block.start_time <= first and contents.last_time <= block.end_time):
            raise DamageError("its messages are not of the times that it says")
        if not block.index:
            return
        if contents.counts != block.indexed_counts:
            raise DamageError("its index counts other messages than it holds")
        entries: dict[int, list[int]] = {}
        for time, start, _, channel in contents.rows:
            entries.setdefault(channel, []).extend((time, start - MESSAGE_BYTES - PREFIX_BYTES))
        for channel, found in entries.items():
            if not _same_entries(self._index_bytes(block.index[channel]), found):
                raise DamageError(f"its index of channel {channel} is of other messages than it holds")

    def _index_bytes(self, index: IndexRecord) -> bytes:
        """Return the entries of an index of messages: log time (ns) and offset of each, 8 bytes little-endian."""
        self._file.seek(index.entries)
        return self._file.read(index.messages * INDEX_ENTRY_BYTES)

    def _may_hold(self, block: Block, names: Mapping[int, str]) -> bool:
        """Return whether a block may hold messages of channels.

        What it holds was seen, or an index says it that the summary confirms.
        """
        if block.counts is None and (not block.index or not self._survey.summary.chunks or self._recover):
            return True
        return not names.keys().isdisjoint(block.known_counts or ())

    def _written(self, names: Mapping[int, str]) -> Iterator[Message]:
        """Yield messages in the order of the file."""
        for block in self._survey.blocks:
            if self._may_hold(block, names) and (found := self._contents(block, names)):
                data, contents = found
                for time, start, stop, channel in contents.rows:
                    yield Message(names[channel], time, data[start:stop])

    def _by_time(self, names: Mapping[int, str]) -> Iterator[Message]:
        """Yield messages in the order of log times; those of one time in that of the file.

        Where too many would have to wait for others, that is an error; when recovering, they do not wait.
        """
        blocks = [block for block in self._survey.blocks if self._may_hold(block, names)]
        blocks.sort(key=attrgetter("start_time", "at"))
        if all(earlier.end_time <= later.start_time for earlier, later in pairwise(blocks)):
            for block in blocks:
                if (found := self._contents(block, names)) is not None:
                    data, contents = found
                    for time, start, stop, channel in sorted(contents.rows):
                        yield Message(names[channel], time, data[start:stop])
            return
        waiting: list[tuple[int, int, int, Message]] = []
        held = 0
        for block, later in zip(blocks, [*blocks[1:], None], strict=True):
            for position, message in enumerate(self._sorted(block, names)):
                heapq.heappush(waiting, (message.log_time, block.at, position, message))
                held += len(message.data)
            if held > self._limit and not self._recover:
                what = f"its chunks overlap in time: more than {megabytes(self._limit)} of messages wait to be sorted"
                raise LogReadError(self.path, what, "read it without sorting all of them with --recover")
            while waiting and (later is None or held > self._limit or waiting[0][0] < later.start_time):
                message = heapq.heappop(waiting)[3]
                held -= len(message.data)
                yield message

    def _sorted(self, block: Block, names: Mapping[int, str]) -> Iterator[Message]:
        found = self._contents(block, names)
        if found is not None:
            data, contents = found
            for time, start, stop, channel in sorted(contents.rows):
                yield Message(names[channel], time, data[start:stop])

    def _find_shifts(self) -> tuple[int, ...]:
        """Find out whether the log's times were set back."""
        channels = self._definitions.channels.values()
        scans = [channel.id for channel in channels if self.topics[channel.topic].content in SCAN_CONTENTS]
        return find_shifts(self._written_times(min(scans))) if scans else (0,)

    def _written_times(self, channel: int) -> Stamps:
        """Return when the messages of a channel were logged (N,) in ns, in the order of the file."""
        if channel not in self._times:
            parts = () if self._recover else self._indexed_times(channel)
            self._times[channel] = np.concatenate([np.zeros(0, np.int64), *parts])
        return self._times[channel]

    def _indexed_times(self, channel: int) -> Iterator[Stamps]:
        """Yield when the messages of a channel were logged (ns), by the index of chunks, and in runs of records."""
        indices = [block.index[channel] for block in self._survey.blocks if channel in block.index]
        entries = np.frombuffer(b"".join(map(self._index_bytes, indices)), "<u8").reshape(-1, 2)
        chunks = np.repeat(np.arange(len(indices)), [index.messages for index in indices])
        if len(entries):
            yield np.minimum(entries[np.lexsort((entries[:, 1], chunks)), 0], LATEST).astype(np.int64)
        for block in self._survey.blocks:
            if block.head is None and channel in (block.counts or ()):
                yield as_stamps(row[0] for row in self._split(block, (channel,)).rows)

    def _parsed_metadata(self) -> Iterator[Metadata]:
        for record in self._survey.metadata:
            try:
                yield parse(Metadata, read_body(self._file, record))
            except DamageError as error:
                self._damage(f"its metadata at byte {record.at}: {error}")

    def _read_attachment(self, record: Record) -> tuple[Attachment, bool]:
        """Return an attachment, and whether its CRC holds or there is none. Raises DamageError.

        Zeros may have been written over both it and the end of the data, in a log that has CRCs elsewhere.
        """
        body = read_body(self._file, record)
        attachment = parse(Attachment, body)
        builder = RecordBuilder()
        attachment.write(builder)
        if body[-4:] != NO_CRC:
            return attachment, body[-4:] == builder.end()[-4:]  # type: ignore[no-untyped-call]
        has_crcs = any(block.head and block.head.crc for block in self._survey.blocks)
        return attachment, not (has_crcs and attachment.data.endswith(b"\0"))


def _same_entries(index: bytes, found: list[int]) -> bool:
    """Return whether an index has the entries that were found, in their order or in another."""
    packed = struct.pack(f"<{len(found)}Q", *found)
    if index == packed:
        return True
    entries, others = (np.frombuffer(data, "<u8").reshape(-1, 2) for data in (index, packed))
    return np.array_equal(entries[np.argsort(entries[:, 1], kind="stable")], others)


class _Definitions:
    """The schemas and channels of a log: each is defined once, or again in the same way.

    Attributes:
        schemas: By number.
        channels: By number.
    """

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._seen: set[bytes] = set()

    def add(self, contents: Contents) -> Iterator[str]:
        """Add what a block defines, and yield in what that contradicts what is known. Raises DamageError."""
        for body in contents.schemas:
            if body not in self._seen and (contradiction := self.add_schema(parse(Schema, body))):
                yield contradiction
        for body in contents.channels:
            if body not in self._seen and (contradiction := self.add_channel(parse(Channel, body))):
                yield contradiction
        self._seen.update(contents.schemas, contents.channels)

    def add_schema(self, schema: Schema) -> str | None:
        """Add a schema; return in what it contradicts the one of its number."""
        known = self.schemas.setdefault(schema.id, schema)
        if (known.name, known.encoding, known.data) != (schema.name, schema.encoding, schema.data):
            return f"schema {schema.id} is {schema.name}, and was {known.name}"
        return None

    def add_channel(self, channel: Channel) -> str | None:
        """Add a channel; return in what it contradicts the one of its number."""
        known = self.channels.setdefault(channel.id, channel)
        same = (known.topic, known.message_encoding, known.schema_id)
        if same != (channel.topic, channel.message_encoding, channel.schema_id):
            return f"channel {channel.id} is {channel.topic}, and was {known.topic}"
        return None


def _message_count(survey: Survey) -> int | None:
    """Return how many messages the statistics count; None without them, or where they do not add up."""
    statistics, summary = survey.summary.statistics, survey.summary
    if statistics is None:
        return None
    adds_up = statistics.message_count == sum(statistics.channel_message_counts.values())
    return statistics.message_count if summary.crc_fits or adds_up else None


def _miscounted(survey: Survey, counts: Counter[int]) -> Iterator[str]:
    """Yield in what the statistics contradict the messages and attachments that were counted."""
    statistics = survey.summary.statistics
    expected = _message_count(survey)
    if statistics is None or expected is None:
        return
    if expected != counts.total():
        yield f"its summary counts {expected} messages, and {counts.total()} were found"
    else:
        for channel, count in statistics.channel_message_counts.items():
            if counts[channel] != count:
                yield f"its summary counts {count} messages of channel {channel}, and {counts[channel]} were found"
                break
    for what, number, found in (
        ("attachments", statistics.attachment_count, survey.attachments),
        ("metadata records", statistics.metadata_count, survey.metadata),
    ):
        if number > len(found):
            yield f"its summary counts {number} {what}, and {len(found)} were found"


def _damaged_block(block: Block, error: Exception) -> str:
    """Describe a block that cannot be read."""
    head = block.head
    if head is None or not 0 <= head.end_time - head.start_time < LATEST:
        return f"{block.what}: {error}"
    return f"{block.what}, of {(head.end_time - head.start_time) / 1e9:.2f} s: {error}"


@contextmanager
def damage_refused(path: Path, hint: str) -> Iterator[None]:
    """Turn damage in a ``with`` block into a LogReadError.

    Args:
        path: The log.
        hint: What to do about it.

    Yields:
        Nothing.
    """
    try:
        yield
    except DamageError as error:
        what = "truncated or damaged" if isinstance(error, CutError) else "damaged"
        raise LogReadError(path, f"{what}: {error}", hint) from error
    except OSError as error:
        raise LogReadError(path, f"cannot be read: {error.strerror or error}", hint) from error
