"""MCAP files whose summary and indexes lie, with CRCs that are right."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

from mcap.opcode import Opcode

from bench.fuzzing import mcap_file
from bench.fuzzing.case import Case
from bench.fuzzing.mcap_file import Record
from bench.fuzzing.records import wild_size
from bench.fuzzing.samples import Samples

TEXTS = (
    "",
    "/scan",
    "/odom",
    "world.json",
    "prim",
    "cdr",
    "zstd",
    "lz4",
    "none",
    "é" * 300,
    "\x1b]0;x\x07\u202e",
    "x" * 70000,
)
"""What texts are changed to, beside those of other records."""

WIDTHS = (64, 32, 16, 8)
"""Of fields (bits), widest first: a number is cut to the first that it fits into."""


def lying_summary(rng: random.Random, samples: Samples) -> Case:
    """Let the summary of an MCAP file, or an index of messages, say something else.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    sample = rng.choice(samples.indexed_mcaps())
    data, records = mcap_file.take_apart(sample.data)
    lie = rng.choices((_changed_record, _rearranged, _swapped_values, _footer, _message_index), (8, 3, 2, 1, 3))[0]
    what, file = lie(rng, data, records)
    return Case(f"{sample.name}: {what}", {"log.mcap": file}, sample.name if sample.is_checked else "")


def changed(rng: random.Random, record: Record, others: list[Record]) -> tuple[str, Record]:
    """Change one field of a record, to a value of another record of its kind or to a wild one.

    Args:
        rng: The source of randomness.
        record: The record.
        others: Records of any kinds.

    Returns:
        What was changed, and the record.
    """
    value = mcap_file.decode(record)
    name = rng.choice([field.name for field in fields(value)])
    before = getattr(value, name)
    same = [getattr(mcap_file.decode(other), name) for other in others if other.opcode == record.opcode]
    different = [other for other in same if other != before]
    after = rng.choice(different) if different and rng.random() < 0.5 else _changed_value(rng, before)
    what = f"{type(value).__name__}.{name} = {str(after)[:60]!r} (was {str(before)[:60]!r})"
    return what, _packed(value, name, after)


def _packed(value: Any, name: str, after: Any) -> Record:
    """Return a record with another value of a field, cut to as many bits as the field has."""
    for bits in WIDTHS:
        number = after % (1 << bits) if isinstance(after, int) else after
        try:
            return mcap_file.encode(replace(value, **{name: number}))
        except struct.error:
            if not isinstance(after, int):
                break
    return mcap_file.encode(value)


def _changed_value(rng: random.Random, before: Any) -> Any:
    if isinstance(before, int):
        return wild_size(rng, before)
    if isinstance(before, str):
        return rng.choice((*TEXTS, before[:-1], before + "x", before.upper()))
    if isinstance(before, bytes):
        return rng.choice((b"", before[:-1], before[: len(before) // 2], b"\xff" * 20))
    if isinstance(before, dict):
        return _changed_map(rng, dict(before))
    return before


def _changed_map(rng: random.Random, entries: dict[Any, Any]) -> dict[Any, Any]:
    how = rng.choice(("empty", "dropped", "added", "changed", "swapped"))
    if how == "empty" or not entries:
        return {}
    key = rng.choice(list(entries))
    if how == "dropped":
        del entries[key]
    elif how == "added":
        new = rng.randrange(1 << 16) if isinstance(key, int) else rng.choice(TEXTS)
        entries[new] = entries[key]
    elif how == "changed":
        entries[key] = _changed_value(rng, entries[key])
    else:
        other = rng.choice(list(entries))
        entries[key], entries[other] = entries[other], entries[key]
    return entries


def _changed_record(rng: random.Random, data: bytes, records: list[Record]) -> tuple[str, bytes]:
    kind = rng.choice(sorted({record.opcode for record in records}))
    at = rng.choice([k for k, record in enumerate(records) if record.opcode == kind])
    what, records[at] = changed(rng, records[at], records)
    return what, mcap_file.put_together(data, records)


def _rearranged(rng: random.Random, data: bytes, records: list[Record]) -> tuple[str, bytes]:
    """Leave an entry out, double it, or leave out all of its kind."""
    kind = rng.choice(sorted({record.opcode for record in records}))
    at = rng.choice([k for k, record in enumerate(records) if record.opcode == kind])
    name = mcap_file.CLASSES[kind].__name__
    how = rng.choice(("left out", "doubled", "moved to the front", "all left out", "all doubled"))
    if how == "left out":
        del records[at]
    elif how == "doubled":
        records.insert(at, records[at])
    elif how == "moved to the front":
        records.insert(0, records.pop(at))
    elif how == "all left out":
        records = [record for record in records if record.opcode != kind]
    else:
        records = [twin for record in records for twin in [record] * (1 + (record.opcode == kind))]
    return f"{name} {how}", mcap_file.put_together(data, records)


def _swapped_values(rng: random.Random, data: bytes, records: list[Record]) -> tuple[str, bytes]:
    """Exchange a field of two records of a kind: types, topics, offsets."""
    kinds = [record.opcode for record in records]
    kind = rng.choice([opcode for opcode in sorted(set(kinds)) if kinds.count(opcode) > 1])
    first, second = rng.sample([k for k, opcode in enumerate(kinds) if opcode == kind], 2)
    a, b = mcap_file.decode(records[first]), mcap_file.decode(records[second])
    name = rng.choice([field.name for field in fields(a)])
    one, other = getattr(a, name), getattr(b, name)
    records[first] = mcap_file.encode(replace(a, **{name: other}))
    records[second] = mcap_file.encode(replace(b, **{name: one}))
    what = f"{type(a).__name__}.{name} of two entries swapped: {str(one)[:40]!r} and {str(other)[:40]!r}"
    return what, mcap_file.put_together(data, records)


def _footer(rng: random.Random, data: bytes, records: list[Record]) -> tuple[str, bytes]:
    """Let the footer or a record of offsets say something else."""
    begin = len(data)
    offsets = mcap_file.right_offsets(begin, records)
    if rng.random() < 0.5:
        at = rng.randrange(len(offsets))
        what, offsets[at] = changed(rng, offsets[at], offsets)
        return what, mcap_file.put_together(data, records, offsets)
    start, beyond = begin, begin + len(mcap_file.join(records))
    if rng.random() < 0.5:
        start = rng.choice((0, 1, 8, wild_size(rng, start), beyond))
    else:
        beyond = rng.choice((0, 1, start, wild_size(rng, beyond)))
    what = f"Footer: summary at {start} (was {begin}), offsets at {beyond}"
    return what, mcap_file.put_together(data, records, offsets, (start, beyond))


def _message_index(rng: random.Random, data: bytes, records: list[Record]) -> tuple[str, bytes]:
    """Change an entry of an index of messages, which no CRC covers."""
    places = _message_indexes(data)
    if not places:
        return _changed_record(rng, data, records)
    at = rng.choice(places)
    count = (mcap_file.PREFIX.unpack_from(data, at)[1] - 6) // 16
    body = at + mcap_file.PREFIX.size
    changed_data = bytearray(data)
    if count and rng.random() < 0.8:
        entry = body + 6 + 16 * rng.randrange(count) + 8 * rng.randrange(2)
        before = struct.unpack_from("<Q", data, entry)[0]
        after = wild_size(rng, before)
        struct.pack_into("<Q", changed_data, entry, after)
        what = f"entry at byte {entry}: {after} (was {before})"
    else:
        after = rng.choice((0, 1, 2, 3, 255, 65535))
        struct.pack_into("<H", changed_data, body, after)
        what = f"channel {after}"
    return f"MessageIndex at {at}, {what}", mcap_file.put_together(bytes(changed_data), records)


def _message_indexes(data: bytes) -> list[int]:
    places, at = [], len(mcap_file.MAGIC)
    while at < len(data):
        opcode, length = mcap_file.PREFIX.unpack_from(data, at)
        if opcode == Opcode.MESSAGE_INDEX:
            places.append(at)
        at += mcap_file.PREFIX.size + length
    return places


Lie = Callable[[random.Random, bytes, list[Record]], tuple[str, bytes]]
