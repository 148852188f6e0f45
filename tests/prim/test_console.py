import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from prim import console

app = typer.Typer()


class Interrupting:
    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)


class HalfMade:
    def __del__(self) -> None:
        raise AttributeError


@app.command()
def interrupted_while_objects_are_deleted(context: typer.Context) -> None:
    """Python drops what is raised in ``__del__``, and prints it."""
    deleted = [Interrupting(), HalfMade()]
    del deleted[0]
    del deleted[0]
    with context.obj.released():
        pytest.fail("the interruption was lost")


def test_an_interruption_that_python_drops_is_raised_again_and_its_consequences_are_not_printed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert console.run(app, "prim", []) == 130
    assert capsys.readouterr() == ("", "prim: error: interrupted\n")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(24, "Too many open files", "a.mcap"), "a.mcap: Too many open files (--debug shows the traceback)"),
        (MemoryError(), "out of memory: a larger --resolution or a part of the log takes less"),
        (
            ImportError("x.so: failed to map segment from shared object"),
            "a library cannot be loaded, it is damaged, ",
        ),
        (KeyError("x"), "unexpected KeyError: 'x' (this is a bug: --debug shows the traceback)"),
    ],
)
def test_what_the_system_refuses_is_no_bug(capsys: pytest.CaptureFixture[str], error: Exception, line: str) -> None:
    failing = typer.Typer()

    @failing.command()
    def fail() -> None:
        raise error

    assert console.run(failing, "prim", []) == 1
    assert capsys.readouterr().err.startswith(f"prim: error: {line}")


PRINTING = """\
import sys, typer
from prim import console
app = typer.Typer()
@app.command()
def command() -> None:
    console.echo("a note", err=True)
    console.print_table([("a", "result")])
    console.echo("more")
console.exit_process(console.run(app, "prim", sys.argv[1:]))
"""


def printed(**streams: object) -> subprocess.CompletedProcess[str]:
    """Run a command that prints a note on stderr and results on stdout."""
    root = Path(__file__).parents[2]
    return subprocess.run(  # type: ignore[call-overload,no-any-return]
        [sys.executable, "-c", PRINTING], cwd=root, text=True, **streams
    )


def test_stderr_that_nobody_reads_or_that_is_full_costs_stdout_nothing() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as gone, Path("/dev/full").open("wb") as full:
        for stderr in (gone, full):
            found = printed(stdout=subprocess.PIPE, stderr=stderr)
            assert (found.returncode, found.stdout) == (0, "a  result\nmore\n")


def test_stdout_that_is_full_is_one_line() -> None:
    with Path("/dev/full").open("wb") as full:
        found = printed(stdout=full, stderr=subprocess.PIPE)
    assert found.returncode == 1
    note, error = found.stderr.splitlines()
    assert note == "a note"
    assert "stdout" in error and "No space left on device" in error
