"""The expected errors: those that a user can mend. Any other exception is a bug."""

from __future__ import annotations

from pathlib import Path
from typing import Any


class PrimError(Exception):
    """Base of all expected errors; the message is one line: what is wrong, where, and what to do.

    Attributes:
        exit_code: What a command exits with: 2 for usage, 128 + the signal for an interruption, else 1.
    """

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        """Let an error come out of a worker process, whatever arguments its class is made with."""
        return _without_init, (type(self), self.args), self.__dict__


def _without_init(kind: type[PrimError], arguments: tuple[Any, ...]) -> PrimError:
    return kind.__new__(kind, *arguments)


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


class InterruptedRunError(PrimError):
    """A recording or a replay that was interrupted; the message says what is left of it.

    Args:
        message: The message.
        exit_code: 128 and the number of the signal.
    """

    def __init__(self, message: str, exit_code: int = 130) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class WorldError(PrimError):
    """A world file that cannot be read or does not describe a world."""
