"""A survey of an MCAP file: where its records lie, by the records themselves and not by its index."""

from __future__ import annotations

import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Metadata, MetadataIndex, Schema, Statistics

from prim.log.mcap.records import (
    INDEX_ENTRY_BYTES,
    MAGIC,
    MESSAGE,
    MESSAGE_BYTES,
    MESSAGE_INDEX,
    MESSAGE_INDEX_BYTES,
    MESSAGE_OPCODE,
    PREFIX,
    PREFIX_BYTES,
    ChunkHead,
    CutError,
    DamageError,
    IndexedChunk,
    Record,
    parse,
    parse_chunk_index,
    read_body,
    read_chunk_head,
    record_at,
)

_FOOTER = struct.Struct("<QQI")
"""A footer: where the summary begins, where its offsets do, and the CRC of the summary."""

END_BYTES = PREFIX.size + _FOOTER.size + len(MAGIC)
"""A file's end: the footer record and the magic."""

RUN_BYTES = 1 << 22
"""Records outside chunks are read in runs of about this size (bytes)."""

LEAST_SEARCH_BYTES, SEARCH_BYTES = 1 << 10, 1 << 20
"""Behind damage, this much is searched at once for the next record (bytes): little at first, then more and more."""

MAX_PARSED = 1 << 16
"""A record that is searched for, and recognised by its fields, is no longer (bytes)."""

CHAIN = 3
"""A record that is searched for, and is recognised by none of its fields, is followed by so many others."""

_START = re.compile(rb"[\x01-\x0f](?=.{4}\x00{4})", re.DOTALL)
"""How a record of less than 4 GB begins."""

_CHUNK_OPCODE, _MESSAGE_INDEX_OPCODE, _CHUNK_INDEX_OPCODE = map(
    int, (Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX)
)
_RUN_OPCODES = tuple(map(int, (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)))

_PARSED = {
    int(Opcode.SCHEMA): Schema,
    int(Opcode.CHANNEL): Channel,
    int(Opcode.METADATA): Metadata,
    int(Opcode.STATISTICS): Statistics,
    int(Opcode.ATTACHMENT_INDEX): AttachmentIndex,
    int(Opcode.METADATA_INDEX): MetadataIndex,
}
"""Records that their fields recognise."""

_LENGTHS = {int(Opcode.FOOTER): _FOOTER.size, int(Opcode.DATA_END): 4, int(Opcode.SUMMARY_OFFSET): 17}
"""Records that have one length."""


class IndexRecord(NamedTuple):
    """The record that indexes a channel's messages in a chunk.

    Attributes:
        at: Where it begins (bytes).
        messages: Their number.
    """

    at: int
    messages: int

    @property
    def entries(self) -> int:
        """Where its entries begin (bytes)."""
        return self.at + PREFIX_BYTES + MESSAGE_INDEX_BYTES


@dataclass(slots=True)
class Block:
    """A chunk, or a run of records outside chunks.

    Attributes:
        at: Where it begins (bytes).
        end: Where it ends.
        head: What a chunk says of itself; None for a run.
        start_time: The first log time (ns): as the chunk says, or as it is in a run.
        end_time: The last one.
        index: A chunk's index of messages by channel; empty where it has none.
        counts: The number of messages by channel as they were found, of a chunk when it was read; None before.
    """

    at: int
    end: int
    head: ChunkHead | None
    start_time: int
    end_time: int
    index: dict[int, IndexRecord] = field(default_factory=dict)
    counts: dict[int, int] | None = None

    @property
    def what(self) -> str:
        """What it is, for people."""
        return f"a chunk at byte {self.at}" if self.head else f"records from byte {self.at}"

    @property
    def known_counts(self) -> dict[int, int] | None:
        """The number of messages by channel; None where only the chunk's content shows it."""
        return self.counts if self.counts is not None else self.indexed_counts or None

    @property
    def indexed_counts(self) -> dict[int, int]:
        """The number of messages by channel as its index says."""
        return {channel: record.messages for channel, record in self.index.items() if record.messages}


@dataclass
class Summary:
    """What the summary of a file says.

    Attributes:
        schemas: The schemas.
        channels: The channels.
        chunks: The index of chunks.
        attachments: The index of attachments.
        metadata: The index of metadata.
        statistics: The statistics; None without.
        crc_fits: Whether its CRC holds, or there is none.
    """

    schemas: list[Schema] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)
    chunks: list[IndexedChunk] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    statistics: Statistics | None = None
    crc_fits: bool = True


@dataclass
class Survey:
    """What a file holds.

    Attributes:
        blocks: Chunks and runs of other records, in the order of the file.
        attachments: The records of attachments.
        metadata: Those of metadata.
        summary: What its summary says; empty without one.
    """

    blocks: list[Block] = field(default_factory=list)
    attachments: list[Record] = field(default_factory=list)
    metadata: list[Record] = field(default_factory=list)
    summary: Summary = field(default_factory=Summary)

    def contradictions(self) -> Iterator[str]:
        """Yield in what the summary contradicts the file, as far as that shows without unpacking chunks."""
        yield from _compared("chunk", [b.at for b in self.blocks if b.head], self.summary.chunks, "at")
        yield from _compared("attachment", [r.at for r in self.attachments], self.summary.attachments, "offset")
        yield from _compared("metadata record", [r.at for r in self.metadata], self.summary.metadata, "offset")
        blocks = {block.at: block for block in self.blocks}
        for index in self.summary.chunks:
            block = blocks.get(index.at)
            if block and index.indices and not _agree(index, block):
                yield f"the index of chunks names other messages of {block.what} than are there"

    def counts(self) -> Counter[int] | None:
        """Return the number of messages by channel; None where only the chunks' contents show it."""
        counts: Counter[int] = Counter()
        for block in self.blocks:
            if block.counts is None and not block.index:
                return None
            for channel, count in (block.counts or {}).items():
                counts[channel] += count
            for channel, index in block.index.items():
                counts[channel] += index.messages
        return counts


def _compared(what: str, found: Sequence[int], indexed: Sequence[object], name: str) -> Iterator[str]:
    """Yield in what an index contradicts what was found, by where it lies."""
    if not indexed:
        return
    named = Counter(getattr(entry, name) for entry in indexed)
    missing, unnamed = named.keys() - set(found), set(found) - named.keys()
    twice = [at for at, count in named.items() if count > 1]
    if missing:
        yield f"{len(missing)} of {len(indexed)} {what}s of its index are not there, the first at byte {min(missing)}"
    if unnamed:
        yield f"its index lacks {len(unnamed)} of {len(found)} {what}s, the first at byte {min(unnamed)}"
    if twice:
        yield f"its index names the {what} at byte {min(twice)} {named[min(twice)]} times"


def _agree(index: IndexedChunk, block: Block) -> bool:
    """Return whether the index of chunks names a chunk's indices of messages."""
    return index.indices == {channel: record.at for channel, record in block.index.items()}


class Surveyor:
    """Surveys a file.

    Args:
        stream: The file.
        recover: Search behind damage for the next record; else damage is an error.
        lost: Gets a line for each part that was passed over.
    """

    def __init__(self, stream: IO[bytes], recover: bool, lost: list[str]) -> None:
        self._stream = stream
        self._recover = recover
        self._lost = lost
        self._found = Survey()
        self._size = 0
        self._summary_start: int | None = None
        self._last: Block | None = None
        self._data_ended = False
        self._missing_end = ""

    def survey(self) -> Survey:
        """Survey the file.

        Returns:
            What it holds.

        Raises:
            DamageError: The records do not fit together, or the end is missing (unless recovering).
        """
        self._size = self._read_end()
        at: int | None = len(MAGIC)
        self._stream.seek(0)
        if self._stream.read(len(MAGIC)) != MAGIC:
            self._lost.append("its start is not that of an MCAP log")
        while at is not None and at < self._size:
            try:
                record = record_at(self._stream, at, self._size)
                self._take(record)
                at = record.end
            except DamageError as error:
                if not self._recover:
                    raise
                at = self._resume(at, error)
        if self._missing_end and not self._lost:
            self._lost.append(self._missing_end)
        if self._lost and not self._found.blocks:
            raise DamageError(f"no messages in it can be read ({'; '.join(self._lost[:3])})")
        return self._found

    def _read_end(self) -> int:
        """Read the footer, check the summary's CRC, and return where the records end. Raises DamageError."""
        size = self._stream.seek(0, 2)
        self._stream.seek(max(size - END_BYTES, 0))
        end = self._stream.read()
        try:
            if len(end) < END_BYTES or not end.endswith(MAGIC) or end[0] != Opcode.FOOTER:
                raise CutError(f"its end is missing ({size} bytes)")
            start, _, crc = _FOOTER.unpack_from(end, PREFIX.size)
            if start > size - END_BYTES:
                raise DamageError("its summary lies beyond its end")
            self._summary_start = start
            if start and crc and self._summary_crc(start, size, end) != crc:
                self._found.summary.crc_fits = False
                raise DamageError("the CRC of its summary does not fit")
        except DamageError as error:
            if not self._recover:
                raise
            if self._summary_start is None:
                self._missing_end = str(error)
            else:
                self._lost.append(str(error))
        return size - len(MAGIC) if end.endswith(MAGIC) else size

    def _summary_crc(self, start: int, size: int, end: bytes) -> int:
        """Return the CRC of the summary, which covers the footer up to itself."""
        self._stream.seek(start)
        crc, left = 0, size - END_BYTES - start
        while left > 0 and (piece := self._stream.read(min(left, SEARCH_BYTES))):
            crc, left = zlib.crc32(piece, crc), left - len(piece)
        return zlib.crc32(end[: END_BYTES - len(MAGIC) - 4], crc)

    def _take(self, record: Record) -> None:
        """Add a record to what was found. Raises DamageError."""
        opcode = record.opcode
        if opcode == _MESSAGE_INDEX_OPCODE:
            self._take_index(record)
        elif opcode == _CHUNK_OPCODE:
            head = read_chunk_head(record)
            self._check_section(record, "a chunk")
            self._last = Block(record.at, record.end, head, head.start_time, head.end_time)
            self._found.blocks.append(self._last)
        elif opcode in _RUN_OPCODES:
            self._take_run(record)
        else:
            self._last = None
            self._take_other(record)

    def _take_index(self, record: Record) -> None:
        try:
            channel, size = MESSAGE_INDEX.unpack_from(record.head)
        except struct.error:
            raise DamageError(f"the index of messages at byte {record.at} has no head") from None
        if size != record.length - MESSAGE_INDEX_BYTES or size % INDEX_ENTRY_BYTES:
            raise DamageError(f"the lengths of the index of messages at byte {record.at} do not add up")
        if self._last is None or self._last.head is None:
            if self._recover:
                return
            raise DamageError(f"there is an index of messages at byte {record.at}, and no chunk before it")
        if channel in self._last.index:
            raise DamageError(f"{self._last.what} has two indices of channel {channel}")
        self._last.index[channel] = IndexRecord(record.at, size // INDEX_ENTRY_BYTES)

    def _take_run(self, record: Record) -> None:
        """Add a schema, a channel or a message outside chunks: to the run before it, or to the summary."""
        if self._data_ended and record.opcode != MESSAGE_OPCODE:
            self._take_other(record)
            return
        self._check_section(record, "a message")
        run = self._last
        if run is None or run.head is not None or run.end != record.at or run.end - run.at > RUN_BYTES:
            run = Block(record.at, record.at, None, 0, 0, counts={})
        if record.opcode == MESSAGE_OPCODE:
            if min(record.length, len(record.head)) < MESSAGE_BYTES:
                raise DamageError(f"the message at byte {record.at} has no head")
            channel, _, time, _ = MESSAGE.unpack_from(record.head)
            counts = run.counts if run.counts is not None else {}
            run.start_time = min(run.start_time, time) if counts else time
            run.end_time = max(run.end_time, time)
            counts[channel] = counts.get(channel, 0) + 1
        if run.at == run.end:
            self._found.blocks.append(run)
        run.end, self._last = record.end, run

    def _check_section(self, record: Record, what: str) -> None:
        if self._data_ended and not self._recover:
            raise DamageError(f"there is {what} at byte {record.at}, within the summary")

    def _take_other(self, record: Record) -> None:
        """Add a record of the summary, an attachment or metadata; pass over all others."""
        found, opcode = self._found, record.opcode
        summary = found.summary
        if opcode == _CHUNK_INDEX_OPCODE:
            summary.chunks.append(parse_chunk_index(read_body(self._stream, record)))
        elif opcode == Opcode.ATTACHMENT:
            found.attachments.append(record)
        elif opcode == Opcode.METADATA:
            found.metadata.append(record)
        elif opcode == Opcode.DATA_END:
            self._data_ended = True
            if self._summary_start and self._summary_start != record.end and not self._recover:
                raise DamageError(f"its summary is said to begin at byte {self._summary_start}, not {record.end}")
        elif opcode == Opcode.STATISTICS:
            summary.statistics = parse(Statistics, read_body(self._stream, record))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            summary.attachments.append(parse(AttachmentIndex, read_body(self._stream, record)))
        elif opcode == Opcode.METADATA_INDEX:
            summary.metadata.append(parse(MetadataIndex, read_body(self._stream, record)))
        elif opcode == Opcode.SCHEMA:
            summary.schemas.append(parse(Schema, read_body(self._stream, record)))
        elif opcode == Opcode.CHANNEL:
            summary.channels.append(parse(Channel, read_body(self._stream, record)))
        elif opcode == Opcode.FOOTER and record.end != self._size:
            raise DamageError(f"there is a footer at byte {record.at}, before the end")

    def _resume(self, at: int, error: DamageError) -> int | None:
        """Note damage; return where the next record begins, None where there is none."""
        self._last = None
        found = self._find_record(at + 1)
        self._lost.append(f"all beyond byte {at}: {error}" if found is None else f"bytes {at} to {found}: {error}")
        return found

    def _find_record(self, at: int) -> int | None:
        size = LEAST_SEARCH_BYTES
        while at < self._size:
            self._stream.seek(at)
            window = self._stream.read(size)
            for match in _START.finditer(window):
                if self._is_record(at + match.start(), CHAIN):
                    return at + match.start()
            if len(window) < size:
                return None
            at, size = at + size - PREFIX_BYTES, min(4 * size, SEARCH_BYTES)
        return None

    def _is_record(self, at: int, chain: int) -> bool:
        """Return whether a record begins at a byte: by its fields, or by those that follow it."""
        try:
            record = record_at(self._stream, at, self._size)
            if record.opcode == Opcode.CHUNK:
                read_chunk_head(record)
                return True
            if record.opcode == Opcode.MESSAGE_INDEX:
                _, size = MESSAGE_INDEX.unpack_from(record.head)
                return bool(size == record.length - MESSAGE_INDEX.size and size % INDEX_ENTRY_BYTES == 0)
            if record.opcode == Opcode.CHUNK_INDEX:
                return record.length <= MAX_PARSED and bool(parse_chunk_index(read_body(self._stream, record)))
            if record.opcode in _PARSED:
                return record.length <= MAX_PARSED and _is_parsed(self._stream, record)
        except (DamageError, struct.error):
            return False
        if record.length != _LENGTHS.get(record.opcode, record.length):
            return False
        return chain == 1 or record.end == self._size or self._is_record(record.end, chain - 1)


def _is_parsed(stream: IO[bytes], record: Record) -> bool:
    """Return whether a record's fields fill it. Raises DamageError."""
    parse(_PARSED[record.opcode], read_body(stream, record), fills=True)
    return True
