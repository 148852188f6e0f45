"""Damage to the bytes of any log: cuts, flips, holes, pieces that are doubled, swapped, inserted or overwritten."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from functools import cache

from bench.fuzzing import mcap_file
from bench.fuzzing.case import Case
from bench.fuzzing.samples import PART, Sample, Samples

LENGTH_FIELD = re.compile(rb"[\x00-\xff]{2}\x00\x00")
"""A small little-endian number of 32 bits."""

HOLES = (16, 56, 512, 4096)
"""Sizes of holes (bytes)."""
LONGEST_PIECE = 2048
"""Of pieces that are doubled, swapped, inserted or overwritten (bytes)."""
SINGLE = 0.75
"""The share of cases with a single damage; others have two or three."""

Change = Callable[[random.Random, bytes], tuple[str, bytes]]


@cache
def _length_fields(data: bytes) -> list[int]:
    return [match.start() for match in LENGTH_FIELD.finditer(data)]


def flip(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    """Change a byte: half of them in what may be lengths."""
    lengths = _length_fields(data) if rng.random() < 0.5 else []
    at = rng.choice(lengths) + rng.randrange(4) if lengths else rng.randrange(len(data))
    change = rng.choice((rng.randrange(1, 256), 1 << rng.randrange(8)))
    return f"byte {at} ^ {change:#04x}", data[:at] + bytes([data[at] ^ change]) + data[at + 1 :]


def cut(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    """Leave out the end."""
    at = rng.choice((rng.randrange(len(data)), max(0, len(data) - rng.randrange(1, 200))))
    return f"cut at {at}", data[:at]


def hole(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    """Fill a piece with zeros."""
    size = rng.choice((*HOLES, rng.randrange(HOLES[0], HOLES[-1])))
    at = rng.randrange(len(data))
    size = min(size, len(data) - at)
    return f"{size} zeros at {at}", data[:at] + bytes(size) + data[at + size :]


def _piece(rng: random.Random, data: bytes) -> tuple[int, bytes]:
    at = rng.randrange(len(data))
    return at, data[at : at + rng.randrange(1, LONGEST_PIECE)]


def double(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    """Repeat a piece."""
    at, piece = _piece(rng, data)
    return f"{len(piece)} bytes at {at} doubled", data[:at] + piece + data[at:]


def swap(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    """Exchange two pieces of the same size."""
    size = rng.randrange(1, min(LONGEST_PIECE, len(data) // 2) + 1)
    first = rng.randrange(len(data) - 2 * size + 1)
    second = rng.randrange(first + size, len(data) - size + 1)
    a, b = data[first : first + size], data[second : second + size]
    what = f"{size} bytes at {first} and {second} swapped"
    return what, data[:first] + b + data[first + size : second] + a + data[second + size :]


def insert(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    """Insert bytes, at random or as they stand elsewhere."""
    _, piece = _piece(rng, data)
    added = rng.choice((piece, rng.randbytes(len(piece)), b"\xff" * len(piece)))
    where = rng.randrange(len(data) + 1)
    return f"{len(added)} bytes inserted at {where}", data[:where] + added + data[where:]


def overwrite(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    """Overwrite a piece by random bytes."""
    at, piece = _piece(rng, data)
    return f"{len(piece)} random bytes at {at}", data[:at] + rng.randbytes(len(piece)) + data[at + len(piece) :]


def remove(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    """Leave out a piece."""
    at, piece = _piece(rng, data)
    return f"{len(piece)} bytes at {at} left out", data[:at] + data[at + len(piece) :]


CHANGES: dict[Change, float] = {
    flip: 5,
    cut: 2,
    hole: 3,
    double: 1,
    swap: 1,
    insert: 1,
    overwrite: 1,
    remove: 1,
}
"""What is done, and how often beside others."""


def damaged_bytes(rng: random.Random, samples: Samples) -> Case:
    """Damage one file of any sample once or a few times.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    sample = rng.choice(list(samples.by_name.values()))
    name = rng.choice(list(sample.files))
    data, done = sample.files[name], []
    changes = rng.choices(
        list(CHANGES), list(CHANGES.values()), k=1 if rng.random() < SINGLE else rng.randrange(2, 4)
    )
    for change in changes:
        if len(data) > 1:
            what, data = change(rng, data)
            done.append(what)
    is_seen = _is_seen(sample, name, data, changes)
    return Case(
        f"{sample.name} {name}: {', '.join(done)}",
        {**sample.files, name: data},
        sample.name if is_seen else "",
        must_recover=sample.name == PART and changes == [hole] and not _hides_magic(data, sample.data),
    )


def _is_seen(sample: Sample, name: str, data: bytes, changes: list[Change]) -> bool:
    """Return whether a reader can see such damage, or that it changes nothing."""
    if name.endswith(".yaml"):
        return False
    if "unindexed" in sample.name and _changes_opcode(sample.files[name], data):
        return False  # a record of a private kind may stand anywhere
    return sample.is_checked or (sample.is_counted and changes == [cut])


def _changes_opcode(before: bytes, after: bytes) -> bool:
    """Return whether the opcode of any record of an MCAP file is another one."""
    at = len(mcap_file.MAGIC)
    while at < len(before) - len(mcap_file.MAGIC):
        _, length = mcap_file.PREFIX.unpack_from(before, at)
        if before[at] != after[at : at + 1][:1][0] if at < len(after) else False:
            return True
        at += mcap_file.PREFIX.size + length
    return False


def _hides_magic(data: bytes, before: bytes) -> bool:
    size = len(mcap_file.MAGIC)
    return data[:size] != before[:size]
