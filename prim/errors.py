"""The expected errors: those that a user can mend. Any other exception is a bug."""

from __future__ import annotations

from pathlib import Path


class PrimError(Exception):
    """Base of all expected errors; the message is one line: what is wrong, where, and what to do.

    Attributes:
        exit_code: What a command exits with: 2 for usage, 130 for an interruption (128 + SIGINT), else 1.
    """

    exit_code = 1


class UsageError(PrimError):
    """Options that are invalid by themselves or together."""

    exit_code = 2


class LogReadError(PrimError):
    """A log that cannot be read, or that lacks what was asked of it.

    Attributes:
        path: The log.
        what: What is wrong with it.
        hint: What to do about it; may be empty.
    """

    def __init__(self, path: str | Path, what: str, hint: str = "") -> None:
        self.path = str(path)
        self.what = what
        self.hint = hint
        super().__init__(f"{self.path}: {what}" + (f"; {hint}" if hint else ""))


class OutputError(PrimError):
    """A file that cannot be written."""

    def __init__(self, path: str | Path, cause: OSError) -> None:
        self.path = str(path)
        super().__init__(f"{path}: cannot write: {cause.strerror or cause}; choose another place")


class InterruptedRecordingError(PrimError):
    """A recording that was interrupted; the message names the file that holds the recorded part."""

    exit_code = 130


class WorldError(PrimError):
    """A world file that cannot be read or does not describe a world."""
