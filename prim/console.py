"""What all commands of prim share: text on the terminal, errors as one line, exit codes, the progress bar."""

from __future__ import annotations

import gc
import io
import os
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import NoReturn, TextIO

import typer

from prim.errors import OutputError, PrimError, UsageError
from prim.interrupts import Interrupts
from prim.text import printable

USAGE = 2
FAILED = 1
INTERRUPTED = 130
SIGNALLED = 128
"""Exit codes above this one: 128 and the number of the signal that ended the command."""


def run(app: typer.Typer, name: str, arguments: Sequence[str]) -> int:
    """Run a command line.

    Args:
        app: The command; its context's ``obj`` are the :class:`prim.interrupts.Interrupts` of this run.
        name: Its name, as error messages begin with it.
        arguments: Its arguments.

    Returns:
        The exit code. 0: done; 1: an input that cannot be used, an output that cannot be written, or a bug; 2: usage;
        3: done, but part of a log was lost; 130: interrupted; 143: terminated; 129: its terminal was closed.
    """
    debug = "--debug" in arguments
    gc.set_threshold(100_000, 50, 50)  # imports make many objects that stay: collecting among them takes 0.4 s
    _prepare_streams()
    interrupts = Interrupts()
    with warnings.catch_warnings(), _without_ignored_interruptions(interrupts), interrupts:
        if not sys.warnoptions:
            warnings.simplefilter("ignore")  # numpy's quote lines of source code; what matters is a note or an error
        try:
            code = _run(app, name, arguments, interrupts, debug)
            sys.stdout.flush()
        except KeyboardInterrupt:
            code = _print_line(name, "interrupted", interrupts.exit_code or INTERRUPTED)
        except BrokenPipeError:
            code = _ignore_output()
        except OSError as error:
            _ignore_output()
            code = _print_line(name, f"cannot write to stdout: {error.strerror}", FAILED)
    return code


def _run(app: typer.Typer, name: str, arguments: Sequence[str], interrupts: Interrupts, debug: bool) -> int:
    """Run a command; print its error, if there is one, as one line."""
    try:
        _check_working_folder()
        command = typer.main.get_command(app)
        code = command(list(arguments), prog_name=name, standalone_mode=False, obj=interrupts)
        if code == INTERRUPTED:  # what typer makes of a KeyboardInterrupt
            return _print_line(name, "interrupted", interrupts.exit_code or INTERRUPTED)
        return int(code or 0)
    except typer.TyperException as error:
        what = error.format_message().replace("Value error, ", "")
        return _print_line(name, f"{what} (try: {name} --help)", USAGE)
    except PrimError as error:
        return print_error(name, error, debug)
    except typer.Abort:  # what older versions of typer make of it
        return _print_line(name, "interrupted", interrupts.exit_code or INTERRUPTED)
    except BrokenPipeError:
        raise
    except Exception as error:
        if debug:
            _print_traceback(error)
        if interrupts.exit_code is not None:  # which an extension that was being loaded makes an ImportError of
            return _print_line(name, "interrupted", interrupts.exit_code)
        return _print_line(name, _describe(error), FAILED)


@contextmanager
def _without_ignored_interruptions(interrupts: Interrupts) -> Iterator[None]:
    """Print nothing of an interruption that came where Python is called from C and drops it: it is raised again.

    Nor of what follows from one, as when an object is deleted that was half made, or a thread loses its workers.
    """
    before, before_of_threads = sys.unraisablehook, threading.excepthook

    def report(found: sys.UnraisableHookArgs) -> None:
        if interrupts.exit_code is None and not issubclass(found.exc_type, KeyboardInterrupt):
            before(found)

    def report_of_thread(found: threading.ExceptHookArgs) -> None:
        if interrupts.exit_code is None:
            before_of_threads(found)

    sys.unraisablehook, threading.excepthook = report, report_of_thread
    try:
        yield
    finally:
        sys.unraisablehook, threading.excepthook = before, before_of_threads


def exit_process(code: int) -> NoReturn:
    """End the process with an exit code; at once where it was interrupted.

    An interruption may have come while a library held one of its locks, for which its clean-up would wait for ever.

    Args:
        code: The exit code that :func:`run` returned.
    """
    if code > SIGNALLED:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)
    sys.exit(code)


def _describe(error: Exception) -> str:
    """Describe an error that no part of prim expects: what the system refuses, or a bug."""
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror} (--debug shows the traceback)"
    if isinstance(error, MemoryError):
        return "out of memory: a larger --resolution or a part of the log takes less (--debug shows the traceback)"
    if isinstance(error, ImportError):
        what = "damaged, of another version, or larger than the memory that is allowed"
        return f"a library cannot be loaded, it is {what}: {error} (--debug shows the traceback)"
    return f"unexpected {type(error).__name__}: {error} (this is a bug: --debug shows the traceback)"


def _check_working_folder() -> None:
    """Raise UsageError where the working folder was deleted: no path can be resolved there."""
    try:
        os.getcwd()  # noqa: PTH109 - Path.cwd() would do the same
    except OSError:
        raise UsageError("the working folder does not exist any more: change to another one") from None


def _prepare_streams() -> None:
    """Open the standard streams that are closed, and let them take text that their encoding does not have.

    Else the first file that is opened would get a closed stream's number, and what is printed would go there.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            if descriptor != number:
                os.dup2(descriptor, number)
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper) and number:
            stream.reconfigure(errors="backslashreplace")


def _ignore_output(name: str = "stdout") -> int:
    """Drop what is still to be printed on a stream: nobody reads it, or it has no place."""
    with suppress(OSError):
        getattr(sys, name).close()
    setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115 - to the end of the process
    return 0


def echo(line: str, err: bool = False) -> None:
    """Print a line; what a terminal would obey in it is made visible, see :func:`prim.text.printable`.

    Args:
        line: The line.
        err: Print it on stderr.
    """
    _print(printable(line), sys.stderr if err else sys.stdout)


def _print(text: str, stream: TextIO) -> None:
    """Print text, see :func:`_printing`."""
    with _printing(stream):
        print(text, file=stream)


@contextmanager
def _printing(stream: TextIO) -> Iterator[None]:
    """Say nothing where the reader of stdout has gone, nor where stderr has no place for what is printed.

    Raises:
        OutputError: Stdout has no place for it.
    """
    try:
        yield
    except OSError as error:
        if stream is sys.stderr:
            _ignore_output("stderr")
        elif isinstance(error, BrokenPipeError):
            _ignore_output()
        else:
            raise OutputError("stdout", error) from error


def print_table(rows: Sequence[Sequence[str]], header: Sequence[str] = ()) -> None:
    """Print rows of cells.

    Args:
        rows: The rows.
        header: Names of the columns, which may have several lines; under one, all but the first column hold numbers
            and stand at the right.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=bool(header), box=None, pad_edge=False)
    for name in header:
        table.add_column(name, justify="left" if name == header[0] else "right")
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    console = Console(highlight=False, soft_wrap=True)
    with _printing(sys.stdout), console.capture() as captured:
        console.print(table)
    _print(captured.get().rstrip("\n"), sys.stdout)


def print_error(name: str, error: PrimError, debug: bool = False) -> int:
    """Print an expected error as one line on stderr.

    Args:
        name: The command's name.
        error: The error.
        debug: Print its traceback before.

    Returns:
        The exit code that goes with it.
    """
    if debug:
        _print_traceback(error)
    return _print_line(name, str(error), error.exit_code)


def _print_traceback(error: BaseException) -> None:
    for line in "".join(traceback.format_exception(error)).splitlines():
        echo(line, err=True)


@contextmanager
def progress_bar(label: str, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Show a progress bar on stderr.

    Args:
        label: What is written before the bar.
        quiet: Show none.

    Yields:
        A function that is called with how much is done and how much there is in all; None where no bar is shown:
        when quiet, or where stderr is no terminal.
    """
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def stage_bars(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar on stderr for each stage that has begun.

    Args:
        quiet: Show none.

    Yields:
        A function that is called with a stage's name, how much of it is done, and how much there is in all. It shows
        nothing when quiet, or where stderr is no terminal.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda stage, done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    tasks: dict[str, TaskID] = {}
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:

        def show(stage: str, done: int, total: int) -> None:
            """Show how far a stage is."""
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield show


def _print_line(name: str, what: str, code: int) -> int:
    echo(f"{name}: error: {' '.join(what.split())}", err=True)
    return code
