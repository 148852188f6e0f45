"""Reading ROS 1 bags record by record, without their index and past damage (wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Iterator, Mapping
from enum import IntEnum
from pathlib import Path
from typing import IO, NamedTuple

from lz4.frame import LZ4FrameDecompressor

from prim.errors import LogReadError
from prim.log.recovery import RECORD_LIMIT, RECOVER_HINT

MAGIC = b"#ROSBAG V2.0\n"

HEADER_LIMIT = 1 << 20
"""A record's header is no longer (bytes); a length beyond it is damage."""

_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")
_COUNT = struct.Struct("<II")


class Op(IntEnum):
    """What a record is."""

    MESSAGE = 2
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


class Connection(NamedTuple):
    """Who published on a topic: a topic may have several.

    Attributes:
        topic: The topic's name.
        type: The type of its messages, as ROS 1 names it.
    """

    topic: str
    type: str


class BagMessage(NamedTuple):
    """A message as it is stored.

    Attributes:
        connection: By whom it was published.
        log_time: When it was logged (ns).
        data: The serialized message.
    """

    connection: Connection
    log_time: int
    data: bytes


class _Record(NamedTuple):
    fields: Mapping[bytes, bytes]
    data: bytes
    end: int

    @property
    def op(self) -> int:
        return self.fields.get(b"op", b"\0")[0]


class BagRecords:
    """All messages of a bag in the order in which they were written.

    Args:
        stream: The file.
        path: The bag as the user names it.

    Attributes:
        expected: How many messages the bag's index counts, as far as it was read.
    """

    def __init__(self, stream: IO[bytes], path: Path) -> None:
        self._stream = stream
        self._path = path
        self.expected = 0

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def messages(self, lost: list[str] | None) -> Iterator[BagMessage]:
        """Yield the messages.

        Args:
            lost: Gets a line for each chunk that cannot be read, and for the rest where a record's length does not
                fit; None: damage is an error.

        Yields:
            The messages.

        Raises:
            LogReadError: The bag is damaged, and that is an error.
        """
        self.expected = 0
        connections: dict[int, Connection] = {}
        at = len(MAGIC)
        while True:
            try:
                record = self._record(at)
            except ValueError as error:
                self._note(f"all beyond byte {at}: {error}", lost)
                return
            if record is None:
                return
            try:
                yield from self._messages_of(record, connections)
            except (ValueError, KeyError, struct.error, IndexError) as error:
                self._note(f"the rest of a record at byte {at}: {error}", lost)
            at = record.end

    def _note(self, what: str, lost: list[str] | None) -> None:
        if lost is None:
            raise LogReadError(self._path, f"damaged: {what}", RECOVER_HINT)
        lost.append(what)

    def _record(self, at: int) -> _Record | None:
        """Read the record at a byte of the file; None at its end. Raises ValueError."""
        self._stream.seek(at)
        head = self._stream.read(_LENGTH.size)
        if not head:
            return None
        if len(head) < _LENGTH.size or (length := _LENGTH.unpack(head)[0]) > HEADER_LIMIT:
            raise ValueError("no record begins there")
        fields = _fields(self._stream.read(length))
        size = self._stream.read(_LENGTH.size)
        if len(size) < _LENGTH.size or (count := _LENGTH.unpack(size)[0]) > RECORD_LIMIT:
            raise ValueError("a record runs past the end")
        data = self._stream.read(count)
        if len(data) < count and fields.get(b"op") != bytes([Op.CHUNK]):
            raise ValueError("a record runs past the end")
        return _Record(fields, data, at + 2 * _LENGTH.size + length + count)

    def _messages_of(self, record: _Record, connections: dict[int, Connection]) -> Iterator[BagMessage]:
        """Yield the messages in a record, and note the connections. Raises ValueError."""
        if record.op == Op.CHUNK:
            for inner in _records_of_chunk(record):
                yield from self._messages_of(inner, connections)
        elif record.op == Op.CONNECTION:
            described = _fields(record.data)
            topic, kind = record.fields[b"topic"].decode(), described[b"type"].decode()
            connections[_LENGTH.unpack(record.fields[b"conn"])[0]] = Connection(topic, kind)
        elif record.op == Op.MESSAGE:
            seconds, nanoseconds = _TIME.unpack(record.fields[b"time"])
            connection = connections[_LENGTH.unpack(record.fields[b"conn"])[0]]
            yield BagMessage(connection, seconds * 1_000_000_000 + nanoseconds, record.data)
        elif record.op == Op.CHUNK_INFO:
            self.expected += sum(count for _, count in _COUNT.iter_unpack(record.data))


def _fields(data: bytes) -> dict[bytes, bytes]:
    """Split a header into its fields. Raises ValueError."""
    fields, at = {}, 0
    while at < len(data):
        if at + _LENGTH.size > len(data):
            raise ValueError("a header does not fit together")
        start = at + _LENGTH.size
        at = start + _LENGTH.unpack_from(data, at)[0]
        name, equals, value = data[start:at].partition(b"=")
        if at > len(data) or not equals:
            raise ValueError("a header does not fit together")
        fields[name] = value
    return fields


def _records_of_chunk(chunk: _Record) -> Iterator[_Record]:
    """Yield the records of a chunk, as far as they are there. Raises ValueError."""
    size = _LENGTH.unpack(chunk.fields[b"size"])[0]
    data = _unpacked(chunk.fields[b"compression"], chunk.data, size)
    at = 0
    while at + _LENGTH.size <= len(data):
        start = at + _LENGTH.size
        start_of_size = start + _LENGTH.unpack_from(data, at)[0]
        if start_of_size + _LENGTH.size > len(data):
            break
        end = start_of_size + _LENGTH.size + _LENGTH.unpack_from(data, start_of_size)[0]
        if end > len(data):
            break
        yield _Record(_fields(data[start:start_of_size]), data[start_of_size + _LENGTH.size : end], end)
        at = end
    if len(data) < size:
        raise ValueError("it ends early")


def _unpacked(compression: bytes, data: bytes, size: int) -> bytes:
    """Return a chunk's records, as many as there are of one that ends early. Raises ValueError."""
    if size > RECORD_LIMIT:
        raise ValueError(f"it claims {size} bytes")
    if compression == b"none":
        return data
    try:
        if compression == b"bz2":
            return bz2.BZ2Decompressor().decompress(data, size)
        if compression == b"lz4":
            return bytes(LZ4FrameDecompressor().decompress(data, size))
    except (OSError, RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from error
    raise ValueError(f"its compression, {compression!r}, is not known")
