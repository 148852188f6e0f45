"""The index of a ROS 1 bag, and whether it agrees with what the bag's chunks hold."""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from prim.log.bag_records import MAGIC, BagRecord, BagRecords, Op, fields_of
from prim.log.decoding.cdr import SECOND

_COUNT = struct.Struct("<II")
"""Of a chunk's messages of a connection: its number, and how many."""

_ENTRY = np.dtype([("seconds", "<u4"), ("nanoseconds", "<u4"), ("offset", "<u4")])
"""What the index of a chunk has of each message."""


class Connection(NamedTuple):
    """Who published on a topic: a topic may have several.

    Attributes:
        topic: The topic's name.
        type: The type of its messages, as ROS 1 names it.
    """

    topic: str
    type: str


class ChunkIndex(NamedTuple):
    """What the index says of a chunk.

    Attributes:
        start: When its first message was logged (ns).
        end: When its last one was (ns).
        counts: How many messages it has, by connections.
    """

    start: int
    end: int
    counts: Mapping[int, int]


class BagIndex:
    """The index at a bag's end, and those behind its chunks.

    Args:
        records: The bag.
        damage: Is called with what is wrong; raises LogReadError unless that is to be passed over.
        limit: Of the size of a record (bytes).

    Attributes:
        at: Where the index at the end begins; 0 where there is none, or a damaged one.
        connections: The connections that it lists, by their numbers.
        chunks: What it says of chunks, by the bytes where they begin.
    """

    def __init__(self, records: BagRecords, damage: Callable[[str], None], limit: int) -> None:
        self._damage = damage
        self.at = 0
        self.connections: dict[int, Connection] = {}
        self.chunks: dict[int, ChunkIndex] = {}
        self._found: set[int] = set()
        self._chunk = 0
        self._times: dict[int, list[int]] | None = None
        self._is_whole = False
        try:
            self._read(records, limit)
        except ValueError as error:
            self._damage(f"its index cannot be read: {error}")
        self._places = sorted(self.chunks)

    def _read(self, records: BagRecords, limit: int) -> None:
        bag = records.record(len(MAGIC), limit)
        if bag.op != Op.BAG:
            raise ValueError("the record of the bag is missing")
        if encryptor := bag.fields.get(b"encryptor"):
            raise ValueError(f"it is encrypted by {encryptor!r}")
        start = bag.number(b"index_pos", 8)
        if start == 0:
            return
        if not bag.end <= start <= records.size:
            raise ValueError("it lies beyond the end")
        at = start
        while at < records.size:
            record = records.record(at, limit)
            self._add(record)
            at = record.end
        counts = bag.number(b"conn_count"), bag.number(b"chunk_count")
        if counts != (len(self.connections), len(self.chunks)):
            raise ValueError(f"{counts} connections and chunks are {(len(self.connections), len(self.chunks))}")
        self.at, self._is_whole = start, True

    def _add(self, record: BagRecord) -> None:
        """Add a record of the index. Raises ValueError."""
        if record.op == Op.CONNECTION:
            number, connection = connection_of(record)
            if number in self.connections:
                raise ValueError(f"connection {number} is listed twice")
            self.connections[number] = connection
        elif record.op == Op.CHUNK_INFO:
            place = record.number(b"chunk_pos", 8)
            count = record.number(b"count")
            if place in self.chunks or len(record.data) != count * _COUNT.size or record.number(b"ver") != 1:
                raise ValueError(f"a chunk at byte {place} is listed twice or not whole")
            counts = dict(_COUNT.iter_unpack(record.data))
            if len(counts) < count:
                raise ValueError(f"a chunk at byte {place} has a connection twice")
            self.chunks[place] = ChunkIndex(record.time(b"start_time"), record.time(b"end_time"), counts)
        else:
            raise ValueError(f"a record of kind {record.op}")

    @property
    def expected(self) -> int | None:
        """How many messages it says the bag has; None where it does not."""
        return sum(sum(chunk.counts.values()) for chunk in self.chunks.values()) if self._is_whole else None

    def next_chunk(self, at: int) -> int | None:
        """Return where the next chunk from a byte on is, or the index; None where it is not known."""
        number = bisect_left(self._places, at)
        return self._places[number] if number < len(self._places) else (self.at or None)

    def begin_chunk(self, at: int) -> None:
        """Go on to the chunk that begins at this byte."""
        self._finish_chunk()
        self._chunk = at
        self._found.add(at)

    def check_chunk(self, times: dict[int, list[int]]) -> None:
        """Compare what the index says of a chunk that is not damaged with what is in it.

        Args:
            times: When its messages were logged (ns), by connections.
        """
        self._times = times
        if not self._is_whole:
            return
        index = self.chunks.get(self._chunk)
        if index is None:
            raise ValueError("a chunk that the index does not have")
        counts = {number: len(of_connection) for number, of_connection in times.items()}
        listed = {number: count for number, count in index.counts.items() if count}
        if counts != listed:
            self._times = None
            raise ValueError(f"{sum(counts.values())} messages where the index counts {sum(listed.values())}")
        first, last = min(map(min, times.values()), default=0), max(map(max, times.values()), default=0)
        if times and not index.start <= first <= last <= index.end:
            raise ValueError("messages of other times than the index says")

    def check_times(self, record: BagRecord) -> None:
        """Compare an index behind a chunk, of the messages of a connection, with those. Raises ValueError."""
        if self._times is None:
            return
        number, count = record.number(b"conn"), record.number(b"count")
        if record.number(b"ver") != 1 or len(record.data) != count * _ENTRY.itemsize:
            raise ValueError("an index of a chunk is not whole")
        entries = np.frombuffer(record.data, _ENTRY)
        times = entries["seconds"].astype(np.int64) * SECOND + entries["nanoseconds"]
        if sorted(self._times.pop(number, [])) != np.sort(times).tolist():
            raise ValueError(f"an index of the chunk at byte {self._chunk} does not agree with it")

    def _finish_chunk(self) -> None:
        if self._times and self._is_whole:
            self._damage(f"the chunk at byte {self._chunk} has messages that the index behind it has not")
        self._times = None

    def finish(self) -> None:
        """Compare what the index says with all chunks that were found."""
        self._finish_chunk()
        missing = self.chunks.keys() - self._found
        if missing:
            self._damage(f"{len(missing)} chunks of the index are not there, the first one at byte {min(missing)}")


def connection_of(record: BagRecord) -> tuple[int, Connection]:
    """Return the number of the connection that a record describes, and the connection. Raises ValueError."""
    described = fields_of(record.data)
    if b"topic" not in record.fields or b"type" not in described:
        raise ValueError("a connection without its topic or type")
    name = record.fields[b"topic"].decode()
    plain = "/" * name.startswith("/") + "/".join(part for part in name.split("/") if part)
    return record.number(b"conn"), Connection(plain, described[b"type"].decode())
