"""What reading a log may take, by the size of its file: a small file cannot claim much memory."""

from __future__ import annotations

BASE_BYTES = 32 << 20
GROWTH = 2

UNPACKED_BASE = 64 << 20
"""Compressed logs of any size may unpack to so much (bytes): a short log of a scanner that sees nothing does."""

UNPACKED_GROWTH = 256
"""And to this many times their size: what scanners measure becomes about 2 to 20 times as large, a simulated robot
that stands still without noise about 100 times. DEFLATE's bound is 1032, that of zstd 2^15. What is unpacked costs
time and disk, so that the whole of it has a limit too; at 1 GB/s this one takes 0.3 s for each packed MB."""

RECORDS_BASE, BYTES_A_RECORD = 50_000, 16
"""A log has no more records (messages, lines, rows) than the former and one for each so many bytes of its file. One
that is not compressed cannot exceed that, since a record takes more; one that is needs its time and data."""


def memory_limit(file_bytes: int) -> int:
    """Return the size of the largest piece (chunk, message, record, row) that is unpacked at once, in bytes."""
    return BASE_BYTES + GROWTH * file_bytes


def unpacked_limit(file_bytes: int) -> int:
    """Return how much a whole compressed log may unpack to, in bytes."""
    return UNPACKED_BASE + UNPACKED_GROWTH * file_bytes


def records_limit(file_bytes: int) -> int:
    """Return how many records a log may have."""
    return RECORDS_BASE + file_bytes // BYTES_A_RECORD
