"""The records of an MCAP file (https://mcap.dev/spec): their heads, and what a chunk of them holds."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Container
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, NamedTuple, TypeVar

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from prim.log.limits import megabytes

MAGIC = b"\x89MCAP0\r\n"

PREFIX = struct.Struct("<BQ")
"""The prefix of every record: opcode and length."""

PREFIX_BYTES = PREFIX.size

MESSAGE = struct.Struct("<HIQQ")
"""The start of a message record: channel, sequence, log time, publish time."""

MESSAGE_BYTES = MESSAGE.size

MESSAGE_OPCODE = int(Opcode.MESSAGE)

NEVER = 1 << 64
"""Behind all log times."""

_CHUNK = struct.Struct("<QQQII")
"""The start of a chunk record: first and last log time, uncompressed size, CRC, and the length of the next field."""

_CHUNK_INDEX = struct.Struct("<QQQQI")
"""The start of an entry of the index of chunks: first and last log time, where the chunk begins, its length, and the
length of where its indices of messages are."""
_CHUNK_INDEX_ENTRY = struct.Struct("<HQ")
"""Where one is: channel, byte."""

MESSAGE_INDEX = struct.Struct("<HI")
"""The start of a record that indexes messages: channel, and the length of its entries (log time, offset) in bytes."""

MESSAGE_INDEX_BYTES = MESSAGE_INDEX.size

INDEX_ENTRY_BYTES = 16

FIRST_PRIVATE_OPCODE = 0x80
"""Opcodes from here on are for applications; others that the specification does not name are damage."""

HEAD_BYTES = _CHUNK.size + 48 + 8
"""So much of a record shows what it says of itself: of a chunk with the name of its compression, and its length."""

KNOWN_OPCODES = frozenset(int(opcode) for opcode in Opcode)


class DamageError(ValueError):
    """What does not fit together in a file."""


class CutError(DamageError):
    """A file that ends before a record does, or before its end."""


class Record(NamedTuple):
    """A record at the top level of a file.

    Attributes:
        opcode: What it is.
        at: Where its prefix begins (bytes).
        length: The length of what follows the prefix (bytes).
        head: The first HEAD_BYTES of that, or fewer where the file has no more.
    """

    opcode: int
    at: int
    length: int
    head: bytes

    @property
    def body(self) -> int:
        """Where what follows the prefix begins (bytes)."""
        return self.at + PREFIX_BYTES

    @property
    def end(self) -> int:
        """Where the next record begins (bytes)."""
        return self.at + PREFIX_BYTES + self.length


class ChunkHead(NamedTuple):
    """What a chunk says of itself.

    Attributes:
        start_time: The first log time in it (ns).
        end_time: The last one.
        size: Its size when it is unpacked (bytes).
        crc: The CRC of that; 0 for none.
        compression: «zstd», «lz4», or nothing.
        at: Where its packed records begin (bytes).
        packed_size: Their size (bytes).
    """

    start_time: int
    end_time: int
    size: int
    crc: int
    compression: str
    at: int
    packed_size: int


class IndexedChunk(NamedTuple):
    """What the index of chunks says of one, as far as it is compared.

    Attributes:
        at: Where it begins (bytes).
        indices: Where its indices of messages begin, by channel.
    """

    at: int
    indices: dict[int, int]


Kind = TypeVar("Kind", Attachment, AttachmentIndex, Channel, Metadata, MetadataIndex, Schema, Statistics)


def record_at(stream: IO[bytes], at: int, size: int) -> Record:
    """Read the prefix of the record at a byte of a file.

    Args:
        stream: The file.
        at: The byte.
        size: Where the records of the file end (bytes).

    Returns:
        The record.

    Raises:
        DamageError: No record begins there, or it does not end within the file.
    """
    stream.seek(at)
    head = stream.read(PREFIX_BYTES + HEAD_BYTES)
    if len(head) < PREFIX_BYTES:
        raise CutError("it ends within a record")
    opcode, length = PREFIX.unpack_from(head)
    if opcode not in KNOWN_OPCODES and opcode < FIRST_PRIVATE_OPCODE:
        raise DamageError(f"no record begins at byte {at}")
    if length > size - at - PREFIX_BYTES:
        raise CutError(f"the record at byte {at} runs past the end")
    return Record(opcode, at, length, head[PREFIX_BYTES:])


def read_body(stream: IO[bytes], record: Record) -> bytes:
    """Read what follows a record's prefix.

    Args:
        stream: The file.
        record: The record.

    Returns:
        The bytes.

    Raises:
        DamageError: The file ends before.
    """
    if record.length <= len(record.head):
        return record.head[: record.length]
    stream.seek(record.body)
    data = stream.read(record.length)
    if len(data) < record.length:
        raise CutError("it ends within a record")
    return data


class _WholeReads(ReadDataStream):
    """A stream of mcap's that raises DamageError where there are fewer bytes than are asked for."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise DamageError("it ends early")
        return data


def parse(kind: type[Kind], body: bytes, fills: bool = False) -> Kind:
    """Parse a record by its class of mcap.

    Args:
        kind: The class.
        body: What follows the record's prefix.
        fills: Whether its fields must fill it; else more may follow, as in a later version of the format.

    Returns:
        The record.

    Raises:
        DamageError: There is no such record.
    """
    stream = _WholeReads(BytesIO(body))
    try:
        record: Kind = kind.read(stream)
    except Exception as error:  # struct.error, EndOfFile, UnicodeDecodeError, OverflowError, MemoryError, ...
        raise DamageError(f"a {kind.__name__} that cannot be read") from error
    if fills and stream.count < len(body):
        raise DamageError(f"a {kind.__name__} that is too long")
    return record


def read_chunk_head(record: Record) -> ChunkHead:
    """Read what a chunk says of itself.

    Args:
        record: The chunk.

    Returns:
        What it says.

    Raises:
        DamageError: Its lengths do not add up.
    """
    head = record.head
    try:
        start_time, end_time, size, crc, name_length = _CHUNK.unpack_from(head)
        at = _CHUNK.size + name_length
        (packed_size,) = struct.unpack_from("<Q", head, at)
    except struct.error:
        raise DamageError(f"the chunk at byte {record.at} has no head") from None
    if at + 8 + packed_size != record.length:
        raise DamageError(f"the lengths of the chunk at byte {record.at} do not add up")
    compression = head[_CHUNK.size : at].decode("ascii", "replace")
    return ChunkHead(start_time, end_time, size, crc, compression, record.body + at + 8, packed_size)


def parse_chunk_index(body: bytes) -> IndexedChunk:
    """Parse an entry of the index of chunks. Raises DamageError."""
    try:
        _, _, at, _, size = _CHUNK_INDEX.unpack_from(body)
        entries = body[_CHUNK_INDEX.size : _CHUNK_INDEX.size + size]
        _, name_length = struct.unpack_from("<QI", body, _CHUNK_INDEX.size + size)
        struct.unpack_from("<QQ", body, _CHUNK_INDEX.size + size + 12 + name_length)
        return IndexedChunk(at, dict(_CHUNK_INDEX_ENTRY.iter_unpack(entries)))
    except struct.error:
        raise DamageError("a ChunkIndex that cannot be read") from None


def unpack_chunk(stream: IO[bytes], head: ChunkHead, limit: int) -> bytes:
    """Read and unpack the records of a chunk.

    Args:
        stream: The file.
        head: What the chunk says of itself.
        limit: The largest size that is unpacked (bytes).

    Returns:
        The records.

    Raises:
        DamageError: It is larger than it says or than the limit, or damaged.
    """
    if head.size > limit:
        claim = f"unpacked, it would be of {megabytes(head.size)}"
        raise DamageError(f"{claim}, more than {megabytes(limit)}, which is the most for a file of this size")
    stream.seek(head.at)
    packed = stream.read(head.packed_size)
    data = _unpacked(packed, head.compression, head.size)
    if len(data) != head.size:
        raise DamageError(f"its size is not {head.size} bytes, as it says")
    if head.crc and zlib.crc32(data) != head.crc:
        raise DamageError("its CRC does not fit")
    return data


def _unpacked(packed: bytes, compression: str, size: int) -> bytes:
    """Unpack at most one byte more than ``size``. Raises DamageError."""
    try:
        if compression == "":
            return packed
        if compression == "zstd":
            if zstandard.frame_content_size(packed) == size:
                return zstandard.ZstdDecompressor().decompress(packed, allow_extra_data=False)
            with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as reader:
                return reader.read(size + 1)
        if compression == "lz4":
            return bytes(LZ4FrameDecompressor().decompress(packed, size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise DamageError(f"its compression is damaged ({error})") from error
    raise DamageError(f"its compression, {compression!r}, is not known")


@dataclass
class Contents:
    """What a chunk, or a run of records outside chunks, holds.

    Attributes:
        schemas: Records of schemas.
        channels: Records of channels.
        counts: The number of messages by channel.
        rows: Of each message that is wanted: log time (ns), where it begins and ends in the data, channel.
        first_time: The first log time of all messages (ns); None without any.
        last_time: The last one.
    """

    schemas: list[bytes] = field(default_factory=list)
    channels: list[bytes] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    rows: list[tuple[int, int, int, int]] = field(default_factory=list)
    first_time: int | None = None
    last_time: int = 0


def split(data: bytes, wanted: Container[int], most: int) -> Contents:
    """Split the records of a chunk.

    Args:
        data: The records.
        wanted: The channels whose messages are wanted.
        most: A log of its size has no more records.

    Returns:
        What there is.

    Raises:
        DamageError: The records do not fit together, or are none that belong there.
    """
    contents = Contents()
    counts, rows = contents.counts, contents.rows
    first, last = NEVER, 0
    at, end, unpack, unpack_message = 0, len(data), PREFIX.unpack_from, MESSAGE.unpack_from
    while at < end:
        if end - at < PREFIX_BYTES:
            raise DamageError("a record runs past its end")
        opcode, length = unpack(data, at)
        start = at + PREFIX_BYTES
        at = start + length
        most -= 1
        if at > end or most < 0:
            raise DamageError(
                "a record runs past its end" if at > end else "it has more records than so few bytes can hold"
            )
        if opcode == MESSAGE_OPCODE:
            if length < MESSAGE_BYTES:
                raise DamageError("a message without a head")
            channel, _, time, _ = unpack_message(data, start)
            counts[channel] = counts.get(channel, 0) + 1
            if time < first:
                first = time
            if time > last:
                last = time
            if channel in wanted:
                rows.append((time, start + MESSAGE_BYTES, at, channel))
        elif opcode == Opcode.SCHEMA:
            contents.schemas.append(data[start:at])
        elif opcode == Opcode.CHANNEL:
            contents.channels.append(data[start:at])
        elif opcode < FIRST_PRIVATE_OPCODE:
            raise DamageError(f"a record that belongs in no chunk (opcode {opcode})")
    contents.first_time, contents.last_time = (first, last) if counts else (None, 0)
    return contents
