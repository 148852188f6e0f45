"""Worker processes that run a command again and again, and measure what it prints, takes and leaves."""

from __future__ import annotations

import hashlib
import json
import math
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NoReturn

from bench.fuzzing.case import MEGABYTE, Case
from bench.fuzzing.judge import LIMITS, LISTING, Limits, Outcome, is_slow

Command = Callable[[list[str]], int]
"""What is fuzzed: takes arguments, returns an exit code. Workers import it by its name."""

OUTPUTS = {"--map": "out/m", "--trajectory": "out/t.tum", "--report": "out/r.json"}
COMPARED = ("m.pgm", "t.tum")
PRINTED = 1 << 26
"""So much of what is printed is judged (bytes)."""
KILOBYTE = 1024
"""The unit of Linux's figures of memory (bytes)."""
HEADROOM = 1024.0
"""What a worker may take beyond the limit before the system refuses it (MB)."""
OLD_AFTER, OLD_MEGABYTES = 1000, 450.0
"""A worker is replaced when it has run so many cases, or has taken so much memory (MB), some of which it may keep."""


def replay_command(arguments: list[str]) -> int:
    """Run prim-replay in this process; it returns the exit code."""
    from prim import console
    from replay.cli import app, join_bounds

    return console.run(app, "prim-replay", join_bounds(arguments))


class Worker:
    """A process that runs a command on one case after the other.

    Args:
        command: The command.
        warm_up: Cases that it runs before others, so that compilation and imports count for none.
        limits: What a run may take.
    """

    def __init__(self, command: Command, warm_up: Sequence[Case] = (), limits: Limits = LIMITS) -> None:
        self._command, self._warm_up, self._limits = command, warm_up, limits
        self._folder = TemporaryDirectory(prefix="prim-fuzz-", ignore_cleanup_errors=True)
        self._process: Any = None
        self._connection: Any = None
        self._runs = 0
        self.peak = 0.0

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *exception: object) -> None:
        self._end()
        self._folder.cleanup()

    def run(self, case: Case, options: tuple[str, ...] = ()) -> Outcome:
        """Run the command on a case.

        Args:
            case: The case.
            options: Options beside the case's own.

        Returns:
            What it did.
        """
        if self._process is None or self._runs >= OLD_AFTER or self.peak > OLD_MEGABYTES:
            self._start()
        outcome = self._run(case, options)
        if is_slow(case, outcome, self._limits) and not outcome.ending:
            outcome = self._run(case, options)  # what was compiled the first time is compiled now
        if outcome.ending:
            self._end()
        self._runs += 1
        self.peak = max(self.peak, outcome.megabytes)
        return outcome

    def _start(self) -> None:
        """Start a process and warm it up; a second one, where the first one compiled much."""
        self._begin()
        if self.peak > OLD_MEGABYTES:
            self._begin()
            self.peak = 0.0

    def _begin(self) -> None:
        self._end()
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, self._command, self._folder.name), daemon=True)
        self._process.start()
        theirs.close()
        self._runs, self.peak = 0, 0.0
        for case in self._warm_up:
            self.peak = self._run(case, (), math.inf).megabytes

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._connection.close()
            self._process = None

    def _run(self, case: Case, options: tuple[str, ...], patience: float | None = None) -> Outcome:
        """Run a case, and give up where it takes much more than it may."""
        patience = self._limits.patience if patience is None else patience
        seconds = patience + self._limits.time(case.megabytes)
        memory = math.inf if math.isinf(patience) else self._limits.memory(case.megabytes) + HEADROOM
        place = Path(self._folder.name)
        _write(place, case)
        self._connection.send((_arguments(case, options), options, seconds, memory))
        waited = self._limits.wall_seconds + 3 * seconds
        wait([self._connection, self._process.sentinel], None if math.isinf(waited) else waited)
        with suppress(EOFError, ConnectionResetError):
            if self._connection.poll():
                outcome: Outcome = self._connection.recv()
                return outcome
        return Outcome(options, self._ending(seconds))

    def _ending(self, seconds: float) -> str:
        self._process.join(1.0)
        code = self._process.exitcode
        if code is None:
            return f"no end within {self._limits.wall_seconds:.0f} s"
        if code == -signal.SIGXCPU:
            return f"no end within {seconds:.1f} s of CPU time"
        return f"its process ended: {signal.Signals(-code).name if code < 0 else code}"


def _arguments(case: Case, options: tuple[str, ...]) -> list[str]:
    if LISTING in options:
        return [case.log, *options]
    return [case.log, *(word for pair in OUTPUTS.items() for word in pair), *case.options, *options]


def _write(place: Path, case: Case) -> None:
    """Put a case's files into an empty folder, and an empty folder for outputs beside them."""
    for old in place.iterdir():
        if old.name not in ("stdout", "stderr"):
            shutil.rmtree(old) if old.is_dir() else old.unlink()
    (place / "out").mkdir()
    for name, data in case.files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(data)


def serve(connection: Connection, command: Command, folder: str) -> NoReturn:
    """Run what the connection asks for, in a folder, to the end of the connection.

    Args:
        connection: Gives arguments, options to report, CPU time (s) and memory (MB); takes outcomes.
        command: The command.
        folder: Where it runs.
    """
    os.chdir(folder)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for stream, number in ((sys.stdout, 1), (sys.stderr, 2)):
        stream.flush()
        os.dup2(os.open(("stdout", "stderr")[number - 1], os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
    while True:
        try:
            arguments, options, seconds, memory = connection.recv()
        except EOFError:
            sys.exit()
        connection.send(_measured(command, arguments, options, seconds, memory))


def _measured(
    command: Command, arguments: list[str], options: tuple[str, ...], seconds: float, memory: float
) -> Outcome:
    """Run a command and return what it did; where it takes too much time, the system ends this process."""
    for number in (1, 2):
        os.ftruncate(number, 0)
        os.lseek(number, 0, os.SEEK_SET)
    is_reset = _reset_peak()
    before, began = _peak(), time.process_time()
    _limit(began + seconds, memory)
    code, ending = 0, ""
    try:
        code = command(arguments)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException as error:  # what the command should have caught
        ending = f"an unexpected exception: {type(error).__name__}: {error}"
    taken = time.process_time() - began
    _limit(math.inf, math.inf)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    after = _peak()
    printed, errors = (_text(name) for name in ("stdout", "stderr"))
    report, content = _results(code, printed, LISTING in options)
    megabytes = after if is_reset or after > before else 0.0
    return Outcome(options, ending, code, printed, errors, report, content, taken, megabytes)


def _reset_peak() -> bool:
    """Let the system measure the peak of memory anew; return whether it can."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def _peak() -> float:
    """Return this process' peak memory (MB): where the system says it, without that of the process that began it."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * KILOBYTE / MEGABYTE
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KILOBYTE / MEGABYTE


def _limit(seconds: float, megabytes: float) -> None:
    """Let the system end this process at a CPU time (s), and refuse it ``megabytes`` beside what it has."""
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(
        resource.RLIMIT_CPU, (resource.RLIM_INFINITY if math.isinf(seconds) else math.ceil(seconds), hard)
    )
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    if math.isinf(megabytes):
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, hard))
        return
    with suppress(OSError, ValueError):  # where the system does not say how much there is
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        size = pages * resource.getpagesize() + int(megabytes * MEGABYTE)
        resource.setrlimit(resource.RLIMIT_AS, (size, hard))


def _text(name: str) -> str:
    with Path(name).open("rb") as stream:
        return stream.read(PRINTED).decode("utf-8", "backslashreplace")


def _results(code: int, printed: str, is_listing: bool) -> tuple[str, str]:
    """Return what is wrong with a report, and a digest of the results."""
    if code not in (0, 3):
        return "", ""
    try:
        report = _strict(printed if is_listing else Path("out/r.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        return f"its report is no JSON: {error}", ""
    if is_listing:
        return "", ""
    counts = {key: value for key, value in report["log"].items() if key != "path"}
    digest = hashlib.sha256(json.dumps([counts, report["pose"], report["map"]]).encode())
    for name in COMPARED:
        digest.update((Path("out") / name).read_bytes())
    return "", digest.hexdigest()


def _strict(text: str) -> Any:
    def refuse(name: str) -> NoReturn:
        raise ValueError(f"{name} is no number of JSON")

    return json.loads(text, parse_constant=refuse)
