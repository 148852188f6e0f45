"""Robustness to damaged logs: no damage may cause a crash, a hang, or wrong content that is passed off as intact.

    python -m bench.fuzz [--cuts 200] [--bytes 2000] [--seed 0]

A cut leaves the first N bytes of the log; a flip changes one byte, half of them within likely length fields. Each
damaged log is replayed twice: plainly, and with --recover. Failures are: a traceback or a signal, an error of more
than one line, a replay of more than 20 s, an exit code other than 0, 1 and 3, or exit code 0 with a map, poses or
counts that differ from the intact log's. Exits with 1 where any replay failed.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import re
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from prim import console
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from replay.cli import app

MAX_SECONDS = 20.0

LENGTH_FIELD = re.compile(rb"[\x00-\xff]{2}\x00\x00")
"""A small little-endian number of 32 bits."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a replay.

    Attributes:
        code: The exit code.
        error: What was printed to stderr.
        content: The map's bytes, the poses, and counts, poses and map of the report.
        seconds: The run time (s).
    """

    code: int
    error: str
    content: tuple[bytes, bytes, str]
    seconds: float


def replay(log: Path, folder: Path, *options: str) -> Outcome:
    """Replay a log in this process: a signal that kills it fails the whole run, as it should.

    Args:
        log: The log.
        folder: Where the outputs go.
        options: Further options of prim-replay.

    Returns:
        The outcome.
    """
    outputs = {name: folder / name for name in ("m.pgm", "m.yaml", "t.tum", "r.json")}
    for path in outputs.values():
        path.unlink(missing_ok=True)
    files = ["--map", str(folder / "m"), "--trajectory", str(outputs["t.tum"]), "--report", str(outputs["r.json"])]
    began = time.perf_counter()
    with contextlib.redirect_stderr(io.StringIO()) as error, contextlib.redirect_stdout(io.StringIO()):
        code = console.run(app, "prim-replay", [str(log), "--mapper", "det", "--no-viewer", *files, *options])
    seconds = time.perf_counter() - began
    content = b"", b"", ""
    if code in (0, 3):
        report = json.loads(outputs["r.json"].read_text())
        counts = {key: value for key, value in report["log"].items() if key != "path"}
        content = (
            outputs["m.pgm"].read_bytes(),
            outputs["t.tum"].read_bytes(),
            json.dumps([counts, report["pose"], report["map"]]),
        )
    return Outcome(code, error.getvalue(), content, seconds)


def problem(outcome: Outcome, whole: Outcome) -> str | None:
    """Return how a replay failed.

    Args:
        outcome: Its outcome.
        whole: The outcome of the intact log.

    Returns:
        The failure; None where there is none.
    """
    errors = [line for line in outcome.error.splitlines() if not line.startswith("note: ")]
    if "Traceback" in outcome.error or "this is a bug" in outcome.error:
        return "an unexpected exception"
    if outcome.code not in (0, 1, 3):
        return f"exit code {outcome.code}"
    if len(errors) != (outcome.code == 1):
        return f"{len(errors)} error lines with exit code {outcome.code}"
    if outcome.seconds > MAX_SECONDS:
        return f"it took {outcome.seconds:.0f} s"
    if outcome.code == 0 and outcome.content != whole.content:
        return "exit code 0 with other content"
    return None


def damaged(data: bytes, cuts: int, flips: int, rng: random.Random) -> list[tuple[str, bytes]]:
    """Damage a log in many ways.

    Args:
        data: The log.
        cuts: Number of cuts.
        flips: Number of flips.
        rng: The source of randomness.

    Returns:
        Pairs of what was done and the damaged log.
    """
    logs = [(f"cut at {at}", data[:at]) for at in sorted(rng.sample(range(len(data)), min(cuts, len(data))))]
    lengths = [match.start() for match in LENGTH_FIELD.finditer(data)]
    for index in range(flips):
        at = rng.choice(lengths) + rng.randrange(4) if index % 2 else rng.randrange(len(data))
        change = rng.randrange(1, 256)
        logs.append((f"byte {at} ^ {change:#04x}", data[:at] + bytes([data[at] ^ change]) + data[at + 1 :]))
    return logs


def fuzz(folder: Path, cuts: int, flips: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Record a log, damage it in many ways, and replay each.

    Args:
        folder: Where all files go.
        cuts: Number of cuts.
        flips: Number of flips.
        seed: Seed of the session and of the damage.

    Returns:
        How often each exit code occurred, and the failures.
    """
    rng = random.Random(seed)
    log = folder / "whole.mcap"
    record_session(log, SessionOptions(seed=seed, stops=(5, 5), lidar=Lidar(rays=24)))
    whole = replay(log, folder)
    assert whole.code == 0, whole.error
    codes: Counter[str] = Counter()
    failures = []
    bad = folder / "bad.mcap"
    for what, data in damaged(log.read_bytes(), cuts, flips, rng):
        bad.write_bytes(data)
        for options in ((), ("--recover",)):
            outcome = replay(bad, folder, *options)
            codes[f"exit {outcome.code}{' recovering' if options else ''}"] += 1
            failure = problem(outcome, whole)
            if failure:
                failures.append(f"{what}{' --recover' if options else ''}: {failure}: {outcome.error.strip()[:300]}")
    return codes, failures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cuts", type=int, default=200)
    parser.add_argument("--bytes", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        codes, failures = fuzz(Path(folder), options.cuts, options.bytes, options.seed)
    print(", ".join(f"{name}: {count}" for name, count in sorted(codes.items())))
    for line in failures:
        print(line)
    print(f"{len(failures)} of {codes.total()} replays failed")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
