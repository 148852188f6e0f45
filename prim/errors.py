"""The errors that users cause and can mend; everything else is a bug."""

from __future__ import annotations

from pathlib import Path


class PrimError(Exception):
    """Base of all expected errors: one line that says what is wrong, where, and what to do.

    ``exit_code`` is what a command exits with: 2 for usage, 1 for an input that cannot be used.
    """

    exit_code = 1


class UsageError(PrimError):
    """Options that are impossible by themselves or together."""

    exit_code = 2


class LogReadError(PrimError):
    """A log that cannot be read, or that lacks what was asked of it.

    Carries the ``path``, ``what`` is wrong, and a ``hint`` that says what to do about it.
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
    """A recording that was broken off, and where what was recorded until then lies."""

    exit_code = 130


class WorldError(PrimError):
    """A world file that does not describe a world."""
