"""How every command of prim starts and ends: one line per error, no traceback, the exit codes in one place."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

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
    try:
        code = typer.main.get_command(app)(list(arguments), prog_name=name, standalone_mode=False)
        return _complain(name, "interrupted", INTERRUPTED) if code == INTERRUPTED else int(code or 0)
    except typer.TyperException as error:
        return _complain(name, f"{error.format_message()} (try: {name} --help)", USAGE)
    except PrimError as error:
        if debug:
            raise
        return _complain(name, str(error), error.exit_code)
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115 - the reader has gone
        return 0
    except Exception as error:
        if debug:
            raise
        what = f"unexpected {type(error).__name__}: {error}"
        return _complain(name, f"{what} (this is a bug: --debug shows the traceback)", FAILED)


def _complain(name: str, what: str, code: int) -> int:
    line = " ".join(what.split())
    print(f"{name}: error: {line}", file=sys.stderr)
    return code
