"""How much memory a log may take: bounded by the size of its file, so that a small file cannot claim much."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MemoryLimits:
    """What is unpacked or held of a log at once; set by hand, so that reading N MB takes less than 600 + 4 N MB.

    Attributes:
        base: Whatever the size of the file (bytes).
        growth: And so many bytes for each byte of the file.
    """

    base: int = 32 << 20
    growth: int = 1


LIMITS = MemoryLimits()


def memory_limit(file_bytes: int, limits: MemoryLimits = LIMITS) -> int:
    """Return the largest piece of a log that is unpacked or held at once.

    Args:
        file_bytes: The size of the file as the user gave it: packed, where it is compressed.
        limits: What is allowed.

    Returns:
        The limit (bytes), for a chunk, a record, a row, or messages that wait to be sorted.
    """
    return limits.base + limits.growth * file_bytes


def megabytes(count: int) -> str:
    """Return a number of bytes as messages quote it."""
    return f"{count / 1e6:,.0f} MB" if count >= 1e6 else f"{count:,} bytes"
