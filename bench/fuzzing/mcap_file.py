"""MCAP files in pieces (https://mcap.dev/spec): taken apart, and put together with offsets and CRCs right."""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from io import BytesIO
from typing import Any, NamedTuple, Protocol

import lz4.frame
import zstandard
from mcap import records as mcap_records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
PREFIX = struct.Struct("<BQ")
"""Opcode and length (bytes), before each record."""
FOOTER_BYTES = PREFIX.size + 8 + 8 + 4
CRC_BYTES = 4

CLASSES: dict[int, Any] = {
    opcode: getattr(mcap_records, name)
    for opcode, name in {
        Opcode.HEADER: "Header",
        Opcode.FOOTER: "Footer",
        Opcode.SCHEMA: "Schema",
        Opcode.CHANNEL: "Channel",
        Opcode.MESSAGE: "Message",
        Opcode.CHUNK: "Chunk",
        Opcode.MESSAGE_INDEX: "MessageIndex",
        Opcode.CHUNK_INDEX: "ChunkIndex",
        Opcode.ATTACHMENT: "Attachment",
        Opcode.ATTACHMENT_INDEX: "AttachmentIndex",
        Opcode.STATISTICS: "Statistics",
        Opcode.METADATA: "Metadata",
        Opcode.METADATA_INDEX: "MetadataIndex",
        Opcode.SUMMARY_OFFSET: "SummaryOffset",
        Opcode.DATA_END: "DataEnd",
    }.items()
}
"""The classes of records by their opcodes."""

COMPRESSORS = {"": bytes, "zstd": zstandard.compress, "lz4": lz4.frame.compress}
DECOMPRESSORS = {
    "": bytes,
    "zstd": lambda data: zstandard.ZstdDecompressor().decompress(data, 1 << 30),
    "lz4": lz4.frame.decompress,
}


class Packable(Protocol):
    """A record that knows its bytes."""

    def packed(self) -> bytes:
        """Return its bytes."""
        ...


class Record(NamedTuple):
    """A record as it is stored."""

    opcode: int
    body: bytes

    def packed(self) -> bytes:
        """Return its bytes, opcode and length included."""
        return PREFIX.pack(self.opcode, len(self.body)) + self.body


def split(data: bytes) -> list[Record]:
    """Split the bytes between the magics of a file, or those of a chunk, into records."""
    records, at = [], 0
    while at + PREFIX.size <= len(data):
        opcode, length = PREFIX.unpack_from(data, at)
        records.append(Record(opcode, data[at + PREFIX.size : at + PREFIX.size + length]))
        at += PREFIX.size + length
    return records


def join(records: Iterable[Packable]) -> bytes:
    """Invert :func:`split`."""
    return b"".join(record.packed() for record in records)


def decode(record: Record) -> Any:
    """Return a record's fields, as mcap's class of its kind."""
    stream = ReadDataStream(BytesIO(record.body))
    if record.opcode == Opcode.MESSAGE:
        return Message.read(stream, len(record.body))
    return CLASSES[record.opcode].read(stream)


def encode(fields: McapRecord) -> Record:
    """Invert :func:`decode`; raises struct.error where a number does not fit into its field."""
    builder = RecordBuilder()
    fields.write(builder)
    data = builder.end()  # type: ignore[no-untyped-call]
    return Record(data[0], data[PREFIX.size :])


def unpacked(chunk: Chunk) -> bytes:
    """Return the records of a chunk, joined."""
    return bytes(DECOMPRESSORS[chunk.compression](chunk.data))


def repacked(chunk: Chunk, records: Iterable[Packable]) -> Chunk:
    """Return a chunk that holds other records, with a CRC that is right if it had one.

    Args:
        chunk: The chunk.
        records: The records.

    Returns:
        The chunk.
    """
    data = join(records)
    crc = zlib.crc32(data) if chunk.uncompressed_crc else 0
    packed = COMPRESSORS[chunk.compression](data)
    return replace(chunk, data=packed, uncompressed_crc=crc, uncompressed_size=len(data))


class Summary(NamedTuple):
    """A file cut where its summary begins.

    Attributes:
        data: All before the summary, the magic included.
        records: The summary's records, without those of offsets.
    """

    data: bytes
    records: list[Record]


def take_apart(file: bytes) -> Summary:
    """Split an intact file that has a summary."""
    end = len(file) - FOOTER_BYTES - len(MAGIC)
    start, offsets, _ = struct.unpack_from("<QQI", file, end + PREFIX.size)
    return Summary(file[:start], split(file[start : offsets or end]))


def put_together(
    data: bytes,
    records: Sequence[Record],
    offsets: Sequence[Record] | None = None,
    starts: tuple[int, int] | None = None,
) -> bytes:
    """Return a file whose summary has a CRC that is right.

    Args:
        data: All before the summary.
        records: The summary's records, those of a kind side by side.
        offsets: Its records of offsets; None: such as fit.
        starts: Where the footer says that the summary and its offsets begin (bytes); None: where they do.

    Returns:
        The file.
    """
    begin = len(data)
    packed = join(records)
    if offsets is None:
        offsets = right_offsets(begin, records)
    where = starts or (begin if records else 0, begin + len(packed) if offsets else 0)
    summary = packed + join(offsets)
    footer = PREFIX.pack(Opcode.FOOTER, FOOTER_BYTES - PREFIX.size) + struct.pack("<QQ", *where)
    crc = zlib.crc32(footer, zlib.crc32((data + summary)[where[0] :]) if where[0] else 0)
    return data + summary + footer + struct.pack("<I", crc) + MAGIC


def right_offsets(begin: int, records: Sequence[Record]) -> list[Record]:
    """Return the records of offsets of a summary that begins at a byte."""
    groups: dict[int, tuple[int, int]] = {}
    at = begin
    for record in records:
        length = PREFIX.size + len(record.body)
        start, size = groups.get(record.opcode, (at, 0))
        groups[record.opcode] = start, size + length
        at += length
    return [
        encode(SummaryOffset(group_opcode=opcode, group_start=start, group_length=size))
        for opcode, (start, size) in groups.items()
    ]


class Chunked(NamedTuple):
    """How :class:`Assembly` packs messages.

    Attributes:
        bytes: A chunk ends when it holds this much; 0: no chunks.
        compression: Of the chunks: «zstd», «lz4» or nothing.
        has_crc: Whether chunks have CRCs.
    """

    bytes: int = 4096
    compression: str = "zstd"
    has_crc: bool = True


CHUNKED = Chunked()


class Assembly:
    """Puts records together as they are, however they contradict each other, and indexes them.

    Args:
        chunked: How messages are packed.
        profile: The header's profile.
    """

    def __init__(self, chunked: Chunked = CHUNKED, profile: str = "ros2") -> None:
        self._chunked = chunked
        self._data = bytearray(MAGIC + encode(Header(profile=profile, library="fuzz")).packed())
        self._chunk = bytearray()
        self._entries: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._described: list[Record] = []
        self._index: list[Record] = []
        self._counts: dict[int, int] = defaultdict(int)
        self._totals = {"chunks": 0, "attachments": 0, "metadata": 0}
        self._times: list[int] = []

    def add(self, *records: McapRecord) -> None:
        """Append records: schemas, channels and messages to the current chunk, others beside it."""
        for record in records:
            packed = encode(record)
            if isinstance(record, Attachment | Metadata):
                self._add_indexed(record, packed.packed())
                continue
            if isinstance(record, Schema | Channel):
                self._described.append(packed)
            if isinstance(record, Message):
                self._entries[record.channel_id].append((record.log_time, len(self._chunk)))
                self._counts[record.channel_id] += 1
                self._times.append(record.log_time)
            if self._chunked.bytes == 0:
                self._data += packed.packed()
                continue
            self._chunk += packed.packed()
            if len(self._chunk) >= self._chunked.bytes:
                self.end_chunk()

    def end_chunk(self) -> None:
        """End the current chunk, if there is anything in it, and write its indexes of messages."""
        if not self._chunk:
            return
        times = [time for entries in self._entries.values() for time, _ in entries] or [0]
        data = bytes(self._chunk)
        self.add_chunk(
            Chunk(
                compression=self._chunked.compression,
                data=COMPRESSORS[self._chunked.compression](data),
                message_end_time=max(times),
                message_start_time=min(times),
                uncompressed_crc=zlib.crc32(data) if self._chunked.has_crc else 0,
                uncompressed_size=len(data),
            )
        )
        self._chunk.clear()

    def add_chunk(self, chunk: Chunk) -> None:
        """Append a chunk as it is, and an index of it that says the same.

        Args:
            chunk: The chunk.
        """
        packed = encode(chunk).packed()
        start = len(self._data)
        self._data += packed
        offsets = {}
        indexes = len(self._data)
        for channel, entries in self._entries.items():
            offsets[channel] = len(self._data)
            self._data += encode(MessageIndex(channel_id=channel, records=entries)).packed()
        self._entries.clear()
        self._totals["chunks"] += 1
        index = ChunkIndex(
            chunk_length=len(packed),
            chunk_start_offset=start,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=len(self._data) - indexes,
            message_index_offsets=offsets,
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )
        self._index.append(encode(index))

    def _add_indexed(self, record: Attachment | Metadata, packed: bytes) -> None:
        at, size = len(self._data), len(packed)
        index: AttachmentIndex | MetadataIndex
        if isinstance(record, Attachment):
            index = AttachmentIndex(
                offset=at,
                length=size,
                log_time=record.log_time,
                create_time=record.create_time,
                data_size=len(record.data),
                name=record.name,
                media_type=record.media_type,
            )
            self._totals["attachments"] += 1
        else:
            index = MetadataIndex(length=size, offset=at, name=record.name)
            self._totals["metadata"] += 1
        self._data += packed
        self._index.append(encode(index))

    def statistics(self, **changed: int) -> Statistics:
        """Return the statistics of what was added; ``changed`` replaces fields."""
        schemas = {record.body[:2] for record in self._described if record.opcode == Opcode.SCHEMA}
        channels = {record.body[:2] for record in self._described if record.opcode == Opcode.CHANNEL}
        fields: dict[str, Any] = {
            "attachment_count": self._totals["attachments"],
            "channel_count": len(channels),
            "channel_message_counts": dict(self._counts),
            "chunk_count": self._totals["chunks"],
            "message_count": sum(self._counts.values()),
            "message_end_time": max(self._times, default=0),
            "message_start_time": min(self._times, default=0),
            "metadata_count": self._totals["metadata"],
            "schema_count": len(schemas),
        }
        return Statistics(**fields | changed)

    def finish(self, with_summary: bool = True, **changed: int) -> bytes:
        """Return the file.

        Args:
            with_summary: Whether it has a summary.
            **changed: Fields of the statistics that are to say something else.

        Returns:
            The file.
        """
        self.end_chunk()
        data = bytes(self._data) + encode(DataEnd(0)).packed()
        if not with_summary:
            return put_together(data, ())
        summary = [*self._described, encode(self.statistics(**changed)), *self._index]
        return put_together(data, sorted(summary, key=lambda record: record.opcode))


def is_footer(record: Record) -> bool:
    """Return whether a record is the file's last one."""
    return record.opcode == Opcode.FOOTER


__all__ = [
    "CLASSES",
    "CRC_BYTES",
    "DECOMPRESSORS",
    "MAGIC",
    "PREFIX",
    "Assembly",
    "Chunked",
    "Footer",
    "Record",
    "Summary",
    "decode",
    "encode",
    "is_footer",
    "join",
    "put_together",
    "right_offsets",
    "split",
    "take_apart",
]
