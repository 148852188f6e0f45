"""The fuzzer recognises every kind of finding, repeats each case, goes on where it was cut off; a bounded run."""

from __future__ import annotations

import json
import random
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from bench.fuzz import Fuzzer, Result, Stream, keep
from bench.fuzz_guided import report
from bench.fuzzing import mcap_file
from bench.fuzzing.bombs import zstd_zeros
from bench.fuzzing.case import Case
from bench.fuzzing.damage import CHANGES
from bench.fuzzing.judge import LISTING, RECOVER, Limits, Outcome, problem
from bench.fuzzing.kinds import KINDS, make_case, plan
from bench.fuzzing.messages import damaged_words
from bench.fuzzing.samples import Samples, make_samples
from bench.fuzzing.targets import TYPES, Target, targets, use_folder
from bench.fuzzing.worker import Worker
from prim.log.decoding.codecs import ENCODINGS, codec_of
from tests.bench import fakes

CASES, SEED = 150, 1
"""Of the bounded run."""
MUTATIONS = 60
"""Of each target of guided fuzzing."""
PATIENT = Limits(seconds=4.0, patience=4.0)
"""Of the bounded run: a machine that has other things to do compiles slowly."""
QUICK = Limits(seconds=0.1, megabytes=150.0, patience=0.4, wall_seconds=1.0)
CASE = Case("nothing", {"log.mcap": b"abc"})


@pytest.fixture(scope="module")
def samples() -> Samples:
    return make_samples(SEED)


@pytest.fixture(scope="module")
def fuzzer(samples: Samples) -> Iterator[Fuzzer]:
    with Fuzzer(samples, SEED, limits=PATIENT) as fuzzer:
        yield fuzzer


FINDINGS = [
    (fakes.raises, "an unexpected exception: KeyError"),
    (fakes.shows_traceback, "an unexpected exception"),
    (fakes.is_a_bug, "an unexpected exception"),
    (fakes.loops, "no end within 0.5 s of CPU time"),
    (fakes.waits, "no end within 1 s"),
    (fakes.is_slow, "it took 0."),
    (fakes.takes_memory, "MB of memory, more than 150"),
    (fakes.is_out_of_memory, "out of memory"),
    (fakes.crashes, "its process ended: SIGSEGV"),
    (fakes.exits_with_5, "exit code 5"),
    (fakes.exits_with_2, "exit code 2"),
    (fakes.says_nothing, "0 error lines with exit code 1"),
    (fakes.says_two_lines, "2 error lines with exit code 1"),
    (fakes.complains_of_success, "1 error lines with exit code 0"),
    (fakes.prints_escape, r"a raw control character is printed: '\x1b'"),
    (fakes.prints_bidi, r"a raw control character is printed: '\u202e'"),
    (fakes.writes_nan, "its report is no JSON: NaN"),
    (fakes.writes_no_report, "its report is no JSON"),
    (fakes.good, ""),
    (fakes.refuses, ""),
    (fakes.compiles_at_first, ""),
]


@pytest.mark.parametrize(("command", "found"), FINDINGS, ids=lambda value: getattr(value, "__name__", ""))
def test_each_kind_of_finding_is_recognised(command: Callable[[list[str]], int], found: str) -> None:
    with Worker(command, (), QUICK) as worker:
        outcome = worker.run(CASE)
    what = problem(CASE, outcome, (), QUICK)
    assert found in what and bool(found) == bool(what), outcome


def test_a_listing_is_the_report() -> None:
    with Worker(fakes.lists, (), QUICK) as lists, Worker(fakes.good, (), QUICK) as silent:
        assert not problem(CASE, lists.run(CASE, (LISTING, "--json")), (), QUICK)
        assert "no JSON" in problem(CASE, silent.run(CASE, (LISTING, "--json")), (), QUICK)


def test_a_worker_that_ended_is_replaced() -> None:
    with Worker(fakes.crashes, (), QUICK) as worker:
        assert [worker.run(CASE).ending for _ in range(2)] == ["its process ended: SIGSEGV"] * 2


@pytest.mark.parametrize(
    ("case", "outcome", "found"),
    [
        (replace(CASE, sample="mcap"), Outcome(code=0, content="other"), "exit code 0 with other content"),
        (replace(CASE, sample="mcap"), Outcome(code=0, content="whole"), ""),
        (
            replace(CASE, sample="mcap"),
            Outcome((RECOVER,), code=0, content="other"),
            "exit code 0 with other content",
        ),
        (replace(CASE, sample="mcap"), Outcome((RECOVER,), code=3, content="other"), ""),
        (CASE, Outcome(code=0, content="other"), ""),
        (replace(CASE, must_recover=True), Outcome((RECOVER,), code=1, errors="x"), "all is lost to a small hole"),
        (replace(CASE, must_recover=True), Outcome(code=1, errors="x"), ""),
        (replace(CASE, may_refuse=True), Outcome(code=2, errors="x"), ""),
    ],
)
def test_contents_are_compared(case: Case, outcome: Outcome, found: str) -> None:
    assert problem(case, outcome, {"whole"}, QUICK) == found


def test_limits_grow_with_the_input() -> None:
    limits = Limits()
    assert (limits.time(3.0), limits.memory(3.0)) == (7.0, 612.0)
    assert Case("", {"a": bytes(2_000_000), "b": bytes(1_000_000)}).megabytes == 3.0


def test_all_samples_are_intact_logs(samples: Samples, fuzzer: Fuzzer) -> None:
    """They are what damage is compared with: each is replayed, and those that are lossless agree."""
    contents = {name: fuzzer.content(name) for name in samples.by_name}
    assert all(contents.values())
    assert contents["mcap"] & contents["mcap-small-chunks"] & contents["mcap-no-crc"]


@pytest.mark.parametrize("kind", KINDS)
def test_cases_can_be_repeated_one_by_one(samples: Samples, kind: str) -> None:
    cases = [make_case(kind, number, SEED, samples) for number in (7, 3, 7)]
    assert cases[0] == cases[2] != cases[1]
    assert make_case(kind, 7, SEED + 1, samples) != cases[0]
    assert all(case.what and "\n" not in case.what for case in cases)


def test_samples_can_be_repeated(samples: Samples) -> None:
    assert make_samples(SEED).by_name == samples.by_name


def test_a_plan_holds_every_kind_by_its_share() -> None:
    counts = Counter(kind for kind, _ in plan(KINDS, 10_000))
    assert set(counts) == set(KINDS) and abs(counts.total() - 10_000) < len(KINDS)
    assert counts["bytes"] / counts["records"] == pytest.approx(
        KINDS["bytes"].share / KINDS["records"].share, rel=0.01
    )
    assert {kind for kind, _ in plan(["bytes", "json"], 1)} == {"bytes", "json"}


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_every_damage_changes_something(change: Callable[..., tuple[str, bytes]]) -> None:
    data = bytes(range(1, 256)) * 20
    damaged = [change(random.Random(seed), data) for seed in range(20)]
    assert all(what and after != data for what, after in damaged)


def test_mcap_files_are_put_together_as_they_were(samples: Samples) -> None:
    for sample in samples.indexed_mcaps():
        data, records = mcap_file.take_apart(sample.data)
        if sample.name in ("mcap", "recorded", "mcap-small-chunks"):  # others have offsets of groups that are empty
            assert mcap_file.put_together(data, records) == sample.data, sample.name
        assert [mcap_file.encode(mcap_file.decode(record)) for record in records] == records


def test_a_frame_of_zeros_is_one(samples: Samples) -> None:
    size = 3 * 128 * 1024
    for claim in (None, size):
        assert mcap_file.DECOMPRESSORS["zstd"](zstd_zeros(size, claim)) == bytes(size)


RESULT = Result("bytes", 4, "byte 3 ^ 0x01", ("0", "3"), ("plainly: exit code 0 with other content",))


def test_findings_are_lines_with_the_command_that_repeats_them() -> None:
    [line] = replace(RESULT, what="a\x1b\nb").lines(seed=9)
    assert "\x1b" not in line and "\n" not in line
    assert line.endswith("python -m bench.fuzz --seed 9 --case bytes:4")


def test_a_run_that_was_cut_off_goes_on(tmp_path: Path) -> None:
    path, run = tmp_path / "r.jsonl", {"seed": 0, "cases": 3}
    Stream(path, run).add(RESULT)
    with path.open("a") as stream:
        stream.write('{"kind": "by')  # killed while it wrote
    assert Stream(path, run).results == [RESULT]
    assert Stream(path, {"seed": 1, "cases": 3}).results == []


def test_a_complete_run_begins_anew(tmp_path: Path) -> None:
    path, run = tmp_path / "r.jsonl", {"seed": 0, "cases": 1}
    stream = Stream(path, run)
    stream.add(RESULT)
    stream.complete()
    assert json.loads(path.read_text().splitlines()[1])["findings"] == list(RESULT.findings)
    assert Stream(path, run).results == []


def test_findings_are_kept(tmp_path: Path) -> None:
    keep(tmp_path, RESULT, Case("x", {"bag/a.db3": b"1", "bag/metadata.yaml": b"2"}))
    assert (tmp_path / "bytes-4/bag/a.db3").read_bytes() == b"1"
    assert "other content" in (tmp_path / "bytes-4/finding.txt").read_text()


@pytest.fixture(scope="module")
def inputs(samples: Samples) -> dict[str, list[bytes]]:
    """What guided fuzzing begins with, and what it may make of that."""
    use_folder(samples)
    found = {}
    for name, target in targets().items():
        rng = random.Random(name)
        seeds = list(target.seeds(samples))
        changed = [_mutated(target, rng, rng.choice(seeds)) for _ in range(MUTATIONS)]
        found[name] = seeds + changed
    return found


def _mutated(target: Target, rng: random.Random, data: bytes) -> bytes:
    def mutate(part: bytes) -> bytes:
        return damaged_words(rng, part)[1]

    return target.mutate(rng, data, mutate) if target.mutate else data[:1] + mutate(data[1:])


@pytest.mark.parametrize("name", targets())
def test_targets_take_what_guided_fuzzing_gives_them(inputs: dict[str, list[bytes]], name: str) -> None:
    for data in inputs[name]:
        targets()[name].run(data)
    assert len(set(inputs[name])) > MUTATIONS / 2


def test_seeds_of_logs_and_messages_are_read(inputs: dict[str, list[bytes]], samples: Samples) -> None:
    """Else fuzzing would search in what is refused at once."""
    types = {kind for kind in TYPES if any(_is_decoded(kind, data) for data in inputs["codecs"])}
    assert types >= {*samples.content.types.values(), "sensor_msgs/msg/PointCloud2", "foxglove.LaserScan"}


def _is_decoded(kind: str, data: bytes) -> bool:
    kinds = [k for k in TYPES for encoding in ENCODINGS if codec_of(k, encoding) is not None]
    codecs = [c for k in TYPES for encoding in ENCODINGS if (c := codec_of(k, encoding)) is not None]
    number = data[0] % len(codecs)
    try:
        return kinds[number] == kind and codecs[number].decode(data[1:]) is not None
    except ValueError:
        return False


def test_unexpected_exceptions_are_reported_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found: set[str] = set()
    for number in (1, 2):
        try:
            json.loads("{")
        except ValueError as error:
            report(error, bytes([number]), "documents", tmp_path, found)
    [line] = capsys.readouterr().out.splitlines()
    assert line.startswith("finding: documents: JSONDecodeError at decoder.py:")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"\x01"]


def test_no_hostile_input_does_harm(fuzzer: Fuzzer) -> None:
    """A bounded form of bench.fuzz: some of every kind, with a seed of its own."""
    found = [result for result, _ in fuzzer.run(plan(KINDS, CASES))]
    assert [line for result in found for line in result.lines(SEED)] == []
    assert {code for result in found for code in result.codes} >= {"0", "1", "3"}
