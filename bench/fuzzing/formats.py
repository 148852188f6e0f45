"""Hostile logs of all formats but MCAP: small files that claim much, contradict themselves, or hold what none should.

What a reader may make of each: an error of one line, or, with ``--recover``, what is left and a line of what is lost;
within 1 s + 2 s/MB and 600 MB + 4 N MB. None of them is a log whose content must come out.
"""

from __future__ import annotations

import bz2
import gzip
import random
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import lz4.frame
import zstandard

SCAN = "sensor_msgs/LaserScan"
TINY = b"\0" * 8
"""A record of a bag of no fields and no data."""
MUCH, LARGE = 80 << 20, 20 << 20
"""More than a small file may unpack to, and a large message (bytes)."""
WILD = ("nan", "inf", "-inf", "1e300", "-1e300", "1e999", "1e9", "9" * 4000, "0x10", "1_0", "\u0661", "\ufffd", "")
"""Numbers of a text that are none, or wild ones."""

PACKERS = {b"none": bytes, b"bz2": cache(bz2.compress), b"lz4": lz4.frame.compress}

TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
    "INSERT INTO topics VALUES(1, '/scan', 'sensor_msgs/msg/LaserScan', 'cdr');"
)
MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
    "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
)
NUMBERS = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n{})"


def number(value: int) -> bytes:
    """Return a number as bags have it."""
    return struct.pack("<I", value)


def header(fields: Sequence[tuple[str, bytes]]) -> bytes:
    """Return a bag's header: pairs of name and value, which may repeat."""
    parts = [name.encode() + b"=" + value for name, value in fields]
    whole = b"".join(number(len(part)) + part for part in parts)
    return number(len(whole)) + whole


def record(op: int, data: bytes, *fields: tuple[str, bytes]) -> bytes:
    """Return a record of a bag.

    Args:
        op: What it is.
        data: What follows its header.
        *fields: The header's other fields.

    Returns:
        The record.
    """
    return header([("op", bytes([op])), *fields]) + number(len(data)) + data


def connection(topic: str = "/scan", kind: str = SCAN, which: int = 0) -> bytes:
    """Return the record of a connection.

    Args:
        topic: Its topic.
        kind: The type of its messages.
        which: Its number.

    Returns:
        The record.
    """
    described = header([("topic", topic.encode()), ("type", kind.encode()), ("md5sum", b"*")])[4:]
    return record(7, described, ("conn", number(which)), ("topic", topic.encode()))


def message(seconds: int, data: bytes, which: int = 0) -> bytes:
    """Return the record of a message.

    Args:
        seconds: When it was logged (s).
        data: The message.
        which: The number of its connection.

    Returns:
        The record.
    """
    return record(2, data, ("conn", number(which)), ("time", struct.pack("<II", seconds, 0)))


@dataclass(frozen=True)
class Chunk:
    """A chunk of a bag, and what its index says of it.

    Attributes:
        records: What it unpacks to.
        times: When its messages were logged (s), by connections, as the index says.
        compression: «none», «bz2» or «lz4».
        claim: What it claims to unpack to (bytes); None: the truth.
    """

    records: bytes
    times: Mapping[int, Sequence[int]] = field(default_factory=dict)
    compression: bytes = b"none"
    claim: int | None = None

    def packed(self) -> bytes:
        """Return its record, and those of its index behind it."""
        size = len(self.records) if self.claim is None else self.claim
        data = PACKERS[self.compression](self.records)
        parts = [record(5, data, ("compression", self.compression), ("size", number(size)))]
        for which, times in self.times.items():
            entries = b"".join(struct.pack("<III", time, 0, 0) for time in times)
            fields = ("ver", number(1)), ("conn", number(which)), ("count", number(len(times)))
            parts.append(record(4, entries, *fields))
        return b"".join(parts)

    def info(self, place: int) -> bytes:
        """Return its record in the index, where it begins at this byte."""
        times = [time for of_connection in self.times.values() for time in of_connection] or [0]
        fields = [("ver", number(1)), ("chunk_pos", struct.pack("<Q", place)), ("count", number(len(self.times)))]
        fields += [("start_time", struct.pack("<II", min(times), 0)), ("end_time", struct.pack("<II", max(times), 0))]
        counts = b"".join(number(which) + number(len(times)) for which, times in self.times.items())
        return record(6, counts, *fields)


def bag(chunks: Sequence[Chunk], connections: Sequence[bytes], listed: Sequence[int] | None = None) -> bytes:
    """Return a ROS 1 bag.

    Args:
        chunks: Its chunks.
        connections: The records of connections in its index.
        listed: Which chunks the index lists, by their numbers; None: each once.

    Returns:
        The bag's bytes.
    """
    magic, place, places = b"#ROSBAG V2.0\n", 13 + 4096, []
    packed = [chunk.packed() for chunk in chunks]
    for part in packed:
        places.append(place)
        place += len(part)
    listed = range(len(chunks)) if listed is None else listed
    fields = ("index_pos", struct.pack("<Q", place)), ("conn_count", number(len(connections)))
    head = header([("op", b"\3"), *fields, ("chunk_count", number(len(listed)))])
    padding = b" " * (4096 - len(head) - 4)
    infos = [chunks[k].info(places[k]) for k in listed]
    return b"".join((magic, head, number(len(padding)), padding, *packed, *connections, *infos))


def database(script: str) -> bytes:
    """Return the SQLite database that a script makes."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "bag.db3"
        base = sqlite3.connect(path)
        base.executescript(script)
        base.close()
        return path.read_bytes()


def hostile_logs(rng: random.Random) -> Iterator[tuple[str, str, bytes]]:
    """Yield hostile logs.

    Args:
        rng: Draws sizes and places.

    Yields:
        What it is, a name for its file, and its bytes.
    """
    cases = [*_bags(rng), *_databases(rng), *_texts(rng), *_packed(rng)]
    rng.shuffle(cases)
    yield from cases


def _bags(rng: random.Random) -> Iterator[tuple[str, str, bytes]]:
    compression = rng.choice([b"bz2", b"lz4"])
    count = rng.randrange(100, 20_000)
    scan = connection()
    few = Chunk(scan + b"".join(message(k, b"") for k in range(9)), {0: range(9)}, compression)
    zeros, nothing = bytes(LARGE), message(1, b"") * count
    claim = 1 << rng.randrange(20, 32)
    cases = {
        "a chunk of zeros": bag([Chunk(zeros, {}, compression)], [scan]),
        "many chunks of one large message": bag([Chunk(scan + message(1, zeros), {0: [1]}, compression)] * 9, [scan]),
        "a chunk that claims less": bag([Chunk(zeros, {}, compression, claim >> 20)], [scan]),
        "a chunk that claims more": bag(
            [Chunk(few.records, few.times, compression, 1 << rng.randrange(20, 32))], [scan]
        ),
        "records of nothing": bag([Chunk(TINY * count)], [scan]),
        "messages of nothing": bag(
            [Chunk(scan + message(1, b"") * count, {0: [1] * count}, compression)] * 9, [scan]
        ),
        "a chunk that is not listed": bag([few, few, few], [scan], [0, 2]),
        "a chunk that is listed twice": bag([few, few], [scan], [0, 0]),
        "fewer messages than there are": bag([Chunk(few.records, {0: range(8)})], [scan]),
        "other times than there are": bag([Chunk(few.records, {0: range(1, 10)})], [scan]),
        "another connection in a chunk": bag([Chunk(connection("/other") + message(1, b""), {0: [1]})], [scan]),
        "a message of no connection": bag([Chunk(message(1, b"", 7), {7: [1]})], [scan]),
        "a topic of no name": bag([few], [connection("")]),
        "many topics": bag([few], [connection(f"/t{k}", SCAN, k) for k in range(count)]),
        "fields that repeat": bag([Chunk(header([("op", b"\2")] * count) + number(0))], [scan]),
        "chunks in chunks": bag([Chunk(_nested(count % 2000))], [scan]),
        "a message outside of chunks": b"#ROSBAG V2.0\n" + scan + nothing,
    }
    for what, data in cases.items():
        yield what, "hostile.bag", data


def _nested(depth: int) -> bytes:
    inner = b""
    for _ in range(depth):
        inner = record(5, inner, ("compression", b"none"), ("size", number(len(inner))))
    return inner


def _databases(rng: random.Random) -> Iterator[tuple[str, str, bytes]]:
    count = rng.randrange(100, 20_000)
    size = rng.randrange(1 << 10, 1 << 28)
    rows = f"{NUMBERS.format(f' WHERE k < {count}')} INSERT INTO messages(id, topic_id, timestamp)"
    bare = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER{});"
    generated = bare.format(f", data BLOB AS (zeroblob({size}))")
    row = "INSERT INTO messages(id, topic_id, timestamp, data) VALUES"
    untyped = "CREATE TABLE messages(id, topic_id, timestamp, data);"
    default = f"ALTER TABLE messages ADD COLUMN data BLOB DEFAULT x'{'00' * 9999}';"
    endless = (
        f"CREATE VIEW messages AS {NUMBERS.format('')} SELECT k id, 1 topic_id, k timestamp, zeroblob({size}) data"
    )
    odd_topics = (
        "CREATE TABLE topics(id, name, type, serialization_format); INSERT INTO topics VALUES"
        "(NULL, 1, 2, 3), ('x', NULL, x'00', 1.5), (1, '/a', 'b', 'cdr'), (1, '/b', 'b', 'cdr');"
    )
    scripts = {
        "an endless view": f"{TOPICS}{endless} FROM n;",
        "an endless view of topics": f"CREATE VIEW topics AS {NUMBERS.format('')} SELECT k id FROM n;{MESSAGES}",
        "a generated column": f"{TOPICS}{generated}{rows} SELECT k, 1, k FROM n;",
        "a default that is not stored": f"{TOPICS}{bare.format('')}{rows} SELECT k, 1, k FROM n;{default}",
        "many empty messages": f"{TOPICS}{MESSAGES}{rows} SELECT k, 1, k FROM n;",
        "a virtual table": f"{TOPICS}CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data);",
        "no rows of numbers": f"{TOPICS}{MESSAGES.replace('BLOB);', 'BLOB) WITHOUT ROWID;')}",
        "values of other types": f"{TOPICS}{untyped}{row}('a', 1, 'b', 'c'), (NULL, 1, NULL, NULL), (1, 1.5, 1, 2);",
        "a topic that is not listed": f"{TOPICS}{MESSAGES}{row}(1, {count}, 1, x'00');",
        "a time beyond all times": f"{TOPICS}{MESSAGES}{row}(1, 1, {-(2**63)}, x'00'), (2, 1, {2**63 - 1}, x'00');",
        "topics of other types": f"{odd_topics}{MESSAGES}",
    }
    for what, script in scripts.items():
        yield what, "hostile.db3", database(script)
    yield "two trees of the same pages", "hostile.db3", _shared_pages(count)


def _shared_pages(rows: int) -> bytes:
    """Return a database of which each inner page of the messages names one child again and again."""
    fill = f"{NUMBERS.format(f' WHERE k < {rows}')} INSERT INTO messages SELECT k, 1, k, zeroblob(40) FROM n;"
    data = bytearray(database(f"PRAGMA page_size = 512;{TOPICS}{MESSAGES.split(';')[0]};{fill}"))
    for page in range(512, len(data), 512):
        if data[page] == 5:  # an inner page of a table: https://sqlite.org/fileformat.html, 1.6
            (cells,) = struct.unpack_from(">H", data, page + 3)
            places = [page + struct.unpack_from(">H", data, page + 12 + 2 * k)[0] for k in range(cells)]
            for place in places:
                data[place : place + 4] = data[places[0] : places[0] + 4]
    return bytes(data)


def _texts(rng: random.Random) -> Iterator[tuple[str, str, bytes]]:
    odometry = "ODOM 0 0 0 0 0 0 1.0 host 1.0\n"
    count = rng.randrange(100_000, 300_000)
    lines = []
    for k in range(200):
        ranges = [rng.choice(WILD) if rng.random() < 0.1 else "1.5" for _ in range(9)]
        poses = [rng.choice(WILD) if rng.random() < 0.3 else "0.5" for _ in range(6)]
        readings = rng.choice(["9", "9", "1000000000", "-1", "nan"])
        lines.append(" ".join(("FLASER", readings, *ranges, *poses, rng.choice([f"{k}.5", *WILD]), "host 1.0")))
        lines.append(" ".join(("ODOM", *poses, rng.choice([f"{k}.5", *WILD]), "host 1.0")))
    texts = {
        "wild numbers": odometry + "\n".join(lines),
        "a line without an end": f"{odometry}FLASER {count * 20} " + "1 " * count * 20,
        "many readings": f"{odometry}FLASER {count} " + "1.5 " * count + "0 0 0 0 0 0 1.0 host 1.0\n",
        "many short lines": odometry + "ODOM\n" * count,
        "many empty lines": odometry + "\n" * count * 5,
        "zeros": odometry + "\0" * count + "\n" + odometry,
    }
    for what, text in texts.items():
        yield what, "hostile.log", text.encode()
    yield "bytes that are no text", "hostile.log", odometry.encode() + rng.randbytes(9999)


@cache
def _gzip_of(piece: bytes, count: int) -> bytes:
    return gzip.compress(piece * count, mtime=0)


@cache
def _large_database() -> bytes:
    script = f"{TOPICS}{MESSAGES}INSERT INTO messages VALUES(1, 1, 1, zeroblob({MUCH}));"
    return zstandard.compress(database(script))


def _packed(rng: random.Random) -> Iterator[tuple[str, str, bytes]]:
    zeros = zstandard.compress(bytes(MUCH))
    text = b"ODOM 0 0 0 0 0 0 1.0 host 1.0\n"
    count = rng.randrange(1, 20_000)
    yield "zeros in gzip", "hostile.log.gz", _gzip_of(b"\0", MUCH)
    yield "zeros in zstd", "hostile.mcap.zst", zeros
    yield "zeros in zstd in zstd", "hostile.mcap.zst", zstandard.compress(zeros)
    yield "lines in gzip", "hostile.log.gz", _gzip_of(text, 1) + _gzip_of(b"\n", LARGE)
    yield "the same line in zstd", "hostile.log.zst", zstandard.compress(text * 500_000)
    yield "members of nothing", "hostile.gz", _gzip_of(b"", 1) * count
    yield "frames of nothing", "hostile.zst", zstandard.compress(b"") * count
    yield "skippable frames", "hostile.zst", b"\x50\x2a\x4d\x18\0\0\0\0" * count
    yield "a window of 2 TiB", "hostile.zst", b"\x28\xb5\x2f\xfd\0" + bytes([31 << 3]) + b"\3\0\0" + bytes(99)
    yield "a large message in zstd", "hostile.db3.zst", _large_database()
