"""Interruptions, by Ctrl-C or a request to terminate: held back while something is made that must not be torn."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType, TracebackType
from typing import Any, TypeVar

from prim.errors import InterruptedRunError

Item = TypeVar("Item")

SIGNALS = tuple(signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""What interrupts a command: Ctrl-C; what ``kill``, containers and job queues send; a terminal that is closed."""

HELD_BACK = b"interrupted: finishing what was begun; Ctrl-C again ends at once\n"


class Interruption(KeyboardInterrupt):
    """An interruption of a command.

    Attributes:
        exit_code: 128 and the number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.exit_code = 128 + number


class Interrupts:
    """Raises an :class:`Interruption` when a signal asks the process to end, unless it is held back.

    It acts while it is used as a context manager, in the main thread of a process. Otherwise Python's own
    KeyboardInterrupt is raised wherever it comes, and all of this has no effect.

    Attributes:
        active: Whether it acts.
        exit_code: 128 and the number of the last signal; None before there was one.
    """

    def __init__(self) -> None:
        self.active = False
        self.exit_code: int | None = None
        self._is_held = False
        self._pending = False
        self._process = 0
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._process = os.getpid()
            for number in SIGNALS:
                if signal.getsignal(number) != signal.SIG_IGN:  # as nohup and shells set it for a background job
                    self._previous[number] = signal.signal(number, self._receive)
            self.active = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()
        self.active = False

    def _receive(self, number: int, frame: FrameType | None) -> None:
        """Raise an interruption, or remember it where the first one is held back."""
        if os.getpid() != self._process:  # a worker that was just forked
            os._exit(128 + number)
        self.exit_code = 128 + number
        if self._is_held and not self._pending:
            self._pending = True
            line = b"\n" + HELD_BACK if os.isatty(2) else HELD_BACK  # below ^C, or a progress bar
            _write_error(line)
            return
        self._pending = True  # until it is handled: what calls Python from C drops exceptions
        raise Interruption(number)

    def handled(self) -> None:
        """Forget the last interruption: what it asked for is done."""
        self._pending = False

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold interruptions back while a context lasts; one that came is raised at its end, a second one at once."""
        with self._holding(True):
            yield

    @contextmanager
    def released(self) -> Iterator[None]:
        """Let interruptions come while a context lasts, within one that holds them back."""
        with self._holding(False):
            yield

    @contextmanager
    def _holding(self, is_held: bool) -> Iterator[None]:
        before, self._is_held = self._is_held, is_held
        try:
            self._raise_pending()
            yield
        finally:
            self._is_held = before
        self._raise_pending()

    def _raise_pending(self) -> None:
        if self._pending and not self._is_held:
            raise Interruption((self.exit_code or 128 + signal.SIGINT) - 128)

    def released_while_iterating(self, items: Iterable[Item]) -> Iterator[Item]:
        """Iterate within a context that holds interruptions back, and let them come while the next item is made.

        Args:
            items: What is iterated over.

        Yields:
            The items.
        """
        iterator = iter(items)
        while True:
            with self.released():
                try:
                    item = next(iterator)
                except StopIteration:
                    return
            yield item


def interrupted_run(error: KeyboardInterrupt, what: str) -> InterruptedRunError:
    """Return the expected error of a run that was interrupted.

    Args:
        error: What interrupted it.
        what: What is left of it.

    Returns:
        The error.
    """
    exit_code = error.exit_code if isinstance(error, Interruption) else 128 + signal.SIGINT
    return InterruptedRunError(f"interrupted: {what}", exit_code)


def end_when_interrupted(name: str) -> None:
    """Let an interruption end this process by one line at once, until :class:`Interrupts` act: nothing is made yet.

    No exception is raised, for what is being loaded may drop it, or make another one of it.

    Args:
        name: The command's name.
    """

    def end(number: int, frame: FrameType | None) -> None:
        _write_error(f"{name}: error: interrupted\n".encode())
        os._exit(128 + number)

    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, end)


def _write_error(line: bytes) -> None:
    """Write a line to stderr from a signal's handler, where print() may be running; nobody may read it any more."""
    with suppress(OSError):
        os.write(2, line)
