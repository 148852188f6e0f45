"""Robustness to damaged and hostile inputs: none may do harm, and no result may be wrong in silence.

    python -m bench.fuzz [--cases 10000] [--kinds a,b] [--seed 0] [--jobs N] [--keep FOLDER] [--results FILE] [--anew]
    python -m bench.fuzz --case KIND:NUMBER [--seed 0] [--keep FOLDER]

The kinds are those of bench.fuzzing.kinds. Each log is replayed plainly and with --recover, and listed where its kind
says so. A finding is what bench.fuzzing.judge says: a traceback, no end, memory beyond the limit, an exit code other
than 0, 1 and 3, exit code 0 with other content than the whole log's, more than one error line, a raw control
character, a report that is no JSON. Each is printed as one line with the command that repeats it; --keep keeps its
files. Results stream into a file, by default in the system's temporary folder: a run that was cut off goes on there,
unless --anew. Exits with 1 where there is any finding.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from bench.fuzzing.case import Case
from bench.fuzzing.judge import LIMITS, LISTING, RECOVER, Limits, Outcome, problem
from bench.fuzzing.kinds import KINDS, make_case, plan
from bench.fuzzing.samples import Samples, make_samples
from bench.fuzzing.worker import Command, Worker, replay_command
from prim.text import printable

FAST = ("--mapper", "det", "--no-viewer", "--no-detect")
"""Options of cases that have none of their own."""

WARM_UP = (
    "mcap", "mcap-lz4", "mcap-unindexed", "bag-bz2", "bag-lz4", "db3.zstd", "foxglove-json", "foxglove-protobuf",
    "carmen-flaser-gz", "mcap-split", "part",
)  # fmt: skip
"""Samples that a worker replays before any case."""

WARM_OPTIONS = tuple(
    tuple(words.split())
    for words in (
        "--no-detect --mapper prob",
        "--no-detect --mapper forward",
        "--no-detect --pose fused --match-scans",
        "--no-detect --pose tf",
        "--pose odom",
    )
)
"""Options with which a worker replays a sample before any case."""

QUOTED = 240
"""So much of an error a finding quotes (characters)."""


@dataclass(frozen=True)
class Result:
    """What became of a case.

    Attributes:
        kind: Its kind.
        number: Which one of that kind.
        what: What was done.
        codes: How each run ended: an exit code, or a word.
        findings: What was wrong.
    """

    kind: str
    number: int
    what: str
    codes: tuple[str, ...]
    findings: tuple[str, ...]

    def lines(self, seed: int) -> Iterator[str]:
        """Yield a line for each finding, with the command that repeats it."""
        for finding in self.findings:
            command = f"python -m bench.fuzz --seed {seed} --case {self.kind}:{self.number}"
            yield printable(f"{self.kind}:{self.number} {finding} [{self.what[:QUOTED]}] {command}")


class Fuzzer:
    """Runs cases in worker processes.

    Args:
        samples: The intact logs.
        seed: Of all cases.
        jobs: How many workers.
        command: What is fuzzed.
        limits: What a run may take.
    """

    def __init__(
        self,
        samples: Samples,
        seed: int = 0,
        jobs: int = 1,
        command: Command = replay_command,
        limits: Limits = LIMITS,
    ) -> None:
        self._samples, self._seed, self._jobs, self._limits = samples, seed, jobs, limits
        self._stack = ExitStack()
        warm_up = [_intact(samples, name) for name in WARM_UP]
        warm_up += [replace(_intact(samples, "mcap"), options=("--no-viewer", *options)) for options in WARM_OPTIONS]
        self._workers: SimpleQueue[Worker] = SimpleQueue()
        for _ in range(jobs):
            self._workers.put(self._stack.enter_context(Worker(command, warm_up, limits)))
        self._contents: dict[str, set[str]] = {}

    def __enter__(self) -> Fuzzer:
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def run(self, cases: Sequence[tuple[str, int]]) -> Iterator[tuple[Result, Case]]:
        """Run cases.

        Args:
            cases: Their kinds and numbers.

        Yields:
            What became of each, in the order in which they end, and the case.
        """
        with ThreadPoolExecutor(self._jobs) as pool:
            yield from pool.map(lambda case: self.run_one(*case), cases)

    def run_one(self, kind: str, number: int) -> tuple[Result, Case]:
        """Run one case.

        Args:
            kind: Its kind.
            number: Which one of that kind.

        Returns:
            What became of it, and the case.
        """
        case = make_case(kind, number, self._seed, self._samples)
        case = case if case.options else replace(case, options=FAST)
        worker = self._workers.get()
        try:
            whole = self._content_of(worker, case.sample)
            runs = [(), (RECOVER,), *([(LISTING, "--json")] if KINDS[kind].lists else [])]
            outcomes = [worker.run(case, options) for options in runs]
        finally:
            self._workers.put(worker)
        findings = [
            _finding(outcome, found) for outcome in outcomes if (found := self._problem(case, outcome, whole))
        ]
        codes = tuple(outcome.ending.split(":")[0] or str(outcome.code) for outcome in outcomes)
        return Result(kind, number, case.what, codes, tuple(findings)), case

    def _problem(self, case: Case, outcome: Outcome, whole: set[str]) -> str:
        return problem(case, outcome, whole, self._limits)

    def content(self, name: str) -> set[str]:
        """Return the contents of a sample, read plainly and to recover it. Raises RuntimeError where it has none."""
        worker = self._workers.get()
        try:
            return self._content_of(worker, name)
        finally:
            self._workers.put(worker)

    def _content_of(self, worker: Worker, name: str) -> set[str]:
        """See :meth:`content`; of no sample, nothing."""
        if name and name not in self._contents:
            outcomes = [worker.run(_intact(self._samples, name), options) for options in ((), (RECOVER,))]
            self._contents[name] = {outcome.content for outcome in outcomes if outcome.content}
            if not self._contents[name]:
                raise RuntimeError(f"the intact log {name} cannot be replayed: {outcomes}")
        return self._contents.get(name, set())


def _intact(samples: Samples, name: str) -> Case:
    return Case(f"{name}, intact", samples.by_name[name].files, name, FAST)


def _finding(outcome: Outcome, found: str) -> str:
    """Return a finding with the options that lead to it, and what was printed."""
    errors = " ".join(outcome.errors.split())[:QUOTED]
    return f"{' '.join(outcome.options) or 'plainly'}: {found}" + (f": {errors}" if errors else "")


class Stream:
    """The file of results of a run: a line for each case, so that a run that was cut off can go on.

    Args:
        path: The file.
        run: What the run is: the results of another one are of no use to it.
        anew: Begin again.
    """

    def __init__(self, path: Path, run: dict[str, Any], anew: bool = False) -> None:
        self.path = path
        self.results: list[Result] = []
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() and not anew else []
        read = [value for line in lines if (value := _parsed(line)) is not None]
        if read and read[0] == run and not read[-1].get("done"):
            self.results = [
                Result(r["kind"], r["number"], r["what"], tuple(r["codes"]), tuple(r["findings"])) for r in read[1:]
            ]
        path.write_text("", encoding="utf-8")
        self._write(run)
        for result in self.results:
            self._write(vars(result))

    def add(self, result: Result) -> None:
        """Write a result."""
        self.results.append(result)
        self._write(vars(result))

    def complete(self) -> None:
        """Note that the run is complete: the next one begins anew."""
        self._write({"done": True})

    def _write(self, value: dict[str, Any]) -> None:
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(value) + "\n")


def _parsed(line: str) -> Any:
    """Return the value of a line; None of the last one, where it was cut off."""
    try:
        return json.loads(line)
    except ValueError:
        return None


def keep(folder: Path, result: Result, case: Case) -> None:
    """Keep the files of a case, and what it found.

    Args:
        folder: Where.
        result: What became of it.
        case: The case.
    """
    place = folder / f"{result.kind}-{result.number}"
    for name, data in case.files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(data)
    lines = [case.what, *result.findings, f"options: {' '.join(case.options)}"]
    (place / "finding.txt").write_text("\n".join(map(printable, lines)) + "\n", encoding="utf-8")


def summary(results: Sequence[Result]) -> Iterator[str]:
    """Yield a line for each kind: how many cases, how their runs ended, and how many have findings."""
    for kind in dict.fromkeys(result.kind for result in results):
        own = [result for result in results if result.kind == kind]
        codes = Counter(code for result in own for code in result.codes)
        listed = ", ".join(f"{name}: {count}" for name, count in sorted(codes.items()))
        yield f"{kind}: {len(own)} cases, {sum(bool(r.findings) for r in own)} with findings; exit codes {listed}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--kinds", default=",".join(KINDS), help=f"some of {','.join(KINDS)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--case", help="run this one alone: KIND:NUMBER")
    parser.add_argument("--results", type=Path)
    parser.add_argument("--anew", action="store_true")
    options = parser.parse_args()
    unknown = [kind for kind in options.kinds.split(",") if kind not in KINDS]
    if unknown:
        parser.error(f"no kind {unknown[0]}: there are {', '.join(KINDS)}")
    samples = make_samples(options.seed)
    with Fuzzer(samples, options.seed, options.jobs) as fuzzer:
        return _run_one(fuzzer, options) if options.case else _run_all(fuzzer, options)


def _run_one(fuzzer: Fuzzer, options: argparse.Namespace) -> int:
    kind, number = options.case.split(":")
    result, case = fuzzer.run_one(kind, int(number))
    print(
        printable(
            f"{options.case}: {result.what}; options {' '.join(case.options)}; exit codes {', '.join(result.codes)}"
        )
    )
    for line in result.lines(options.seed):
        print(line)
    if options.keep:
        keep(options.keep, result, case)
    return 1 if result.findings else 0


def _run_all(fuzzer: Fuzzer, options: argparse.Namespace) -> int:
    path = options.results or Path(tempfile.gettempdir()) / f"prim-fuzz-{options.seed}.jsonl"
    run = {"seed": options.seed, "cases": options.cases, "kinds": options.kinds}
    stream = Stream(path, run, options.anew)
    for earlier in stream.results:
        for line in earlier.lines(options.seed):
            print(line)
    done = {(result.kind, result.number) for result in stream.results}
    cases = [case for case in plan(options.kinds.split(","), options.cases) if case not in done]
    began = time.monotonic()
    for result, case in fuzzer.run(cases):
        stream.add(result)
        for line in result.lines(options.seed):
            print(line, flush=True)
        if result.findings and options.keep:
            keep(options.keep, result, case)
    stream.complete()
    print("\n".join(summary(stream.results)))
    found = sum(bool(result.findings) for result in stream.results)
    print(
        f"{found} of {len(stream.results)} cases have findings ({time.monotonic() - began:.0f} s; results in {path})"
    )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
