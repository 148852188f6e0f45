import os
import signal

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
