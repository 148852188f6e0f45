"""Text that a log or a file brought along: what may be shown of it."""

from __future__ import annotations


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
