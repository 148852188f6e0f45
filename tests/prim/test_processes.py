import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from prim.processes import process_pool

ROOT = Path(__file__).parents[2]

COMMAND = """\
import os, sys, time
import typer
from prim import console
from prim.processes import process_pool

app = typer.Typer()

def work(number):
    os.write(1, f"{os.getpid()}\\n".encode())
    time.sleep(60)

@app.command()
def command():
    with process_pool(3) as pool:
        list(pool.map(work, range(30)))

console.exit_process(console.run(app, "prim", []))
"""

INTERRUPTED = "prim: error: interrupted\n"


def is_running(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="reads the kernel's table of processes")
@pytest.mark.parametrize(
    ("number", "code", "line"),
    [(signal.SIGINT, 130, INTERRUPTED), (signal.SIGTERM, 143, INTERRUPTED), (signal.SIGKILL, -9, "")],
)
def test_workers_end_with_their_parent(number: int, code: int, line: str) -> None:
    """Ctrl-C of a terminal goes to all of them; a request to end, or the end itself, to the parent alone."""
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    workers = [int(process.stdout.readline()) for _ in range(3)]
    if number == signal.SIGINT:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    error = process.communicate(timeout=20)[1]
    assert (process.returncode, error) == (code, line)
    for _ in range(100):
        if not any(map(is_running, workers)):
            return
        time.sleep(0.05)
    pytest.fail("workers are still there")


def test_a_failure_gives_up_what_is_not_begun() -> None:
    with pytest.raises(ZeroDivisionError), process_pool(1) as pool:
        futures = [pool.submit(time.sleep, 0.05) for _ in range(20)]
        raise ZeroDivisionError
    assert sum(future.cancelled() for future in futures) > 10
