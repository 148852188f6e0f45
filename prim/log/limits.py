"""How much a log may claim: bounded by the size of its file, so that a small one can do no harm."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LogLimits:
    """What a log may take, each as so much whatever its file's size, and so much for each byte of it; set by hand.

    With these, reading a file of N MB takes less than 600 + 4 N MB of memory. Its size is that of the file as the
    user gave it: packed, where it is compressed.

    Attributes:
        piece_base: The largest piece (chunk, message, row, messages that wait to be sorted) that is unpacked at once
            (bytes).
        piece_growth: And for each byte of the file.
        unpacked_base: What the whole of it unpacks to (bytes): a short log of a scanner that sees nothing does.
        unpacked_growth: And for each byte of the file: what scanners measure becomes about 2 to 20 times as large, a
            simulated robot that stands still without noise about 100 times. DEFLATE's bound is 1032, zstd's 2^15.
        records_base: The number of records (messages, lines, rows).
        bytes_per_record: And one for each so many bytes of the file: log times, numbers and stamps differ from one to
            the next, however well they are packed.
    """

    piece_base: int = 32 << 20
    piece_growth: int = 1
    unpacked_base: int = 64 << 20
    unpacked_growth: int = 256
    records_base: int = 50_000
    bytes_per_record: int = 4


LIMITS = LogLimits()

ROW_LIMITS = LogLimits(bytes_per_record=16)
"""For lines of text, rows of a database and records of ROS 1 bags: each takes 10 to 25 us to be read, and to be
rejected where it is none, and 16 bytes at least where it is a message."""


def memory_limit(file_bytes: int, limits: LogLimits = LIMITS) -> int:
    """Return the size of the largest piece of a log that is unpacked or held at once.

    Args:
        file_bytes: The size of the file (bytes).
        limits: What is allowed.

    Returns:
        The limit (bytes).
    """
    return limits.piece_base + limits.piece_growth * file_bytes


def unpacked_limit(file_bytes: int, limits: LogLimits = LIMITS) -> int:
    """Return how much the whole of a log may unpack to.

    Args:
        file_bytes: The size of the file (bytes).
        limits: What is allowed.

    Returns:
        The limit (bytes).
    """
    return limits.unpacked_base + limits.unpacked_growth * file_bytes


def records_limit(file_bytes: int, limits: LogLimits = LIMITS) -> int:
    """Return how many records a log may have.

    Args:
        file_bytes: The size of the file (bytes).
        limits: What is allowed.

    Returns:
        The limit.
    """
    return limits.records_base + file_bytes // limits.bytes_per_record


def megabytes(count: int) -> str:
    """Return a number of bytes as messages quote it."""
    return f"{count / 1e6:,.0f} MB" if count >= 1e6 else f"{count:,} bytes"
