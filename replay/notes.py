"""Wording of notes and tables."""

from __future__ import annotations


def pluralize(count: int, noun: str) -> str:
    """Return a count with its noun.

    Args:
        count: The number.
        noun: The noun in the singular, whose plural ends with «s».

    Returns:
        Such as «1 scan» or «2 scans».
    """
    return f"{count} {noun}{'' if count == 1 else 's'}"
