"""The records of ROS 1 bags (wiki.ros.org/Bags/Format/2.0): of the file, and of its chunks."""

from __future__ import annotations

import bz2
import os
import re
import struct
from collections.abc import Iterator, Mapping
from enum import IntEnum
from itertools import permutations
from typing import IO, NamedTuple

from lz4.frame import LZ4FrameDecompressor

from prim.log.decoding.cdr import SECOND

MAGIC = b"#ROSBAG V2.0\n"

HEADER_LIMIT = 1 << 20
"""A record's header is no longer (bytes); a length beyond it is damage."""

NOT_TOGETHER = "a header does not fit together"

SEARCHED_BYTES = 1 << 20
"""Behind damage, so much is searched at once for the next chunk."""

_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")


class Op(IntEnum):
    """What a record is."""

    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


class BagRecord(NamedTuple):
    """A record of a bag.

    Attributes:
        op: What it is; a number that is no :class:`Op` where it is unknown.
        fields: The fields of its header.
        data: What follows the header.
        at: Where its data begins, in the file or in the chunk.
        end: Where the next record begins.
    """

    op: int
    fields: Mapping[bytes, bytes]
    data: bytes
    at: int
    end: int

    def number(self, name: bytes, size: int = 4) -> int:
        """Return a field that is an unsigned number.

        Args:
            name: Its name.
            size: Its size (bytes).

        Returns:
            The number.

        Raises:
            ValueError: There is no such field.
        """
        value = self.fields.get(name, b"")
        if len(value) != size:
            raise ValueError(f"a record without {name.decode()}")
        return int.from_bytes(value, "little")

    def time(self, name: bytes) -> int:
        """Return a field that is a time (ns). Raises ValueError."""
        return time_of(self.number(name, 8).to_bytes(8, "little"))


class StoredMessage(NamedTuple):
    """Where a message is.

    Attributes:
        connection: The number of its connection.
        time: When it was logged (ns).
        at: Where its data begins, in the file or in the chunk.
        size: How long that is (bytes).
    """

    connection: int
    time: int
    at: int
    size: int


class BagRecords:
    """The records of a bag's file.

    Args:
        stream: The file.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.size = stream.seek(0, os.SEEK_END)

    def record(self, at: int, limit: int) -> BagRecord:
        """Read the record at a byte of the file; a chunk that is cut as far as it goes.

        Args:
            at: The byte.
            limit: Of its size (bytes).

        Returns:
            The record.

        Raises:
            ValueError: There is none.
        """
        self._stream.seek(at)
        head = self._stream.read(_LENGTH.size)
        if len(head) < _LENGTH.size or (length := _LENGTH.unpack(head)[0]) > HEADER_LIMIT:
            raise ValueError("no record begins there")
        fields = fields_of(self._stream.read(length))
        op, size = _op(fields), self._stream.read(_LENGTH.size)
        start = at + 2 * _LENGTH.size + length
        if len(size) < _LENGTH.size:
            raise ValueError("a record runs past the end")
        end = start + _LENGTH.unpack(size)[0]
        if end > self.size and op != Op.CHUNK:
            raise ValueError("a record runs past the end")
        if end - start > limit:
            raise ValueError(f"a record of {end - start} bytes")
        return BagRecord(op, fields, self._stream.read(min(end, self.size) - start), start, end)

    def next_chunk(self, at: int) -> int:
        """Search for the next chunk from a byte of the file on; where there is none, return the file's end."""
        while at < self.size:
            self._stream.seek(at)
            block = self._stream.read(SEARCHED_BYTES + max(map(len, _CHUNK_HEADS)))
            found = (block.find(head) for head in _CHUNK_HEADS)
            places = [at + place for place in found if 0 <= place < SEARCHED_BYTES]
            if places:
                return min(places)
            at += SEARCHED_BYTES
        return self.size


_CHUNK_FIELDS = {
    compression: (
        b"\x04\0\0\0op=\x05",
        _LENGTH.pack(len(b"compression=" + compression)) + b"compression=" + compression,
        b"\x09\0\0\0size=",
    )
    for compression in (b"none", b"bz2", b"lz4")
}
"""The fields of a chunk's header, with their lengths, by the compression."""

_CHUNK_HEADS = [
    _LENGTH.pack(sum(map(len, fields)) + 4) + b"".join(order)
    for fields in _CHUNK_FIELDS.values()
    for order in permutations(fields)
    if order[-1] is fields[-1]
]
"""How chunks begin: their size is the last field, as all known recorders write it."""

_MESSAGE_FIELDS = (rb"\x09\0\0\0conn=(?P<conn>.{4})", rb"\x04\0\0\0op=\x02", rb"\x0d\0\0\0time=(?P<time>.{8})")

_MESSAGE_HEADS = [
    re.compile(re.escape(_LENGTH.pack(38)) + b"".join(order) + rb"(?P<size>.{4})", re.DOTALL)
    for order in permutations(_MESSAGE_FIELDS)
]
"""How messages begin, whose headers have 38 bytes, in any order of their fields: most records are messages."""


def fields_of(data: bytes) -> dict[bytes, bytes]:
    """Split a header into its fields. Raises ValueError."""
    fields: dict[bytes, bytes] = {}
    at = 0
    while at < len(data):
        if at + _LENGTH.size > len(data):
            raise ValueError(NOT_TOGETHER)
        start = at + _LENGTH.size
        at = start + _LENGTH.unpack_from(data, at)[0]
        name, equals, value = data[start:at].partition(b"=")
        if at > len(data) or not equals or name in fields:
            raise ValueError(NOT_TOGETHER)
        fields[name] = value
    return fields


def _op(fields: Mapping[bytes, bytes]) -> int:
    op = fields.get(b"op", b"")
    if len(op) != 1:
        raise ValueError("no record begins there")
    return op[0]


def time_of(data: bytes) -> int:
    """Return a time (ns) of its 8 bytes."""
    seconds, nanoseconds = _TIME.unpack(data)
    return int(seconds) * SECOND + int(nanoseconds)


def message_of(record: BagRecord) -> StoredMessage:
    """Return where the message of a record is. Raises ValueError."""
    return StoredMessage(record.number(b"conn"), record.time(b"time"), record.at, len(record.data))


def records_of_chunk(data: bytes) -> Iterator[StoredMessage | BagRecord]:
    """Yield the records of a chunk, as far as they are there.

    Args:
        data: The chunk, unpacked.

    Yields:
        Where messages are, and other records.

    Raises:
        ValueError: It does not end with a record.
    """
    at, heads = 0, list(_MESSAGE_HEADS)
    while at < len(data):
        found = heads[0].match(data, at)
        if not found:
            other = next((head for head in heads if head.match(data, at)), None)
            if other:
                heads.remove(other)
                heads.insert(0, other)
                continue
            record = _record_of_chunk(data, at)
            at = record.end
            yield message_of(record) if record.op == Op.MESSAGE else record
            continue
        connection, time, size = found["conn"], found["time"], int.from_bytes(found["size"], "little")
        start, at = found.end(), found.end() + size
        if at > len(data):
            raise ValueError("it ends within a message")
        yield StoredMessage(int.from_bytes(connection, "little"), time_of(time), start, size)


def _record_of_chunk(data: bytes, at: int) -> BagRecord:
    start = at + _LENGTH.size
    if start + _LENGTH.size > len(data):
        raise ValueError("it ends within a record")
    at_size = start + _LENGTH.unpack_from(data, at)[0]
    if at_size + _LENGTH.size > len(data):
        raise ValueError("it ends within a record")
    end = at_size + _LENGTH.size + _LENGTH.unpack_from(data, at_size)[0]
    if end > len(data):
        raise ValueError("it ends within a record")
    fields = fields_of(data[start:at_size])
    return BagRecord(_op(fields), fields, data[at_size + _LENGTH.size : end], at_size + _LENGTH.size, end)


def unpacked(compression: bytes, data: bytes, size: int) -> tuple[bytes, str]:
    """Unpack a chunk.

    Args:
        compression: By what it is compressed.
        data: The chunk.
        size: What it claims to unpack to (bytes): no more is unpacked.

    Returns:
        Its records, as many as there are of one that ends early, and what is wrong with it; empty where nothing is.

    Raises:
        ValueError: Nothing of it can be unpacked.
    """
    if compression == b"none":
        return data, "" if len(data) == size else f"{len(data)} bytes where it claims {size}"
    if compression not in _DECOMPRESSORS:
        raise ValueError(f"its compression, {compression!r}, is not known")
    frame = _DECOMPRESSORS[compression]()
    try:
        records = bytes(frame.decompress(data, size + 1))
    except (OSError, RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from error
    if len(records) > size:
        raise ValueError(f"it unpacks to more than the {size} bytes that it claims")
    is_whole = frame.eof and len(records) == size
    return records, "" if is_whole else f"{len(records)} bytes where it claims {size}"


_DECOMPRESSORS = {b"bz2": bz2.BZ2Decompressor, b"lz4": LZ4FrameDecompressor}
