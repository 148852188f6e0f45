"""Reading ROS 1 bags: all records once when they are opened, against which their index is checked."""

from __future__ import annotations

import shlex
import tempfile
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import IO

import numpy as np
from numpy.typing import NDArray

from prim.arrays import Stamps
from prim.errors import LogReadError
from prim.log.bag_index import BagIndex, Connection, connection_of
from prim.log.bag_records import (
    MAGIC,
    BagRecord,
    BagRecords,
    Op,
    StoredMessage,
    message_of,
    records_of_chunk,
    unpacked,
)
from prim.log.decoding.codecs import SCAN_CONTENTS, content_of
from prim.log.limits import ROW_LIMITS, memory_limit, records_limit, unpacked_limit
from prim.log.log_file import LogFile
from prim.log.reader import RECOVER_HINT, LogReader, ros2_name
from prim.log.source import Message, Topic
from prim.log.time_resets import as_stamps, find_shifts, moved_behind_resets, reset_notes

ENCODING = "ros1"

COSTS = {b"none": 0, b"lz4": 1, b"bz2": 8}
"""What unpacking takes, by the compression: of what all chunks may unpack to, a byte of bzip2 uses up so many."""


class _Table:
    """Where all messages are, in the order in which they were written: 24 bytes each."""

    def __init__(self) -> None:
        self._connections, self._times, self._places, self._sizes = array("I"), array("Q"), array("q"), array("I")

    def add(self, message: StoredMessage, place: int) -> None:
        """Add a message.

        Args:
            message: The message.
            place: The byte of the bag's file where it begins; -1 - byte of the file of unpacked chunks.
        """
        self._connections.append(message.connection)
        self._times.append(message.time)
        self._places.append(place)
        self._sizes.append(message.size)

    def __len__(self) -> int:
        return len(self._times)

    @property
    def connections(self) -> NDArray[np.uint32]:
        """The numbers of their connections (N,)."""
        return np.frombuffer(self._connections, np.uint32) if len(self) else np.zeros(0, np.uint32)

    @property
    def times(self) -> Stamps:
        """When they were logged (N,) in ns."""
        return np.frombuffer(self._times, np.int64) if len(self) else np.zeros(0, np.int64)

    def rows(self, selected: NDArray[np.int64]) -> Iterator[tuple[int, int, int, int]]:
        """Yield connection, time, place and size of the messages with these numbers (M,)."""
        for k in selected.tolist():
            yield self._connections[k], self._times[k], self._places[k], self._sizes[k]


class BagReader(LogReader):
    """A ROS 1 bag, of format 2.0, that is open for reading: a :class:`prim.log.source.LogSource`.

    Args:
        file: The file.
        recover: Pass over what is damaged, with or without an index.

    Raises:
        LogReadError: The file cannot be read, or (unless ``recover``) is damaged or does not agree with its index.
    """

    _FORMAT = "ROS 1 bag"

    def __init__(self, file: LogFile, recover: bool) -> None:
        super().__init__(file.path, recover, file)
        self._unpack_hint = file.unpack_hint
        try:
            self._stream = file.data.open("rb")
        except OSError as error:
            raise LogReadError(file.path, f"cannot be read: {error.strerror or error}") from error
        self._unpacked: IO[bytes] | None = None
        self._unpacked_bytes = self._records_read = 0
        self._table = _Table()
        try:
            self._records = BagRecords(self._stream)
            self._index = BagIndex(self._records, self._damage, memory_limit(self.file_bytes))
            if not (recover or self._index.at):
                raise LogReadError(self.path, "truncated: it has no index, as its recorder was killed", RECOVER_HINT)
            self._connections: dict[int, Connection] = dict(self._index.connections)
            self._read_records()
            self._index.finish()
        except OSError as error:
            self.close()
            raise LogReadError(self.path, f"cannot be read: {error.strerror or error}") from error
        except BaseException:
            self.close()
            raise
        self.topics = self._find_topics()
        self._shifts = self._find_shifts()
        self.notes = reset_notes(self._shifts)

    def close(self) -> None:
        """Close the files."""
        self._stream.close()
        if self._unpacked:
            self._unpacked.close()

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        expected = self._index.expected
        if expected is None:
            return None if self.lost else len(self._undecodable)
        return max(expected - len(self._table), 0) + len(self._undecodable)

    def _damage(self, what: str) -> None:
        """Note what is lost; unless recovering, raise LogReadError."""
        if not self._recover:
            raise LogReadError(self.path, f"damaged: {what}", RECOVER_HINT)
        self._lose(what)

    def _read_records(self) -> None:
        """Read all records before the index: note where the messages are."""
        at, end = len(MAGIC), self._index.at or self._records.size
        while at < end:
            self._count_record()
            try:
                record = self._records.record(at, max(self._records.size, memory_limit(self.file_bytes)))
            except ValueError as error:
                found = self._index.next_chunk(at + 1) or self._records.next_chunk(at + 1)
                self._damage(f"bytes {at} to {min(found, end)}: {error}")
                at = found
                continue
            try:
                self._read_record(record, at)
            except ValueError as error:
                self._damage(f"the rest of a record at byte {at}: {error}")
            at = record.end
        if at != end:
            self._damage(
                "its last record runs past the end" if end == self._records.size else "its index lies in a record"
            )

    def _count_record(self) -> None:
        self._records_read += 1
        limit = records_limit(self.file_bytes, ROW_LIMITS)
        if self._records_read > limit:
            what = f"more than {limit} records in {self.file_bytes} bytes"
            raise LogReadError(self.path, what, self._unpack_hint)

    def _read_record(self, record: BagRecord, at: int) -> None:
        """Read a record of the file that begins at this byte. Raises ValueError."""
        if record.op == Op.CHUNK:
            self._read_chunk(record, at)
        elif record.op == Op.INDEX:
            self._index.check_times(record)
        elif record.op == Op.CONNECTION:
            self._connect(record)
        elif record.op == Op.MESSAGE:
            self._damage("messages outside of chunks, which the index does not have")
            message = message_of(record)
            self._check_connection(message)
            self._table.add(message, message.at)
        elif record.op not in (Op.BAG, Op.CHUNK_INFO):
            raise ValueError(f"a record of an unknown kind, {record.op}")

    def _read_chunk(self, record: BagRecord, at: int) -> None:
        """Read the records of a chunk. Raises ValueError."""
        self._index.begin_chunk(at)
        times: dict[int, list[int]] = {}
        data, problem = self._unpack(record)
        base = record.at if data is record.data else self._keep(data)
        for inner in records_of_chunk(data):
            self._count_record()
            if isinstance(inner, StoredMessage):
                self._check_connection(inner)
                self._table.add(inner, base + inner.at if base >= 0 else base - inner.at)
                times.setdefault(inner.connection, []).append(inner.time)
            elif inner.op == Op.CONNECTION:
                self._connect(inner)
            else:
                raise ValueError(f"a record of kind {inner.op} in a chunk")
        if problem:
            raise ValueError(problem)
        self._index.check_chunk(times)

    def _unpack(self, record: BagRecord) -> tuple[bytes, str]:
        """Return the records of a chunk, and what is wrong with it. Raises ValueError."""
        compression, size = record.fields.get(b"compression", b""), record.number(b"size")
        limit = memory_limit(self.file_bytes)
        if compression != b"none" and size > limit:
            raise ValueError(f"a chunk of {len(record.data)} bytes that claims {size}, more than {limit}")
        data, problem = unpacked(compression, record.data, size)
        if cost := COSTS[compression]:
            self._unpacked_bytes += cost * len(data)
            if self._unpacked_bytes > unpacked_limit(self.file_bytes):
                largest = unpacked_limit(self.file_bytes) // cost
                what = f"its {self.file_bytes} bytes unpack to more than {largest} bytes"
                hint = f"if you trust it, unpack its chunks with: rosbag decompress {shlex.quote(str(self.path))}"
                raise LogReadError(self.path, what, self._unpack_hint or hint)
        return data, problem

    def _keep(self, data: bytes) -> int:
        """Put a chunk into the file of unpacked ones; return -1 - the byte where it begins there."""
        if self._unpacked is None:
            self._unpacked = tempfile.TemporaryFile(prefix="prim-")  # noqa: SIM115 - closed with the log
        at = self._unpacked.tell()
        self._unpacked.write(data)
        return -1 - at

    def _connect(self, record: BagRecord) -> None:
        """Note a connection, which the index has too. Raises ValueError."""
        number, connection = connection_of(record)
        if self._connections.setdefault(number, connection) != connection:
            raise ValueError(f"connection {number} is another one elsewhere")

    def _check_connection(self, message: StoredMessage) -> None:
        if message.connection not in self._connections:
            raise ValueError(f"a message of connection {message.connection}, which nothing describes")

    def _find_topics(self) -> Mapping[str, Topic]:
        numbers, counts = np.unique(self._table.connections, return_counts=True)
        messages = Counter(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
        topics: dict[str, Topic] = {}
        for number, (name, kind) in self._connections.items():
            count = messages[number] + (topics[name].messages if name in topics else 0)
            kind = ros2_name(kind)
            topics[name] = Topic(name, kind, ENCODING, count, content_of(kind))
        return topics

    def _find_shifts(self) -> tuple[int, ...]:
        """Find out whether the log's times were set back, by the messages of a scanner."""
        scans = next((topic.name for topic in self.holding(*SCAN_CONTENTS)), None)
        return (0,) if scans is None else find_shifts(as_stamps(self._table.times[self._written((scans,))].tolist()))

    def _written(self, topics: Sequence[str]) -> NDArray[np.int64]:
        """Return which messages (M,) are of these topics, in the order in which they were written."""
        wanted = [number for number, connection in self._connections.items() if connection.topic in topics]
        return np.flatnonzero(np.isin(self._table.connections, np.array(wanted, np.uint32)))

    def _sorted(self, topics: Sequence[str]) -> NDArray[np.int64]:
        """Return the same by their times; at one time, in the order of connections."""
        selected = self._written(topics)
        numbers = np.array([*self._connections], np.uint32)
        order = np.argsort(numbers)
        ranks = (
            order[np.searchsorted(numbers[order], self._table.connections[selected])] if len(selected) else selected
        )
        by_time: NDArray[np.int64] = selected[np.lexsort((ranks, self._table.times[selected]))]
        return by_time

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`."""
        as_written = len(self._shifts) > 1
        stored = self._stored_messages(self._written(topics) if as_written else self._sorted(topics))
        return moved_behind_resets(stored, self._shifts) if as_written else stored

    def _stored_messages(self, selected: NDArray[np.int64]) -> Iterator[Message]:
        try:
            for number, time, place, size in self._table.rows(selected):
                stream = self._stream if place >= 0 else self._unpacked
                assert stream is not None
                stream.seek(place if place >= 0 else -1 - place)
                yield Message(self._connections[number].topic, time, stream.read(size))
        except OSError as error:
            raise LogReadError(self.path, f"cannot be read: {error.strerror or error}") from error

    def log_times(self, topic: str) -> Stamps:
        """See :meth:`prim.log.reader.LogReader.log_times`: without reading the messages."""
        if len(self._shifts) > 1:
            return super().log_times(topic)
        return self._table.times[self._sorted((topic,))]
