"""Damages a recorded log in many ways and replays each: it must never crash, hang, or pass off other content.

    python -m bench.fuzz [--cuts 200] [--bytes 2000] [--seed 0]

A cut leaves the first N bytes of the log; a flip changes one byte, half of them in places where length fields stand.
Each damaged log is replayed, and once more with --recover. What is wrong: a traceback or a signal, an error of more
than one line, a replay of more than 20 s, an exit code other than 0, 1 and 3, or exit 0 with another map, other poses
or other counts than the whole log's. Exits with 1 if anything was wrong.
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

SECONDS = 20.0
LENGTH_FIELD = re.compile(rb"[\x00-\xff]{2}\x00\x00")


@dataclass(frozen=True)
class Outcome:
    """What a replay left: exit code, error text, the map's bytes, the poses, and the report's counts."""

    code: int
    error: str
    content: tuple[bytes, bytes, str]
    seconds: float


def replay(log: Path, folder: Path, *options: str) -> Outcome:
    """One replay in this process: a signal that kills it fails the whole run, which is what it should do."""
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
    """What is wrong with an outcome, None if nothing is."""
    errors = [line for line in outcome.error.splitlines() if not line.startswith("note: ")]
    if "Traceback" in outcome.error or "this is a bug" in outcome.error:
        return "a bug shows"
    if outcome.code not in (0, 1, 3):
        return f"exit code {outcome.code}"
    if len(errors) != (outcome.code == 1):
        return f"{len(errors)} error lines with exit code {outcome.code}"
    if outcome.seconds > SECONDS:
        return f"it took {outcome.seconds:.0f} s"
    if outcome.code == 0 and outcome.content != whole.content:
        return "exit code 0 with other content"
    return None


def damaged(data: bytes, cuts: int, flips: int, rng: random.Random) -> list[tuple[str, bytes]]:
    """The damaged logs, each with what was done to it."""
    made = [(f"cut at {at}", data[:at]) for at in sorted(rng.sample(range(len(data)), min(cuts, len(data))))]
    lengths = [match.start() for match in LENGTH_FIELD.finditer(data)]
    for index in range(flips):
        at = rng.choice(lengths) + rng.randrange(4) if index % 2 else rng.randrange(len(data))
        change = rng.randrange(1, 256)
        made.append((f"byte {at} ^ {change:#04x}", data[:at] + bytes([data[at] ^ change]) + data[at + 1 :]))
    return made


def fuzz(folder: Path, cuts: int, flips: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Replays all damaged logs; returns how often each exit code came, and what went wrong."""
    rng = random.Random(seed)
    log = folder / "whole.mcap"
    record_session(log, SessionOptions(seed=seed, stops=(5, 5), lidar=Lidar(rays=24)))
    whole = replay(log, folder)
    assert whole.code == 0, whole.error
    codes: Counter[str] = Counter()
    wrong = []
    bad = folder / "bad.mcap"
    for what, data in damaged(log.read_bytes(), cuts, flips, rng):
        bad.write_bytes(data)
        for options in ((), ("--recover",)):
            outcome = replay(bad, folder, *options)
            codes[f"exit {outcome.code}{' recovering' if options else ''}"] += 1
            found = problem(outcome, whole)
            if found:
                wrong.append(f"{what}{' --recover' if options else ''}: {found}: {outcome.error.strip()[:300]}")
    return codes, wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cuts", type=int, default=200)
    parser.add_argument("--bytes", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        codes, wrong = fuzz(Path(folder), options.cuts, options.bytes, options.seed)
    print(", ".join(f"{name}: {count}" for name, count in sorted(codes.items())))
    for line in wrong:
        print(line)
    print(f"{len(wrong)} of {codes.total()} replays went wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
