"""What all commands of prim share: errors as one line without a traceback, exit codes, the progress bar."""

from __future__ import annotations

import gc
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import typer

from prim.errors import PrimError

USAGE = 2
FAILED = 1
INTERRUPTED = 130


def run(app: typer.Typer, name: str, arguments: Sequence[str]) -> int:
    """Run a command line.

    Args:
        app: The command.
        name: Its name, as error messages begin with it.
        arguments: Its arguments.

    Returns:
        The exit code. 0: done; 1: an input that cannot be used, or a bug; 2: usage; 3: done, but part of a log was
        lost; 130: interrupted.
    """
    debug = "--debug" in arguments
    gc.set_threshold(100_000, 50, 50)  # imports make many objects that stay: collecting among them takes 0.4 s
    try:
        code = typer.main.get_command(app)(list(arguments), prog_name=name, standalone_mode=False)
        return _print_line(name, "interrupted", INTERRUPTED) if code == INTERRUPTED else int(code or 0)
    except typer.TyperException as error:
        what = error.format_message().replace("Value error, ", "")
        return _print_line(name, f"{what} (try: {name} --help)", USAGE)
    except PrimError as error:
        return print_error(name, error, debug)
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 - the reader has gone
        return 0
    except Exception as error:
        if debug:
            traceback.print_exc()
        what = f"unexpected {type(error).__name__}: {error}"
        return _print_line(name, f"{what} (this is a bug: --debug shows the traceback)", FAILED)


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
        traceback.print_exception(error)
    return _print_line(name, str(error), error.exit_code)


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


def _print_line(name: str, what: str, code: int) -> int:
    line = " ".join(what.split())
    print(f"{name}: error: {line}", file=sys.stderr)
    return code
