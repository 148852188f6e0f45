"""Damage to whole records of MCAP files and ROS 1 bags: dropped, doubled, reordered, unknown, of lengths that lie."""

from __future__ import annotations

import bz2
import random
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import lz4.frame
from mcap.opcode import Opcode

from bench.fuzzing import mcap_file
from bench.fuzzing.case import Case
from bench.fuzzing.samples import Sample, Samples

UNKNOWN_OPCODES = (0x00, 0x10, 0x7F, 0x80, 0xFF)
BAG_MAGIC = b"#ROSBAG V2.0\n"
_LENGTH = struct.Struct("<I")


P = TypeVar("P", bound=mcap_file.Packable)


class Piece(NamedTuple):
    """Bytes in the place of a record."""

    data: bytes

    def packed(self) -> bytes:
        """Return the bytes."""
        return self.data


def rearranged(rng: random.Random, records: Sequence[P]) -> tuple[str, list[P]]:
    """Drop, double or move some of several records.

    Args:
        rng: The source of randomness.
        records: The records.

    Returns:
        What was done, and the records.
    """
    found = list(records)
    at, to = rng.randrange(len(found)), rng.randrange(len(found))
    how = rng.choice(("dropped", "doubled", "moved", "swapped", "shuffled"))
    if how == "dropped":
        del found[at]
    elif how == "doubled":
        found.insert(at, found[at])
    elif how == "moved":
        found.insert(to, found.pop(at))
    elif how == "swapped":
        found[at], found[to] = found[to], found[at]
    else:
        rng.shuffle(found)
    return f"record {at} {how}" + (f" to {to}" if how in ("moved", "swapped") else ""), found


def _unknown(rng: random.Random, records: list[mcap_file.Record]) -> tuple[str, list[Any]]:
    at, opcode = rng.randrange(len(records)), rng.choice(UNKNOWN_OPCODES)
    if rng.random() < 0.5:
        records.insert(at, mcap_file.Record(opcode, rng.randbytes(rng.randrange(64))))
        return f"a record of opcode {opcode:#x} before record {at}", records
    records[at] = records[at]._replace(opcode=opcode)
    return f"record {at} has opcode {opcode:#x}", records


def _lying_length(rng: random.Random, records: list[Any]) -> tuple[str, list[Any]]:
    at = rng.randrange(len(records))
    packed = bytearray(records[at].packed())
    _, right = mcap_file.PREFIX.unpack_from(packed)
    length = wild_size(rng, right)
    struct.pack_into("<Q", packed, 1, length)
    records[at] = Piece(bytes(packed))
    return f"record {at} claims {length} bytes", records


def wild_size(rng: random.Random, right: int, bits: int = 64) -> int:
    """Return a size, offset or time that is near the right one, or far from it.

    Args:
        rng: The source of randomness.
        right: The right one.
        bits: Of its field.

    Returns:
        A number that fits into the field.
    """
    near = (right - 1, right + 1, right // 2, right * 2, right + rng.randrange(-200, 200), rng.randrange(right + 1))
    far = (0, 1, 1 << 20, 1 << 30, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 40, 1 << 62, 1 << 63, (1 << 64) - 1)
    return rng.choice(rng.choice((near, far))) % (1 << bits)


def damaged_mcap_records(rng: random.Random, samples: Samples) -> Case:
    """Damage the records of an MCAP file, at its top level or in a chunk, whose CRC is made right again.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    sample = rng.choice(samples.mcaps())
    size = len(mcap_file.MAGIC)
    records: list[Any] = mcap_file.split(sample.data[size:-size])
    chunks = [k for k, record in enumerate(records) if record.opcode == Opcode.CHUNK]
    change = rng.choice((rearranged, rearranged, _unknown, _lying_length))
    if chunks and rng.random() < 0.5:
        at = rng.choice(chunks)
        what, chunk = _with_changed_chunk(rng, records[at], change)
        what, data = f"in chunk {at}, {what}", with_record(sample, records, at, chunk)
    else:
        what, records = change(rng, records)
        data = mcap_file.MAGIC + mcap_file.join(records) + mcap_file.MAGIC
    counts = "unindexed" not in sample.name
    return Case(f"{sample.name}: {what}", {"log.mcap": data}, sample.name if counts else "")


def _with_changed_chunk(rng: random.Random, record: mcap_file.Record, change: Callable[..., Any]) -> Any:
    chunk = mcap_file.decode(record)
    what, records = change(rng, mcap_file.split(mcap_file.unpacked(chunk)))
    return what, mcap_file.repacked(chunk, records)


def with_record(sample: Sample, records: list[mcap_file.Record], at: int, chunk: Any) -> bytes:
    """Put another chunk into an MCAP file, and move the offsets in its summary if it has one.

    Args:
        sample: The file.
        records: Its records.
        at: Which one is replaced.
        chunk: The chunk.

    Returns:
        The file.
    """
    replaced = mcap_file.encode(chunk)
    start = len(mcap_file.MAGIC) + len(mcap_file.join(records[:at]))
    moved = len(replaced.body) - len(records[at].body)
    if not any(record.opcode == Opcode.STATISTICS for record in records):
        records[at] = replaced
        return mcap_file.MAGIC + mcap_file.join(records) + mcap_file.MAGIC
    data, summary = mcap_file.take_apart(sample.data)
    end = start + mcap_file.PREFIX.size + len(records[at].body)
    data = data[:start] + replaced.packed() + data[end:]
    return mcap_file.put_together(data, [_moved(record, start, moved, chunk) for record in summary])


def _moved(record: mcap_file.Record, start: int, moved: int, chunk: Any) -> mcap_file.Record:
    """Return an index whose offsets beyond a byte are moved; that of the chunk there says its new sizes."""

    def at(offset: int) -> int:
        return offset + moved if offset > start else offset

    if record.opcode == Opcode.CHUNK_INDEX:
        index = mcap_file.decode(record)
        offsets = {channel: at(offset) for channel, offset in index.message_index_offsets.items()}
        if index.chunk_start_offset == start:
            index.chunk_length += moved
            index.compressed_size, index.uncompressed_size = len(chunk.data), chunk.uncompressed_size
        place = at(index.chunk_start_offset)
        return mcap_file.encode(replace(index, chunk_start_offset=place, message_index_offsets=offsets))
    if record.opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
        index = mcap_file.decode(record)
        return mcap_file.encode(replace(index, offset=at(index.offset)))
    return record


class BagRecord(NamedTuple):
    """A record of a ROS 1 bag (wiki.ros.org/Bags/Format/2.0).

    Attributes:
        fields: Its header's fields, in their order.
        data: Its data.
    """

    fields: tuple[tuple[bytes, bytes], ...]
    data: bytes

    def packed(self) -> bytes:
        """Return its bytes."""
        header = b"".join(_LENGTH.pack(len(n) + 1 + len(v)) + n + b"=" + v for n, v in self.fields)
        return _LENGTH.pack(len(header)) + header + _LENGTH.pack(len(self.data)) + self.data

    def of(self, name: bytes) -> bytes:
        """Return a field."""
        return dict(self.fields)[name]

    def replaced(self, name: bytes, value: bytes) -> BagRecord:
        """Return the record with another value of a field."""
        return self._replace(fields=tuple((n, value if n == name else v) for n, v in self.fields))


BAG_PACKERS = {b"none": bytes, b"bz2": bz2.compress, b"lz4": lz4.frame.compress}
BAG_UNPACKERS = {b"none": bytes, b"bz2": bz2.decompress, b"lz4": lz4.frame.decompress}
CHUNK_OP = b"\x05"


def split_bag(data: bytes) -> list[BagRecord]:
    """Split the bytes behind a bag's magic, or those of a chunk, into records."""
    records, at = [], 0
    while at < len(data):
        header, at = _prefixed(data, at)
        body, at = _prefixed(data, at)
        fields, place = [], 0
        while place < len(header):
            field, place = _prefixed(header, place)
            name, _, value = field.partition(b"=")
            fields.append((name, value))
        records.append(BagRecord(tuple(fields), body))
    return records


def _prefixed(data: bytes, at: int) -> tuple[bytes, int]:
    start = at + _LENGTH.size
    end = start + _LENGTH.unpack_from(data, at)[0]
    return data[start:end], end


def _lying_bag_length(rng: random.Random, records: list[Any]) -> tuple[str, list[Any]]:
    at = rng.randrange(len(records))
    packed = bytearray(records[at].packed())
    header = _LENGTH.unpack_from(packed)[0]
    place = rng.choice((0, _LENGTH.size, _LENGTH.size + header))
    length = wild_size(rng, _LENGTH.unpack_from(packed, place)[0], 32)
    _LENGTH.pack_into(packed, place, length)
    records[at] = Piece(bytes(packed))
    return f"record {at} claims {length} at its byte {place}", records


def _changed_field(rng: random.Random, records: list[Any]) -> tuple[str, list[Any]]:
    at = rng.randrange(len(records))
    name, value = rng.choice(records[at].fields)
    if len(value) in (4, 8) and rng.random() < 0.8:
        right = int.from_bytes(value, "little")
        changed = wild_size(rng, right, 8 * len(value)).to_bytes(len(value), "little")
    else:
        changed = rng.choice((b"", value[:-1], value + b"\0", rng.randbytes(len(value)), b"\x1b[2J", b"\x09"))
    records[at] = records[at].replaced(name, changed)
    return f"record {at} has {name.decode()} = {changed.hex()}", records


def _changed_data(rng: random.Random, records: list[Any]) -> tuple[str, list[Any]]:
    at = rng.choice([k for k, record in enumerate(records) if record.data])
    data = bytearray(records[at].data)
    place = rng.randrange(max(1, len(data) // 4)) * 4
    word = data[place : place + 4]
    data[place : place + 4] = wild_size(rng, int.from_bytes(word, "little"), 8 * len(word)).to_bytes(
        len(word), "little"
    )
    records[at] = records[at]._replace(data=bytes(data))
    return f"record {at} has {data[place : place + 4].hex()} at byte {place} of its data", records


def damaged_bag_records(rng: random.Random, samples: Samples) -> Case:
    """Damage the records of a ROS 1 bag, at its top level or in a chunk.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    sample = rng.choice(samples.bags())
    records: list[Any] = split_bag(sample.data[len(BAG_MAGIC) :])
    change = rng.choice((rearranged, _lying_bag_length, _changed_field, _changed_data))
    chunks = [k for k, record in enumerate(records) if record.of(b"op") == CHUNK_OP]
    is_payload = change is _changed_data
    if rng.random() < 0.4:
        at = rng.choice(chunks)
        compression = records[at].of(b"compression")
        what, inner = change(rng, split_bag(BAG_UNPACKERS[compression](records[at].data)))
        data = b"".join(record.packed() for record in inner)
        what = f"in record {at}, {what}"
        chunk = records[at].replaced(b"size", _LENGTH.pack(len(data)))
        records[at] = chunk._replace(data=BAG_PACKERS[compression](data))
        is_payload |= change is _changed_field  # times and connections of messages
    else:
        what, records = change(rng, records)
    data = BAG_MAGIC + b"".join(record.packed() for record in records)
    return Case(f"{sample.name}: {what}", {"log.bag": data}, "" if is_payload else sample.name)


def damaged_records(rng: random.Random, samples: Samples) -> Case:
    """See :func:`damaged_mcap_records` and :func:`damaged_bag_records`."""
    return rng.choice((damaged_mcap_records, damaged_mcap_records, damaged_bag_records))(rng, samples)
