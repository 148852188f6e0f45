"""Damage to MCAP logs: nothing is lost in silence, and as little as can be; a small file claims little memory."""

from __future__ import annotations

import random
import re
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Statistics
from mcap.writer import CompressionType, IndexType, Writer

from prim.errors import LogReadError
from prim.log import limits, open_log
from prim.log.mcap.records import MAGIC, PREFIX, Record, parse, parse_chunk_index
from prim.log.mcap.survey import Surveyor
from prim.log.source import Message
from prim.log.writer import LogWriter
from tests.prim.log.small_log import small_log, stored

HOLE = 512
END = PREFIX.size + 20 + len(MAGIC)
CONTENT = small_log(scans=40)


def recorded(path: Path) -> Path:
    """The log as prim records it, in several chunks."""
    with LogWriter(path) as log:
        for topic, kind in CONTENT.types.items():
            log.add_topic(topic, kind)
        for count, message in enumerate(CONTENT.messages):
            log.write(*message)
            if count % 10 == 9:
                log.flush()
    return path


def written(path: Path, finish: bool = True, **options: Any) -> Path:
    """The log as mcap's own writer writes it, with these options."""
    with path.open("wb") as stream:
        writer = Writer(stream, **{"chunk_size": 4096} | options)
        writer.start("ros2")
        schemas = {kind: writer.register_schema(kind, "ros2msg", b"") for kind in CONTENT.types.values()}
        channels = {t: writer.register_channel(t, "cdr", schemas[kind]) for t, kind in CONTENT.types.items()}
        for topic, time, data in CONTENT.messages:
            writer.add_message(channels[topic], time, data, time)
        if finish:
            writer.finish()
    return path


def in_order(messages: list[Message]) -> list[Message]:
    return sorted(messages, key=lambda message: message.log_time)


WHOLE = in_order(list(CONTENT.messages))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.MESSAGE},
        {"use_statistics": False},
        {"use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False, "repeat_schemas": False},
    ],
)
@pytest.mark.parametrize("recover", [False, True])
def test_a_log_is_read_whatever_its_writer_leaves_out(tmp_path: Path, options: dict[str, Any], recover: bool) -> None:
    messages, lost, messages_lost = stored(written(tmp_path / "a.mcap", **options), recover)
    assert messages == WHOLE and not lost and messages_lost == 0


def test_a_hole_costs_one_chunk_of_a_recording_that_was_killed(tmp_path: Path) -> None:
    data = recorded(tmp_path / "a.mcap").read_bytes()
    with (tmp_path / "a.mcap").open("rb") as stream:
        survey = Surveyor(stream, False, []).survey()
    killed = data[: survey.blocks[-1].end]
    assert len(survey.blocks) == 12
    for at in range(0, len(killed) - HOLE, HOLE):
        path = tmp_path / "hole.mcap"
        path.write_bytes(killed[:at] + bytes(HOLE) + killed[at + HOLE :])
        messages, lost, _ = stored(path, recover=True)
        hurt = sum(block.at < at + HOLE and at < block.end for block in survey.blocks)
        assert hurt <= 2 and len(messages) >= len(WHOLE) - 10 * hurt, at
        assert lost and {*messages} <= {*WHOLE}


def test_zeros_within_a_log_without_an_index_are_no_records(tmp_path: Path) -> None:
    """Else six records of nothing would hide what they are written over."""
    path = written(tmp_path / "a.mcap", index_types=IndexType.NONE, use_statistics=False, use_chunking=False)
    data = path.read_bytes()
    at = data.index(PREFIX.pack(Opcode.MESSAGE, 0)[:1], 2000)
    path.write_bytes(data[:at] + bytes(2 * HOLE) + data[at + 2 * HOLE :])
    with pytest.raises(LogReadError, match=r"no record begins.*--recover|runs past the end"):
        stored(path)
    messages, lost, _ = stored(path, recover=True)
    assert lost and len(WHOLE) - 12 < len(messages) < len(WHOLE)


@pytest.mark.parametrize("index", [0, 3, -1])
def test_a_chunk_that_is_gone_is_missed(tmp_path: Path, index: int) -> None:
    path = written(tmp_path / "a.mcap")
    data = path.read_bytes()
    with path.open("rb") as stream:
        block = Surveyor(stream, False, []).survey().blocks[index]
    path.write_bytes(data[: block.at] + data[block.end :])
    with pytest.raises(LogReadError, match=r"damaged: .*--recover"):
        stored(path)
    messages, lost, messages_lost = stored(path, recover=True)
    gone = len(WHOLE) - len(messages)
    assert lost and gone and messages_lost == gone


def with_summary(path: Path, change: Callable[[bytearray, list[Record]], bytes | None]) -> None:
    """Change the summary of a log, and make its CRC right again."""
    data = path.read_bytes()
    start = struct.unpack_from("<Q", data, len(data) - END + PREFIX.size)[0]
    records, at = [], start
    while at < len(data) - END:
        opcode, length = PREFIX.unpack_from(data, at)
        records.append(Record(opcode, at - start, length, b""))
        at = records[-1].end + start
    summary = bytearray(data[start : len(data) - END])
    summary = bytearray(change(summary, records) or summary)
    end = data[len(data) - END : -len(MAGIC) - 4]
    crc = struct.pack("<I", zlib.crc32(bytes(summary) + end))
    path.write_bytes(data[:start] + bytes(summary) + end + crc + MAGIC)


def chunk_twice(summary: bytearray, records: list[Record]) -> bytes:
    first = next(record for record in records if record.opcode == Opcode.CHUNK_INDEX)
    return bytes(summary[: first.end] + summary[first.at : first.end] + summary[first.end :])


def chunk_left_out(summary: bytearray, records: list[Record]) -> bytes:
    first = next(record for record in records if record.opcode == Opcode.CHUNK_INDEX)
    return bytes(summary[: first.at] + summary[first.end :])


def chunk_elsewhere(summary: bytearray, records: list[Record]) -> None:
    first = next(record for record in records if record.opcode == Opcode.CHUNK_INDEX)
    assert parse_chunk_index(bytes(summary[first.body : first.end])).at
    struct.pack_into("<Q", summary, first.body + 16, 1)


def other_type(summary: bytearray, records: list[Record]) -> bytes:
    return bytes(summary.replace(b"nav_msgs/msg/Odometry", b"nav_msgs/msg/OdometrX"))


def other_topic(summary: bytearray, records: list[Record]) -> bytes:
    return bytes(summary.replace(b"/scan", b"/scam"))


def more_messages(summary: bytearray, records: list[Record]) -> None:
    found = next(record for record in records if record.opcode == Opcode.STATISTICS)
    count = parse(Statistics, bytes(summary[found.body : found.end])).message_count
    struct.pack_into("<Q", summary, found.body, count + 3)


LIES = (chunk_twice, chunk_left_out, chunk_elsewhere, other_type, other_topic, more_messages)


@pytest.mark.parametrize("lie", LIES, ids=lambda lie: lie.__name__)
def test_a_summary_that_lies_is_refused_and_not_believed(
    tmp_path: Path, lie: Callable[[bytearray, list[Record]], bytes | None]
) -> None:
    path = written(tmp_path / "a.mcap")
    with_summary(path, lambda summary, records: None)
    assert stored(path)[0] == WHOLE
    with_summary(path, lie)
    with pytest.raises(LogReadError, match=r"damaged: .*--recover"):
        stored(path)
    messages, lost, _ = stored(path, recover=True)
    assert messages == WHOLE and lost


def test_flips_are_seen_or_change_nothing(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap")
    data, rng = path.read_bytes(), random.Random(1)
    for _ in range(400):
        at = rng.randrange(len(data))
        path.write_bytes(data[:at] + bytes([data[at] ^ rng.randrange(1, 256)]) + data[at + 1 :])
        for recover in (False, True):
            try:
                messages, lost, _ = stored(path, recover)
            except LogReadError as error:
                assert str(error).count("\n") == 0
                continue
            assert lost or messages == WHOLE, at


def bomb(compression: str, packed: bytes, claim: int) -> bytes:
    """A log of one chunk."""
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, claim, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    head = PREFIX.pack(Opcode.HEADER, 8) + bytes(8)
    end = PREFIX.pack(Opcode.DATA_END, 4) + bytes(4) + PREFIX.pack(Opcode.FOOTER, 20) + bytes(20)
    return MAGIC + head + PREFIX.pack(Opcode.CHUNK, len(body)) + body + end + MAGIC


def pack_zstd(size: int) -> bytes:
    compressor = zstandard.ZstdCompressor().compressobj()
    pieces = [compressor.compress(bytes(1 << 20)) for _ in range(size >> 20)]
    return b"".join([*pieces, compressor.flush()])


def pack_lz4(size: int) -> bytes:
    return bytes(lz4.frame.compress(bytes(size)))


MEASURE = """
import resource, sys
from prim.errors import LogReadError
from prim.log import open_log
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for recover in (False, True):
    try:
        with open_log(sys.argv[1], recover) as log:
            sum(1 for _ in log.messages(*log.topics))
    except LogReadError as error:
        print(error, file=sys.stderr)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.parametrize("claim", [1000, 1 << 30, 1 << 62], ids=["too little", "the truth", "too much"])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_bomb_takes_no_memory(tmp_path: Path, compression: str, claim: int) -> None:
    size = 1 << (30 if compression == "zstd" else 28)
    packed = pack_zstd(size) if compression == "zstd" else pack_lz4(size)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(bomb(compression, packed, size if claim == 1 << 30 else claim))
    run = subprocess.run([sys.executable, "-c", MEASURE, str(path)], capture_output=True, text=True, check=True)
    assert re.search(r"damaged: (a chunk at byte|unpacked, its chunks would)", run.stderr)
    assert int(run.stdout) * 1024 < limits.memory_limit(path.stat().st_size) + (32 << 20)


def test_a_chunk_of_records_of_nothing_is_refused(tmp_path: Path) -> None:
    """They would take long, one by one; no log packs as many messages into as few bytes."""
    path = tmp_path / "a.mcap"
    for record in (bytes(9), PREFIX.pack(0x80, 0), PREFIX.pack(Opcode.MESSAGE, 22) + bytes(22)):
        data = record * 1_000_000
        path.write_bytes(bomb("zstd", zstandard.compress(data), len(data)))
        with pytest.raises(LogReadError, match=r"belongs in no chunk|more records than"):
            stored(path)


def test_chunks_that_overlap_are_sorted_within_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 40)
        writer.start("ros2")
        channel = writer.register_channel("/a", "cdr", writer.register_schema("a/msg/A", "ros2msg", b""))
        for number, k in enumerate((*range(0, 100, 2), *range(99, 0, -2))):
            writer.add_message(channel, 1000 + k, bytes(1000), 0)
            if number % 5 == 4:
                writer._Writer__finalize_chunk()
        writer.finish()
    assert [message.log_time for message in stored(path)[0]] == [*range(1000, 1100)]
    monkeypatch.setattr("prim.log.mcap.reader.memory_limit", lambda size: 8_000)
    with pytest.raises(LogReadError, match=r"wait to be sorted; read it without sorting all of them with --recover"):
        stored(path)
    monkeypatch.setattr("prim.log.mcap.reader.memory_limit", lambda size: 8_000)
    messages, lost, _ = stored(path, recover=True)
    assert len(messages) == 100 and not lost


def test_zeros_over_an_attachment_and_its_crc_are_damage(tmp_path: Path) -> None:
    """An attachment without a CRC is none; but one that ends in zeros, in a log that has CRCs, is."""
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        log.add_attachment("world.json", "application/json", b"{}" * 400, 0)
        log.add_topic("/scan", CONTENT.types["/scan"])
        for message in CONTENT.messages:
            if message.topic == "/scan":
                log.write(*message)
    data = path.read_bytes()
    end = data.index(b"{}{}") + 800 + 4
    path.write_bytes(data[: end - HOLE] + bytes(HOLE) + data[end:])
    with open_log(path) as damaged, pytest.raises(LogReadError, match=r"CRC of its attachment world.json.*--recover"):
        damaged.attachment("world.json")
    with open_log(path, recover=True) as recovered:
        assert recovered.attachment("world.json") is None and recovered.lost


def test_an_index_of_messages_that_is_gone_is_missed(tmp_path: Path) -> None:
    """Without a summary it is all that says what a chunk holds."""
    bare = {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False, "use_summary_offsets": False}
    path = written(tmp_path / "a.mcap", index_types=IndexType.MESSAGE, **bare)
    with path.open("rb") as stream:
        block = Surveyor(stream, False, []).survey().blocks[1]
    data, index = path.read_bytes(), min(block.index.values())
    path.write_bytes(data[: index.at] + data[index.entries + 16 * index.messages :])
    with pytest.raises(LogReadError, match=r"its index counts other messages than it holds.*--recover"):
        stored(path)
