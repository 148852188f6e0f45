import os
import signal
from collections.abc import Iterator
from contextlib import suppress

import pytest

from prim.interrupts import SIGNALS, Interruption, Interrupts, end_when_interrupted


def interrupt(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


def test_an_interruption_names_its_exit_code() -> None:
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        with Interrupts() as interrupts, pytest.raises(Interruption) as error:
            interrupt(number)
        assert error.value.exit_code == interrupts.exit_code == code


def test_the_handlers_are_restored() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with Interrupts():
        pass
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.fixture
def ignored() -> Iterator[None]:
    """Let the process ignore the signals, as nohup and shells do for a background job."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("ignored")
def test_signals_that_are_ignored_stay_so() -> None:
    end_when_interrupted("prim")
    with suppress(Interruption), Interrupts() as interrupts:
        for number in SIGNALS:
            interrupt(number)
    assert interrupts.exit_code is None


def test_an_interruption_is_held_back_until_the_end_and_a_line_says_so(capfd: pytest.CaptureFixture[str]) -> None:
    done = []
    with Interrupts() as interrupts, pytest.raises(Interruption), interrupts.held():
        interrupt()
        done.append("all")
    assert done == ["all"]
    assert capfd.readouterr().err == "interrupted: finishing what was begun; Ctrl-C again ends at once\n"


def test_an_interruption_is_held_back_where_nobody_reads_stderr() -> None:
    """As of «2>&1 | head»: the reader is gone, and what is held together may not be torn for that."""
    reading, writing = os.pipe()
    os.close(reading)
    before = os.dup(2)
    os.dup2(writing, 2)
    try:
        with Interrupts() as interrupts, pytest.raises(Interruption), interrupts.held():
            interrupt()
            done = True
    finally:
        os.dup2(before, 2)
        for descriptor in (before, writing):
            os.close(descriptor)
    assert done


def test_a_second_interruption_ends_at_once() -> None:
    with Interrupts() as interrupts, pytest.raises(Interruption), interrupts.held():
        interrupt()
        interrupt()
        pytest.fail("the second one was held back as well")


def test_interruptions_come_while_the_next_item_is_made() -> None:
    def items() -> Iterator[int]:
        yield 1
        interrupt()
        pytest.fail("it was held back")

    seen = []
    with Interrupts() as interrupts, pytest.raises(Interruption), interrupts.held():
        seen += list(interrupts.released_while_iterating(items()))
    with Interrupts() as interrupts, interrupts.held():
        seen = list(interrupts.released_while_iterating([1, 2, 3]))
    assert seen == [1, 2, 3]


def test_inactive_interrupts_change_nothing() -> None:
    interrupts = Interrupts()
    with pytest.raises(KeyboardInterrupt), interrupts.held():
        interrupt()
    assert interrupts.exit_code is None
