"""How every command of prim starts and ends: one line per error, no traceback, the exit codes in one place."""

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
    """Runs a command line and returns its exit code.

    0: done; 1: an input that cannot be used, or a bug; 2: usage; 3: done, but part of a log was lost.
    """
    debug = "--debug" in arguments
    gc.set_threshold(100_000, 50, 50)  # imports make many objects that stay: looking through them takes 0.4 s
    try:
        code = typer.main.get_command(app)(list(arguments), prog_name=name, standalone_mode=False)
        return _complain(name, "interrupted", INTERRUPTED) if code == INTERRUPTED else int(code or 0)
    except typer.TyperException as error:
        what = error.format_message().replace("Value error, ", "")
        return _complain(name, f"{what} (try: {name} --help)", USAGE)
    except PrimError as error:
        return complain(name, error, debug)
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 - the reader has gone
        return 0
    except Exception as error:
        if debug:
            traceback.print_exc()
        what = f"unexpected {type(error).__name__}: {error}"
        return _complain(name, f"{what} (this is a bug: --debug shows the traceback)", FAILED)


def complain(name: str, error: PrimError, debug: bool = False) -> int:
    """Prints an expected error's one line (with ``debug`` its traceback before it); returns its exit code."""
    if debug:
        traceback.print_exception(error)
    return _complain(name, str(error), error.exit_code)


@contextmanager
def progress_bar(what: str, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """A bar on the terminal, to be told what is done and what there is in all; None where nobody looks."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _complain(name: str, what: str, code: int) -> int:
    line = " ".join(what.split())
    print(f"{name}: error: {line}", file=sys.stderr)
    return code
