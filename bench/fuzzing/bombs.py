"""Small inputs that claim or become much: zeros and tiny records, in every compression, their claims true or not."""

from __future__ import annotations

import bz2
import gzip
import random
import sqlite3
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import lz4.frame
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema

from bench.fuzzing import mcap_file
from bench.fuzzing.case import Case
from bench.fuzzing.mcap_file import Assembly, Chunked
from bench.fuzzing.messages import message_record
from bench.fuzzing.records import BAG_MAGIC, BagRecord
from bench.fuzzing.samples import Samples

PACKED = (33_000, 33_000, 120_000, 1_000_000)
"""Sizes of bombs (bytes)."""
BLOCK = 128 * 1024
"""The largest block of zstd (bytes, RFC 8878)."""
GZIP_PIECE, BZIP2_PIECE, LZ4_PIECE = 16 << 20, 48 << 20, 8 << 20
"""Zeros that are compressed at once, and repeated (bytes)."""
OPTIONS = ("--no-viewer", "--no-detect", "--mapper", "det")

LASER_SCAN = "sensor_msgs/msg/LaserScan"


def zstd_zeros(size: int, claim: int | None = None, piece: bytes = b"\0") -> bytes:
    """Return a frame of zstd of one byte again and again: 4 bytes for each 128 KiB.

    Args:
        size: Of what is compressed, rounded up to blocks (bytes).
        claim: The frame's content size; None: it has none.
        piece: The byte.

    Returns:
        The frame.
    """
    window = bytes([(23 - 10) << 3])
    head = b"\x28\xb5\x2f\xfd" + (b"\x00" + window if claim is None else b"\xc0" + window + struct.pack("<Q", claim))
    blocks = max(1, -(-size // BLOCK))
    repeated = (BLOCK << 3 | 1 << 1).to_bytes(3, "little") + piece
    last = (BLOCK << 3 | 1 << 1 | 1).to_bytes(3, "little") + piece
    return head + repeated * (blocks - 1) + last


@cache
def _gzip_piece() -> bytes:
    return gzip.compress(bytes(GZIP_PIECE), mtime=0)


@cache
def _bzip2_piece(size: int) -> bytes:
    return bz2.compress(bytes(size))


@cache
def _lz4_frame(size: int) -> bytes:
    return lz4.frame.compress(bytes(size), block_size=lz4.frame.BLOCKSIZE_MAX4MB, store_size=False)


@cache
def _tiny_records(size: int, kind: str) -> bytes:
    """Return a chunk's records as small as they can be (bytes in all, about)."""
    if kind == "unknown":
        record = mcap_file.Record(0x80, b"").packed()
    elif kind == "messages":
        record = mcap_file.encode(message_record(1, 1, b"")).packed()
    elif kind == "channels":
        count = size // 45
        return b"".join(mcap_file.encode(_channel(k % 65536, f"/t{k}")).packed() for k in range(count))
    else:
        record = mcap_file.Record(Opcode.SCHEMA, struct.pack("<HIII", 1, 0, 0, 0)).packed()
    return record * (size // len(record))


def _channel(number: int, topic: str) -> Channel:
    return Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=1)


def _wild_claim(rng: random.Random, right: int) -> int:
    return rng.choice((right, right, 0, 1, 1000, right - 1, right + 1, 1 << 31, 1 << 40, (1 << 63) - 1))


def bomb(rng: random.Random, samples: Samples) -> Case:
    """Make a bomb.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    kinds = (_zero_chunk, _tiny_chunk, _packed_file, _packed_log, _zero_bag, _packed_message, _large_rows, _long_text)
    make = rng.choices(kinds, (4, 4, 3, 1, 3, 3, 1, 2))[0]
    what, name, data = make(rng, samples)
    return Case(what, {name: data}, options=OPTIONS)


Bomb = Callable[[random.Random, Samples], tuple[str, str, bytes]]


def _chunk_file(rng: random.Random, samples: Samples, chunk: Chunk) -> bytes:
    """Return a log with a chunk that is a bomb, before, behind or without those of the session."""
    file = Assembly(Chunked(4096))
    where = rng.choice(("alone", "before", "behind"))
    if where != "behind":
        file.add_chunk(chunk)
    file.add(Schema(id=1, data=b"", encoding="ros2msg", name=LASER_SCAN), _channel(1, "/scan"))
    for message in samples.content.of("/scan") if where != "alone" else ():
        file.add(message_record(1, message.log_time, message.data))
    file.end_chunk()
    if where == "behind":
        file.add_chunk(chunk)
    counted = rng.choice((0, 0, 1, 10**6, 1 << 62))
    return file.finish(with_summary=rng.random() < 0.6, **({"message_count": counted} if counted else {}))


def _chunk(compression: str, data: bytes, claim: int, crc: int = 0) -> Chunk:
    return Chunk(
        compression=compression,
        data=data,
        message_end_time=1,
        message_start_time=1,
        uncompressed_crc=crc,
        uncompressed_size=claim,
    )


def _zero_chunk(rng: random.Random, samples: Samples) -> tuple[str, str, bytes]:
    packed = rng.choice(PACKED)
    compression = rng.choice(("zstd", "zstd", "lz4", ""))
    if compression == "zstd":
        size = packed // 4 * BLOCK
        claimed = rng.choice((None, size, 1000, 0, 1 << 40))
        data = zstd_zeros(size, claimed, rng.choice((b"\0", b"\xff")))
    elif compression == "lz4":
        size, data = packed * 255, _lz4_frame(packed * 255)
    else:
        size, data = packed, bytes(packed)
    claim = _wild_claim(rng, size)
    file = _chunk_file(rng, samples, _chunk(compression, data, claim, rng.choice((0, 0, 1))))
    return (
        f"a chunk of {size / 1e6:.0f} MB of zeros in {compression or 'nothing'}, that claims {claim}",
        "log.mcap",
        file,
    )


def _tiny_chunk(rng: random.Random, samples: Samples) -> tuple[str, str, bytes]:
    kind = rng.choice(("unknown", "messages", "channels", "schemas"))
    size = rng.choice((1 << 20, 1 << 23, 1 << 25, 1 << 26)) >> (2 if kind == "channels" else 0)
    compression = rng.choice(("zstd", "lz4"))
    data = mcap_file.COMPRESSORS[compression](_tiny_records(size, kind))
    claim = _wild_claim(rng, size // 10 * 10)
    claim = len(_tiny_records(size, kind)) if rng.random() < 0.7 else claim
    file = _chunk_file(rng, samples, _chunk(compression, data, claim))
    return f"a chunk of {size / 1e6:.0f} MB of tiny {kind} in {compression}, that claims {claim}", "log.mcap", file


def _packed_file(rng: random.Random, samples: Samples) -> tuple[str, str, bytes]:
    """A file that is compressed as a whole, behind an intact log's start or of zeros alone."""
    packed = rng.choice(PACKED)
    head = rng.choice((b"", mcap_file.MAGIC, BAG_MAGIC, b"SQLite format 3\0", b"# CARMEN Logfile\n"))
    if rng.random() < 0.5:
        start = mcap_file.COMPRESSORS["zstd"](head) if head else b""
        data, name = start + zstd_zeros(packed // 4 * BLOCK, rng.choice((None, 0, 1 << 50))), "log.zst"
    else:
        start = gzip.compress(head, mtime=0) if head else b""
        data, name = start + _gzip_piece() * max(1, packed // len(_gzip_piece())), "log.gz"
    for _ in range(rng.choice((0, 0, 0, 1, 3))):
        data = gzip.compress(data, mtime=0) if rng.random() < 0.5 else mcap_file.COMPRESSORS["zstd"](data)
    return f"{name} of {packed} bytes, {head[:8]!r} and zeros", name, data


def _packed_log(rng: random.Random, samples: Samples) -> tuple[str, str, bytes]:
    """An intact log with very many zeros behind it."""
    sample = samples.by_name[rng.choice(("mcap", "bag", "db3", "carmen-flaser"))]
    data = mcap_file.COMPRESSORS["zstd"](sample.data) + zstd_zeros(rng.choice(PACKED) // 4 * BLOCK)
    return f"{sample.name}, with zeros behind it, in zstd", "log.zst", data


def _zero_bag(rng: random.Random, samples: Samples) -> tuple[str, str, bytes]:
    compression = rng.choice((b"bz2", b"bz2", b"lz4", b"none"))
    if compression == b"bz2":
        size = BZIP2_PIECE * rng.choice((1, 3))
        data = _bzip2_piece(size)
    elif compression == b"lz4":
        size = rng.choice(PACKED) * 255
        data = _lz4_frame(size)
    else:
        size = rng.choice(PACKED)
        data = bytes(size)
    claim = _wild_claim(rng, size) % (1 << 32)
    fields = ((b"op", b"\x05"), (b"compression", compression), (b"size", struct.pack("<I", claim)))
    chunk = BagRecord(fields, data).packed() * rng.choice((1, 1, 5))
    intact = samples.by_name["bag"].data
    head_end = len(BAG_MAGIC) + 4096
    file = rng.choice((BAG_MAGIC + chunk, intact[:head_end] + chunk + intact[head_end:], intact + chunk))
    return (
        f"a bag's chunk of {size / 1e6:.0f} MB of zeros in {compression.decode()}, that claims {claim}",
        "log.bag",
        file,
    )


def _packed_message(rng: random.Random, samples: Samples) -> tuple[str, str, bytes]:
    """Messages that are compressed by themselves."""
    packed = rng.choice(PACKED)
    claim = rng.choice((None, packed // 4 * BLOCK, 100, 1 << 40))
    topic, kind = rng.choice((("/scan", LASER_SCAN), ("/cloud", "sensor_msgs/msg/PointCloud2"), ("/x", "a/msg/B")))
    file = Assembly(Chunked(rng.choice((0, 1 << 30)), rng.choice(("", "zstd"))))
    file.add(Schema(id=1, data=b"", encoding="ros2msg", name=kind), _channel(1, topic))
    count = rng.choice((1, 2, 5))
    for k in range(count):
        file.add(message_record(1, samples.content.messages[0].log_time + k, zstd_zeros(packed // 4 * BLOCK, claim)))
    what = f"{count} messages of {topic}, each of {packed // 4 * BLOCK / 1e6:.0f} MB of zeros, that claim {claim}"
    return what, "log.mcap", file.finish()


def _large_rows(rng: random.Random, samples: Samples) -> tuple[str, str, bytes]:
    """A database of messages of zeros, whole or compressed as a file."""
    rows, size = rng.choice(((1, 900_000), (3, 300_000), (20_000, 1)))
    with TemporaryDirectory(prefix="prim-fuzz-") as folder:
        path = Path(folder) / "log.db3"
        path.write_bytes(samples.by_name["db3-foxy"].data)
        base = sqlite3.connect(path)
        topic = rng.randrange(1, 9)
        statement = "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, zeroblob(?))"
        base.executemany(statement, [(topic, samples.content.messages[0].log_time + k, size) for k in range(rows)])
        base.commit()
        base.close()
        data = path.read_bytes()
    if rng.random() < 0.5:
        return f"{rows} rows of {size} zeros, in zstd", "log.db3.zst", mcap_file.COMPRESSORS["zstd"](data)
    return f"{rows} rows of {size} zeros", "log.db3", data


def _long_text(rng: random.Random, samples: Samples) -> tuple[str, str, bytes]:
    """A log of CARMEN of one very long line, or of very many."""
    text = samples.by_name["carmen-flaser"].data
    size = rng.choice(PACKED)
    added = rng.choice(
        (
            b"FLASER " + b"1" * size,
            b"FLASER 1000000 " + b"1.0 " * (size // 4),
            b"FLASER " + str(size // 4).encode() + b" " + b"0 0 " * (size // 4),
            b"ODOM " * (size // 5),
            b"ODOM 0 0 0 0 0 0 1 h 1\n" * (size // 23),
            b"\n" * size,
            b"#\n" * (size // 2),
            b"PARAM a b 1 h 1\n" * (size // 16),
        )
    )
    data = text + added + b"\n"
    if rng.random() < 0.3:
        data, name = gzip.compress(data, mtime=0), "log.log.gz"
    else:
        name = "log.log"
    return f"a log of CARMEN with {added[:24]!r}... of {len(added)} bytes", name, data
