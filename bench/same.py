"""Regression check: whether two checkouts give the same results.

    python -m bench.same keep OUT.json [--checkout DIR] [--sessions 20] [--data FOLDER] [--quick]
    python -m bench.same compare BEFORE.json AFTER.json

``keep`` runs a checkout's ``prim-record`` and ``prim-replay``: sessions of all noise levels, each through the three
mappers, with refinement and without; driven sessions with ``--match-scans``, with ``--pose fused`` and with
``--detect-every``; and the logs pillars4.mcap and csail.mcap where they are available. It stores hashes of the
recorded logs, and the reports without timings and paths. ``compare`` prints which differ, and by how much at most; it
exits with 1 where any difference exceeds TOLERANCE. Keys that reports have only afterwards are listed, and are no
difference: the schema lets keys be added.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from prim.choices import MapperName

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
NOISE = (0.0, 0.05, 0.075, 0.1, 0.25, 0.375, 0.5)
FIRST_SEED = 7_000

TOLERANCE = 1e-6
"""Largest difference of numbers that count as equal: relative above 1, absolute below (m, rad)."""

WARM_UP = ("session0", "driven", "fused")
"""What is run before all else, in one process: it needs every kernel."""

WORKER = """
import json, sys
from recorder.cli import main as record
from replay.cli import main as replay
for command, *arguments in json.load(sys.stdin):
    sys.argv = [command, *arguments]
    try:
        (record if command == "prim-record" else replay)()
    except SystemExit as ended:
        print(json.dumps([command, *arguments, ended.code]), file=sys.stderr)
"""
"""Runs a list of commands in one process, so that imports and kernels are loaded once."""


def commands(sessions: int, data: Path) -> Iterator[tuple[str, list[list[str]]]]:
    """Yield the commands for each log.

    Args:
        sessions: Number of recorded sessions.
        data: The folder of the real logs.

    Yields:
        The log's name, and the commands that record and replay it.
    """
    for number in range(sessions):
        name, noise = f"session{number}", NOISE[number % len(NOISE)]
        extra = ["--no-walls"] if number % 5 == 4 else []
        rays = ("500", "180", "1000")[number % 3]
        record = ["prim-record", f"{name}.mcap", "--seed", str(FIRST_SEED + number), "--noise-std", str(noise)]
        replays = [
            _replay(f"{name}.mcap", f"{name}.{mapper}{suffix}", "--mapper", mapper, *refine)
            for mapper in MapperName
            for suffix, refine in (("", []), (".unrefined", ["--no-refine"]))
        ]
        yield name, [[*record, "--rays", rays, "--quiet", *extra], *replays]
    driven = ["--motion", "drive", "--duration", "30", "--quiet", "--seed", str(FIRST_SEED)]
    matched = ["--mapper", "forward", "--match-scans", "--pose", "odom"]
    yield "driven", [["prim-record", "driven.mcap", *driven], _replay("driven.mcap", "driven.matched", *matched)]
    fused = ["--mapper", "forward", "--pose", "fused", "--detect-every", "60"]
    yield "fused", [["prim-record", "fused.mcap", *driven], _replay("fused.mcap", "fused.looks", *fused, rrd=True)]
    if (data / "pillars4.mcap").exists():
        laser = ["--laser-offset", "-0.032", "0", "0"]
        yield (
            "pillars4",
            [_replay(str(data / "pillars4.mcap"), f"pillars4.{m}", "--mapper", m, *laser) for m in MapperName],
        )
    if (data / "csail.mcap").exists():
        yield (
            "csail",
            [_replay(str(data / "csail.mcap"), "csail.forward", "--mapper", "forward", "--resolution", "0.05")],
        )


def _replay(log: str, name: str, *options: str, rrd: bool = False) -> list[str]:
    shown = ["--save", f"{name}.rrd"] if rrd else ["--no-viewer"]
    return ["prim-replay", log, *options, *shown, "--report", f"{name}.report.json", "--quiet"]


def keep(checkout: Path, sessions: int, data: Path) -> dict[str, Any]:
    """Run a checkout on all sessions and logs.

    Args:
        checkout: The checkout.
        sessions: Number of recorded sessions.
        data: The folder of the real logs.

    Returns:
        Hashes of the recorded logs, and the reports without timings and paths.
    """
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        named = dict(commands(sessions, data))
        lists = list(named.values())
        # kernels that two processes compile at once may differ in a sum's last bits: one process compiles them all
        _run(checkout, Path(folder), [command for name in WARM_UP for command in named[name]])
        # the slowest ones, which come last, first
        list(pool.map(lambda work: _run(checkout, Path(folder), work), lists[::-1]))
        logs = {path.name: _digest(path) for path in sorted(Path(folder).glob("*.mcap"))}
        reports = {
            path.name.removesuffix(".report.json"): _stripped(json.loads(path.read_text(encoding="utf-8")))
            for path in sorted(Path(folder).glob("*.report.json"))
        }
    expected = sum(command[0] == "prim-replay" for work in lists for command in work)
    if len(reports) != expected:
        raise SystemExit(f"{expected - len(reports)} of {expected} replays left no report")
    return {"logs": logs, "reports": reports}


def _run(checkout: Path, folder: Path, work: list[list[str]]) -> None:
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    call = [sys.executable, "-c", WORKER]
    done = subprocess.run(
        call, cwd=folder, env=environment, input=json.dumps(work), text=True, capture_output=True, check=False
    )
    failed = [line for line in done.stderr.splitlines() if not line.endswith((" 0]", "null]"))]
    if done.returncode or failed:
        print("\n".join(failed), file=sys.stderr)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _stripped(report: dict[str, Any]) -> dict[str, Any]:
    report.pop("timing", None)
    report["log"].pop("path", None)
    report["log"].pop("name", None)
    return report


def differences(before: Any, after: Any, at: str = "") -> Iterator[tuple[str, float]]:
    """Compare two JSON values.

    Args:
        before: The first one.
        after: The second one.
        at: Path to them.

    Yields:
        The path of each difference and its size: relative above 1, absolute below; infinite except between numbers.
        A key that ``after`` has alone is none.
    """
    if isinstance(before, dict) and isinstance(after, dict):
        for key in before:
            if key not in after:
                yield f"{at}.{key}", float("inf")
            else:
                yield from differences(before[key], after[key], f"{at}.{key}")
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for index, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from differences(one, other, f"{at}[{index}]")
    elif before != after or isinstance(before, bool) != isinstance(after, bool):
        numbers = all(isinstance(value, float | int) and not isinstance(value, bool) for value in (before, after))
        size = abs(before - after) / max(1.0, abs(before)) if numbers else math.inf
        yield at, math.inf if math.isnan(size) else size


def added_keys(before: Any, after: Any, at: str = "") -> Iterator[str]:
    """Find the keys that were added.

    Args:
        before: The first JSON value.
        after: The second one.
        at: Path to them.

    Yields:
        The path of each key that ``after`` has alone; those of all items of a list have one path.
    """
    if isinstance(before, dict) and isinstance(after, dict):
        for key, value in after.items():
            if key in before:
                yield from added_keys(before[key], value, f"{at}.{key}")
            else:
                yield f"{at}.{key}"
    elif isinstance(before, list) and isinstance(after, list):
        for one, other in zip(before, after, strict=False):
            yield from added_keys(one, other, f"{at}[]")


def compare(before: dict[str, Any], after: dict[str, Any]) -> bool:
    """Print the differences of two runs.

    Args:
        before: The first run.
        after: The second run.

    Returns:
        Whether no difference exceeds TOLERANCE.
    """
    worst = 0.0
    for part in ("logs", "reports"):
        one, other = before[part], after[part]
        differing = {}
        for name in sorted(one.keys() | other.keys()):
            found = list(differences(one.get(name), other.get(name), name))
            if found:
                differing[name] = found
        print(f"{part}: {len(one)} before, {len(other)} after, {len(one) - len(differing)} equal to the last bit")
        for found in differing.values():
            largest = max(found, key=lambda item: item[1])
            worst = max(worst, largest[1])
            if largest[1] > TOLERANCE:
                print(f"  {largest[0]}: {largest[1]:g} ({len(found)} values differ)")
    reports = before["reports"].items()
    added = {key for name, one in reports for key in added_keys(one, after["reports"].get(name))}
    if added:
        print(f"keys that reports have only afterwards: {', '.join(sorted(added))}")
    print(f"largest difference: {worst:g} (the same up to {TOLERANCE:g})")
    return worst <= TOLERANCE


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--checkout", type=Path, default=ROOT, help="the checkout that is run (default: this one)")
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--data", type=Path, default=DATA, help="the folder of pillars4.mcap and csail.mcap")
    parser.add_argument("--quick", action="store_true", help="five sessions and no real log")
    parser.add_argument("what", choices=("keep", "compare"))
    parser.add_argument("files", type=Path, nargs="+")
    options = parser.parse_args()
    if options.what == "compare":
        before, after = (json.loads(path.read_text(encoding="utf-8")) for path in options.files)
        return 0 if compare(before, after) else 1
    sessions, data = (5, Path("nowhere")) if options.quick else (options.sessions, options.data)
    kept = keep(options.checkout.resolve(), sessions, data)
    options.files[0].write_text(json.dumps(kept, indent=1), encoding="utf-8")
    print(f"{options.files[0]}: {len(kept['logs'])} recorded logs, {len(kept['reports'])} reports")
    return 0


if __name__ == "__main__":
    sys.exit(main())
