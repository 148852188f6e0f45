"""Fuzzing guided by coverage: readers of logs, codecs, documents in JSON, the check of networks (atheris, libFuzzer).

    pip install -e '.[fuzz]' -c constraints.txt
    python -m bench.fuzz_guided [--minutes 10] [--targets logs,codecs,documents,networks] [--seed 0] [--keep FOLDER]

Each target of bench.fuzzing.targets runs for its share of the minutes in a process of its own, on a corpus that
begins with the small logs of bench.fuzzing.samples and grows in a temporary folder. Logs are changed by their
structure, with CRCs that are right. A finding is an exception that the target does not expect, an input that takes
more than 20 s or 2 GB, or the end of the process; each is printed once, as one line, and --keep keeps its input,
which `--input FILE --targets TARGET` runs again. Exits with 1 where there is any finding.
"""

from __future__ import annotations

import argparse
import hashlib
import random
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from prim.text import printable

TIMEOUT, MEMORY = 20, 2048
"""What an input may take (s, MB): bench.fuzz has the limits that hold, and measures each case."""
LONGEST = 200_000
"""Of an input (bytes)."""
SHARES = {"logs": 5, "codecs": 3, "documents": 1, "networks": 1}
"""How the minutes are shared."""
INSTRUMENTED, KERNELS = ["prim", "detect.networks"], ["prim.compiled", "prim.raycast"]
"""Packages whose branches guide the search, and modules among them that numba must read as they are."""
FINDING = "finding: "


def _instrumented_targets() -> Any:
    """Import the targets, and all that they call, with branches that report to libFuzzer."""
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED, exclude=KERNELS, enable_loader_override=False):
        from bench.fuzzing import targets
    return targets


def run_target(name: str, corpus: Path, kept: Path, seconds: int, seed: int) -> None:
    """Fuzz one target in this process, which libFuzzer ends.

    Args:
        name: The target.
        corpus: The folder of its inputs.
        kept: Where inputs of findings are written.
        seconds: For how long.
        seed: Of libFuzzer.
    """
    import atheris

    targets = _instrumented_targets()
    target = targets.TARGETS[name]
    if name == "logs":
        from bench.fuzzing.samples import make_samples

        targets.use_folder(make_samples())
    found: set[str] = set()

    def test(data: bytes) -> None:
        try:
            target.run(data)
        except target.expected:
            pass
        except Exception as error:
            report(error, data, name, kept, found)

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        changed = target.mutate(random.Random(seed), data, lambda part: bytes(atheris.Mutate(part, len(part) + 64)))
        return bytes(changed[:max_size])

    flags = [
        f"-max_total_time={seconds}", f"-seed={seed + 1}", f"-timeout={TIMEOUT}", f"-rss_limit_mb={MEMORY}",
        f"-max_len={LONGEST}", "-verbosity=0", "-print_final_stats=1", f"-artifact_prefix={kept}/{name}-",
    ]  # fmt: skip
    options = {"custom_mutator": mutate} if target.mutate else {}
    atheris.Setup([sys.argv[0], *flags, str(corpus)], test, **options)
    atheris.Fuzz()


def report(error: Exception, data: bytes, name: str, kept: Path, found: set[str]) -> None:
    """Print an unexpected exception and keep its input, once for each line of code that raises it.

    Args:
        error: The exception.
        data: The input.
        name: The target.
        kept: Where inputs are written.
        found: Where exceptions were raised before; this one's place is added.
    """
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "bench/fuzzing" not in frame.filename] or list(frames)
    place = f"{type(error).__name__} at {Path(own[-1].filename).name}:{own[-1].lineno}"
    if place in found:
        return
    found.add(place)
    path = kept / f"{name}-{hashlib.sha256(data).hexdigest()[:12]}"
    path.write_bytes(data)
    print(printable(f"{FINDING}{name}: {place}: {error} (input: {path})"), flush=True)


def _fuzz(name: str, seconds: float, seed: int, corpus: Path, kept: Path) -> list[str]:
    """Run a target in processes of its own, a new one where libFuzzer ended one; return the findings."""
    end, findings, lines = time.monotonic() + seconds, dict[str, None](), list[str]()
    while (left := end - time.monotonic()) > 1:
        words = [name, str(corpus), str(kept), str(int(left)), str(seed)]
        run = subprocess.run(
            [sys.executable, "-m", "bench.fuzz_guided", "--run", *words], capture_output=True, text=True, check=False
        )
        lines = (run.stdout + run.stderr).splitlines()
        for line in lines:
            if FINDING in line and line not in findings:
                findings[line[line.index(FINDING) :]] = None
        if run.returncode:
            what = next(
                (line for line in lines if "ERROR: libFuzzer" in line or "Error" in line), "its process ended"
            )
            findings[printable(f"{FINDING}{name}: {what} (inputs: {kept}/{name}-*)")] = None
            seed += 1
            if left > end - time.monotonic() + 1 and "libFuzzer" not in what:
                break
    executed = next((line.split()[-1] for line in lines if "number_of_executed_units" in line), "0")
    inputs = sum(1 for _ in corpus.iterdir())
    print(f"{name}: {seconds:.0f} s, {executed} inputs, a corpus of {inputs}, {len(findings)} findings", flush=True)
    return list(findings)


def _seed(names: list[str], folder: Path) -> None:
    """Write the inputs to begin with, a folder for each target."""
    from bench.fuzzing.samples import make_samples
    from bench.fuzzing.targets import TARGETS

    samples = make_samples()
    for name in names:
        (folder / name).mkdir()
        for number, data in enumerate(TARGETS[name].seeds(samples)):
            (folder / name / f"seed-{number}").write_bytes(data)


def _run_input(path: Path, name: str) -> int:
    """Run one input of a target, without atheris; a finding raises."""
    from bench.fuzzing import targets
    from bench.fuzzing.samples import make_samples

    targets.use_folder(make_samples())
    run: Callable[[bytes], None] = targets.TARGETS[name].run
    run(path.read_bytes())
    return 0


def main() -> int:
    if sys.argv[1:2] == ["--run"]:
        name, corpus, kept, seconds, seed = sys.argv[2:]
        run_target(name, Path(corpus), Path(kept), int(seconds), int(seed))
        return 0
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--targets", default=",".join(SHARES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--input", type=Path, help="run this input alone")
    options = parser.parse_args()
    if options.input:
        return _run_input(options.input, options.targets)
    if find_spec("atheris") is None:
        parser.error("atheris is not installed: pip install -e '.[fuzz]' -c constraints.txt")
    from bench.fuzzing.targets import targets

    names = [name for name in options.targets.split(",") if name in targets()]
    total = sum(SHARES[name] for name in names)
    with tempfile.TemporaryDirectory(prefix="prim-fuzz-") as folder:
        kept = (options.keep or Path(folder) / "kept").resolve()
        kept.mkdir(parents=True, exist_ok=True)
        _seed(names, Path(folder))
        seconds = {name: options.minutes * 60 * SHARES[name] / total for name in names}
        found = [
            line for name in names for line in _fuzz(name, seconds[name], options.seed, Path(folder) / name, kept)
        ]
    for line in found:
        print(line)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
