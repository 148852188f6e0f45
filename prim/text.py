"""Text that a log or a file brought along: what may be shown of it."""

from __future__ import annotations

from collections.abc import Iterable

MOST_LISTED = 20
"""A message lists so many names."""

LONGEST_NAME = 100
"""A message cuts names that have more characters."""


def listed(names: Iterable[str]) -> str:
    """Return names as a message lists them: the first of many, and how many more there are.

    Args:
        names: The names.

    Returns:
        The list, separated by commas; empty without names.
    """
    cut = [name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 1]}…" for name in names]
    more = len(cut) - MOST_LISTED
    return ", ".join(cut[:MOST_LISTED]) + (f" and {more:,} more" if more > 0 else "")


def printable(text: str) -> str:
    r"""Return a line of text as it may be shown anywhere.

    A topic's name or a file's may hold anything: line breaks become blanks, and characters that a terminal obeys,
    that change the direction of writing, or that no encoding has are written as escapes, such as ``\x1b``.

    Args:
        text: The text.

    Returns:
        The line, of printable characters alone.
    """
    line = " ".join(text.splitlines()).replace("\t", " ")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
